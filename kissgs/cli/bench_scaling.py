"""``kissgs bench scaling``."""

from __future__ import annotations

from contextlib import closing
from functools import partial
from typing import TYPE_CHECKING

from kissgs.cli.bench_codecs import ExternalCodecs, all_settings, command_words
from kissgs.cli.bench_scenes import BenchInputs, BenchOutput, announce, distinct_names
from kissgs.cli.files import is_folder
from kissgs.cli.interrupts import Interrupted
from kissgs.core.errors import UnsupportedError
from kissgs.io.scene_file import open_scene_file

if TYPE_CHECKING:
    from pathlib import Path

    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.results import Measurement
    from kissgs.benchmark.scaling import FailedMeasurement


def scaling(
    inputs: BenchInputs,
    counts: list[int],
    *,
    degrees: list[int],
    presets: list[str] | None,
    changes: list[str] | None,
    external: ExternalCodecs,
    repeats: int,
    evaluate: bool,
    plotted: bool,
) -> BenchOutput:
    """Measure presets and external codecs on scenes resampled to each count, or on sample scenes if there are none."""
    external.check()
    if inputs.scenes and degrees:
        raise UnsupportedError("--degree is for sample scenes; leave it out, or leave out FILE")
    if inputs.views is not None and not inputs.scenes:
        raise UnsupportedError("--views needs the FILE of its scene; sample scenes have no photographs")
    if plotted and len(set(degrees)) > 1:
        raise UnsupportedError("--plot takes one scene; give one --degree")
    for scene in inputs.scenes:  # before the first measurement, which may take hours
        if not is_folder(scene):
            with open_scene_file(scene):
                pass
    from kissgs.benchmark.comparison import BenchmarkPlan
    from kissgs.benchmark.scaling_plot import scaling_plot
    from kissgs.cli.scaling_tables import scaling_tables

    plan = BenchmarkPlan(
        presets=all_settings(presets, changes),
        external_codecs=external.formats,
        splat_transform=command_words(external.splat_transform),
        sog_iterations=external.sog_iterations,
        repeats=repeats,
        errors=evaluate,
        evaluate=evaluate or inputs.views is not None,
        views=inputs.views,
        threads=inputs.threads,
    )
    sources: list[tuple[Path | int, str | None]] = [(degree, None) for degree in dict.fromkeys(degrees or [3])]
    if inputs.scenes:
        sources = list(zip(inputs.scenes, distinct_names(inputs.scenes), strict=True))
    rows: list[Measurement] = []
    failed: list[FailedMeasurement] = []
    interrupt = None
    try:
        _measure(sources, list(dict.fromkeys(counts)), plan, rows, failed)
    except Interrupted as error:  # what is measured may have taken hours
        interrupt = error
    return BenchOutput(
        rows=[*(row.as_dict() for row in rows), *(row.as_dict() for row in failed)],
        table=scaling_tables(rows, failed),
        draw=partial(scaling_plot, rows) if rows else None,
        failures=[f"{row.scene}, {row.codec}, {row.gaussians:,} Gaussians: {row.failure}" for row in failed],
        interrupt=interrupt,
    )


def _measure(
    sources: list[tuple[Path | int, str | None]],
    counts: list[int],
    plan: BenchmarkPlan,
    rows: list[Measurement],
    failed: list[FailedMeasurement],
) -> None:
    """Add the measurements of all scenes to ``rows``, and those that failed to ``failed``."""
    from kissgs.benchmark.scaling import FailedMeasurement, measure_scaling
    from kissgs.cli.console import progress_bar

    with progress_bar(False) as progress:
        for source, name in sources:
            found = measure_scaling(source, counts, plan, name=name, announce=announce, progress=progress)
            with closing(found):
                for row in found:
                    if isinstance(row, FailedMeasurement):
                        failed.append(row)
                    else:
                        rows.append(row)
