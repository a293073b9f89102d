"""``kissgs bench codecs``, and what it shares with ``scaling``."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, each_scene
from kissgs.cli.options import chosen
from kissgs.core.errors import UnsupportedError

if TYPE_CHECKING:
    from pathlib import Path

    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.results import Measurement
    from kissgs.core.progress import Progress
    from kissgs.settings import Settings


@dataclass(frozen=True, slots=True)
class ExternalCodecs:
    """External codecs to measure.

    Attributes:
        formats: formats of :data:`kissgs.benchmark.external_codecs.EXTERNAL_FORMATS`.
        splat_transform: command line that starts splat-transform, their tool.
        sog_iterations: k-means iterations over the SH of ``.sog``; None for the tool's default.
    """

    formats: list[str]
    splat_transform: str
    sog_iterations: int | None

    def check(self) -> None:
        """Check that the options belong together.

        Raises:
            UnsupportedError: k-means iterations without ``.sog``.
        """
        if self.sog_iterations is not None and "sog" not in self.formats:
            raise UnsupportedError("--sog-iterations needs --external sog")


def codecs(
    inputs: BenchInputs,
    *,
    presets: list[str] | None,
    changes: list[str] | None,
    containers: list[str],
    external: ExternalCodecs,
    quality_offsets: list[float],
    repeats: int,
    evaluate: bool,
) -> BenchOutput:
    """Measure presets, points of their quality curves and external codecs."""
    external.check()
    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.comparison_plots import comparison_plot
    from kissgs.benchmark.results import at_equal_psnr
    from kissgs.cli.bench_tables import bench_tables
    from kissgs.io.container_names import named_container

    settings = all_settings(presets, changes)
    curve_presets = _curve_presets(settings, only_balanced=not presets)
    if quality_offsets and not curve_presets:
        raise UnsupportedError("--quality-offset needs a preset with rate-distortion planning: balanced or small")
    plan = BenchmarkPlan(
        presets=settings,
        containers=list(dict.fromkeys(named_container(name, None) for name in containers)) or ["sogxt"],
        curve_presets=curve_presets,
        quality_offsets=quality_offsets,
        external_codecs=external.formats,
        splat_transform=command_words(external.splat_transform),
        sog_iterations=external.sog_iterations,
        repeats=repeats,
        evaluate=evaluate or inputs.views is not None or bool(quality_offsets),
        views=inputs.views,
        threads=inputs.threads,
    )
    rows, failures = measured(inputs, plan)
    equals = at_equal_psnr(rows)
    entries = [row.as_dict() for row in rows]
    for row, entry in zip(rows, entries, strict=True):
        if row.quality_offset_db is None and quality_offsets:
            matching = (equal for equal in equals if (equal.scene, equal.reference) == (row.scene, row.name))
            entry["at_equal_psnr"] = [equal.as_dict() for equal in matching]
    return BenchOutput(
        rows=entries,
        table=bench_tables(rows, equals),
        draw=partial(comparison_plot, rows),
        failures=failures,
    )


def measured(inputs: BenchInputs, plan: BenchmarkPlan) -> tuple[list[Measurement], list[str]]:
    """Measure each scene as planned; return all measurements, and the messages of what failed."""
    from kissgs.benchmark.comparison import compare

    external_failures = list[str]()

    def measure(scene: Path, progress: Progress) -> list[Measurement]:
        return compare(scene, plan, on_failure=external_failures.append, progress=progress)

    found, failures = each_scene(inputs.scenes, measure)
    return [replace(row, scene=name) for name, row in found], external_failures + failures


def all_settings(presets: list[str] | None, changes: list[str] | None) -> list[Settings]:
    """Return the settings of these presets, by default of all, with these changes."""
    from kissgs.settings import Preset

    return [chosen(name, changes) for name in presets or list(Preset)]


def _curve_presets(settings: list[Settings], *, only_balanced: bool) -> list[Settings]:
    """Return those of the settings that have a quality curve."""
    from kissgs.settings import Preset

    planned = [each for each in settings if each.encode.rate_distortion]
    return [each for each in planned if each.preset == Preset.BALANCED] if only_balanced else planned


def command_words(text: str) -> list[str]:
    """Split a command line into words."""
    try:
        return shlex.split(text)
    except ValueError as error:
        raise UnsupportedError(f"--splat-transform {text}: {str(error).lower()}; quote the command's words") from error
