"""Compress and decompress a scene, and measure time, memory, size and errors."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from kissgs.benchmark.isolation import isolated
from kissgs.benchmark.stage_resources import StageResources
from kissgs.cameras.views import Views
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.attributes import AttributeErrors, attribute_errors
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.capture_fit import in_scene_frame
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import Evaluation
from kissgs.io.container_names import ContainerName
from kissgs.pipeline.decompress import decompress
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.report import Report
from kissgs.pipeline.scene_files import load
from kissgs.settings import Settings


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """Measurements of a scene that was compressed and decompressed.

    Attributes:
        report: report of the compression.
        stage_cpu_seconds: CPU time of encoding by stage, all threads.
        stage_peak_memory: largest resident set of the process by stage of encoding, and in "decode" that of decoding,
            bytes.
        decode_seconds: wall time of decoding, from the bytes of the zip to arrays.
        decode_cpu_seconds: CPU time of decoding, all threads.
        peak_memory: largest resident set of the process before errors were computed, bytes.
        errors: errors of the Gaussians that are in the container; None if not requested.
        evaluation: comparison of rendered images; None if not requested.
    """

    report: Report
    stage_cpu_seconds: dict[str, float]
    stage_peak_memory: dict[str, int]
    decode_seconds: float
    decode_cpu_seconds: float
    peak_memory: int
    errors: AttributeErrors | None
    evaluation: Evaluation | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, nested, for JSON."""
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        numbers = asdict(replace(self, evaluation=None))
        errors = None if self.errors is None else self.errors.as_dict()
        nested = {"report": self.report.as_dict(), "errors": errors, "evaluation": evaluation}
        return {**numbers, **nested}


def roundtrip(
    source: Splats | Path,
    settings: Settings,
    *,
    container: ContainerName = "sogxt",
    errors: bool = True,
    evaluate: bool = False,
    views: Views | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> RoundTrip:
    """Compress a scene, decompress it, and compare the two.

    The peak memory of this process begins anew with every stage (:class:`StageResources`).

    Args:
        source: a scene, or the path of a ``.ply`` file.
        settings: settings of the compression.
        container: container to write.
        errors: whether to compute the errors of attributes, which takes memory; the peak does not include this.
        evaluate: whether to compare rendered images too (:func:`kissgs.evaluation.evaluate.compare_images`); the
            times do not include this.
        views: capture for rate-distortion planning and, by its held-out views, for the evaluation; None to evaluate
            with cameras drawn over the whole scene.
        threads: number of threads; 0 means one per processor.
        progress: receives the stages of compression and decompression.
    """
    clock = StageResources(progress)
    result = compress(source, settings=settings, container=container, views=views, threads=threads, progress=clock)
    clock.stop()
    report = replace(result.report, peak_memory=max(clock.peak_memory.values(), default=result.report.peak_memory))
    archive = result.to_zip()
    clock.start("decode")
    wall = time.perf_counter()
    decoded = decompress(archive, threads=threads, progress=progress)
    wall = time.perf_counter() - wall
    clock.stop()
    decode_cpu_seconds = clock.cpu_seconds.pop("decode")
    found, evaluation = None, None
    if errors or evaluate:
        scene = source if isinstance(source, Splats) else load(source)
        found = attribute_errors(scene.select(result.order), decoded) if errors else None
        evaluation = _evaluation(clean(scene)[0], decoded, views, threads, progress) if evaluate else None
    return RoundTrip(
        report=report,
        stage_cpu_seconds=clock.cpu_seconds,
        stage_peak_memory=clock.peak_memory,
        decode_seconds=wall,
        decode_cpu_seconds=decode_cpu_seconds,
        peak_memory=max(clock.peak_memory.values()),
        errors=found,
        evaluation=evaluation,
    )


def _evaluation(scene: Splats, decoded: Splats, views: Views | None, threads: int, progress: Progress) -> Evaluation:
    views = views or evaluation_views(scene, threads=threads, progress=progress)
    views = in_scene_frame(scene, views, threads=threads)
    return compare_images(scene, decoded, views, threads=threads, progress=progress)


def isolated_roundtrip(
    source: Path,
    settings: Settings,
    *,
    container: ContainerName = "sogxt",
    errors: bool = True,
    evaluate: bool = False,
    views: Views | None = None,
    threads: int = 0,
) -> RoundTrip:
    """Run :func:`roundtrip` in a separate process, so that times and peak memory are those of this scene alone.

    Raises:
        UnsupportedError: the process was killed, most likely for lack of memory.
    """
    work = partial(roundtrip, container=container, errors=errors, evaluate=evaluate, views=views, threads=threads)
    return isolated(partial(work, source, settings), str(source))
