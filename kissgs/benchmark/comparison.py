"""Presets and external codecs measured on one scene: bytes, times, memory and quality, each in a separate process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

from kissgs.benchmark.bd_rate import at_quality_offset
from kissgs.benchmark.external_codecs import SPLAT_TRANSFORM, ExternalResult, check_external, measure_external
from kissgs.benchmark.results import Measurement, Run, curve_name
from kissgs.benchmark.roundtrip import isolated_roundtrip
from kissgs.cameras.views import Views
from kissgs.core.errors import KissgsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import float32_bytes
from kissgs.io.container_names import ContainerName
from kissgs.settings import Settings

MAX_REPEATED_SECONDS = 60.0
"""An external codec that takes longer, encoding and decoding together, is measured once only, seconds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchmarkPlan:
    """Arguments of :func:`compare`.

    Attributes:
        presets: settings that are measured as they are, ``repeats`` times each.
        containers: containers that each of ``presets`` and ``curve_presets`` is written to.
        curve_presets: settings with rate-distortion planning, measured once at each of ``quality_offsets``.
        quality_offsets: values of ``quality_offset_db``, decibels.
        external_codecs: formats of :data:`kissgs.benchmark.external_codecs.EXTERNAL_FORMATS`.
        splat_transform: command that starts splat-transform, the tool of the external codecs.
        sog_iterations: k-means iterations over the SH of ``.sog``; None for the tool's default.
        repeats: number of measurements, 1 or more.
        errors: whether to compute the errors of attributes.
        evaluate: whether to compare rendered images.
        views: capture for rate-distortion planning and, by its held-out views, for the evaluation; None to evaluate
            with cameras drawn over the whole scene.
        threads: number of threads; 0 means one per processor.
    """

    presets: Sequence[Settings]
    containers: Sequence[ContainerName] = ("sogxt",)
    curve_presets: Sequence[Settings] = ()
    quality_offsets: Sequence[float] = ()
    external_codecs: Sequence[str] = ()
    splat_transform: Sequence[str] = SPLAT_TRANSFORM
    sog_iterations: int | None = None
    repeats: int = 1
    errors: bool = True
    evaluate: bool = False
    views: Views | None = None
    threads: int = 0


def compare(
    scene: Path, plan: BenchmarkPlan, *, on_failure: Callable[[str], None] | None = None, progress: Progress = silent
) -> list[Measurement]:
    """Measure a scene as planned: presets, then points of quality curves, then external codecs.

    Args:
        scene: a ``.ply`` file.
        plan: what to measure.
        on_failure: receives the error message of an external codec that fails, and the measurements go on; None to
            raise the error.
        progress: receives the stage "measure" with the name of the codec as a note.

    Raises:
        InvalidSceneError: the scene, or the output of an external codec, cannot be read.
        UnsupportedError: an external codec is missing, or it fails and ``on_failure`` is None; a measurement was
            killed.
    """
    for codec in plan.external_codecs:
        check_external(codec, plan.splat_transform)
    jobs = measurements(scene, plan)
    rows = []
    for done, (name, job) in enumerate(jobs):
        progress("measure", done / len(jobs), name)
        try:
            rows.append(job())
        except KissgsError as error:
            if on_failure is None or name not in plan.external_codecs:
                raise
            on_failure(str(error))
    return rows


def measurements(scene: Path, plan: BenchmarkPlan) -> list[tuple[str, Callable[[], Measurement]]]:
    """Return the measurements of :func:`compare`, not yet made: the name of the codec, and the work."""
    points = [
        *product(plan.presets, [None], plan.containers),
        *product(plan.curve_presets, plan.quality_offsets, plan.containers),
    ]
    return [
        *(
            (
                curve_name(str(settings.preset), container),
                partial(_measure_preset, scene, settings, db, container, plan),
            )
            for settings, db, container in points
        ),
        *((codec, partial(_measure_external, scene, codec, plan)) for codec in plan.external_codecs),
    ]


def in_time(seconds: float) -> str:
    """Return the name of a measurement with a time limit: "in 30 s", "in 2 min"."""
    minutes = seconds >= 60 and seconds % 60 == 0
    return f"in {seconds / 60:g} min" if minutes else f"in {seconds:g} s"


def _measure_preset(
    scene: Path, settings: Settings, quality_offset_db: float | None, container: ContainerName, plan: BenchmarkPlan
) -> Measurement:
    """Measure a preset, or once only a point of its curve, whose times do not matter; evaluate the first container."""
    repeats = plan.repeats if quality_offset_db is None else 1
    if quality_offset_db is not None:
        settings = at_quality_offset(settings, quality_offset_db)
    results = [
        isolated_roundtrip(
            scene,
            settings,
            container=container,
            errors=plan.errors,
            evaluate=plan.evaluate and not number,
            views=plan.views,
            threads=plan.threads,
        )
        for number in range(repeats)
    ]
    first = results[0]
    return Measurement(
        scene=scene.name,
        codec=str(settings.preset) if settings.time_limit is None else in_time(settings.time_limit),
        container=container,
        quality_offset_db=quality_offset_db,
        gaussians=first.report.source_count,
        float32_bytes=float32_bytes(first.report.source_count, first.report.sh_degree),
        file_bytes=first.report.file_bytes,
        runs=tuple(map(Run.of, results)),
        errors=first.errors,
        evaluation=first.evaluation,
        details=first.as_dict(),
    )


def _measure_external(scene: Path, codec: str, plan: BenchmarkPlan) -> Measurement:
    """Measure an external codec, as often as presets if that takes at most :data:`MAX_REPEATED_SECONDS` each time."""

    def measure(evaluate: bool) -> ExternalResult:
        return measure_external(
            scene,
            codec,
            command=plan.splat_transform,
            sh_iterations=plan.sog_iterations if codec == "sog" else None,
            errors=plan.errors,
            evaluate=evaluate,
            views=plan.views,
        )

    first = measure(plan.evaluate)
    quick = first.encode_seconds + first.decode_seconds <= MAX_REPEATED_SECONDS
    results = [first, *(measure(False) for _ in range(1, plan.repeats if quick else 1))]
    return Measurement(
        scene=scene.name,
        codec=codec,
        container=None,
        gaussians=first.gaussians,
        float32_bytes=float32_bytes(first.gaussians, first.sh_degree),
        file_bytes={codec: first.bytes},
        runs=tuple(map(Run.of, results)),
        errors=first.errors,
        evaluation=first.evaluation,
        details=first.as_dict(),
    )
