"""``kissgs evaluate``, ``bench``, ``sample`` and ``warmup``: measurements of scenes and of this machine."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, cast

import typer

from kissgs.cli.files import print_json, progress_bar, say_notes, show, write_output
from kissgs.cli.options import (
    CaptureOptions,
    ForceOption,
    SceneOptions,
    ViewsOption,
    choice,
    chosen,
    device_of,
    open_views,
    with_option_groups,
)
from kissgs.core.errors import KissgsError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from rich.table import Table

    from kissgs.cameras.views import Views
    from kissgs.core.progress import Progress
    from kissgs.evaluation.html import ReportScene
    from kissgs.evaluation.results import Evaluation
    from kissgs.formats import ContainerName
    from kissgs.pipeline.pipeline import Report
    from kissgs.settings import Settings


# ``kissgs sample``: write a synthetic scene for tests and demos.


def sample(
    output: Annotated[Path, typer.Argument(help="Output NAME.ply; other formats as for convert.")],
    gaussians: Annotated[int, typer.Option(min=0, help="Number of Gaussians.")] = 60_000,
    degree: Annotated[int, typer.Option(min=0, max=3, help="Degree of the spherical harmonics.")] = 3,
    force: ForceOption = False,
) -> None:
    """Write a synthetic sample scene: shiny, textured objects on a table."""
    from kissgs.pipeline.scene_files import save
    from kissgs.synthetic import sample_scene

    save(sample_scene(gaussians, sh_degree=degree), output, overwrite=force)


# ``kissgs warmup``: compile all kernels in advance, and measure the speed of the machine.

SAMPLE_COUNT = 20_000
"""Gaussians of the synthetic scene that is encoded to measure the speed."""


def warmup() -> None:
    """Compile and cache all kernels, and measure the speed of this machine, by which --time chooses what to do."""
    from kissgs.compaction import merging  # noqa: F401
    from kissgs.core import numba_kernels
    from kissgs.planning import kernels, kmeans_kernels, rdo_kernels  # noqa: F401
    from kissgs.rendering import ssim_kernels  # noqa: F401
    from kissgs.rendering.cpu import frame, neighbours  # noqa: F401

    if find_spec("torch"):  # without it nothing is trained
        from kissgs.finetuning import planes  # noqa: F401
        from kissgs.training import model  # noqa: F401

    with progress_bar(False) as progress:
        for number, kernel in enumerate(numba_kernels.kernels):
            progress("kernels", number / len(numba_kernels.kernels))
            kernel.load()
        try:
            _measure_speed()
        except OutputError as error:
            sys.stderr.write(f"kissgs: the speed of this machine is not saved, --time assumes the usual one: {error}\n")


def _measure_speed() -> None:
    """Encode a synthetic scene twice, the first time to load what is needed, and save the time of the second."""
    from kissgs.pipeline.limited_time import save_speed
    from kissgs.pipeline.pipeline import compress
    from kissgs.settings import Preset, Settings
    from kissgs.synthetic import sample_scene

    scene, settings = sample_scene(SAMPLE_COUNT), Settings(preset=Preset.BALANCED)
    compress(scene, settings=settings)
    started = time.perf_counter()
    compress(scene, settings=settings)
    save_speed(time.perf_counter() - started, settings.preset, SAMPLE_COUNT)


# ``kissgs evaluate``: compare a scene with its original, and with photographs.


@with_option_groups
def evaluate(
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="Original scene, of any format that kissgs reads.")
    ],
    candidate: Annotated[
        Path, typer.Argument(metavar="CANDIDATE", help="Scene to evaluate, of any format that kissgs reads.")
    ],
    *,
    capture: CaptureOptions,
    split: Annotated[
        str, typer.Option(help="Views of --views to use: test (held-out), train or all.", show_default=True)
    ] = "test",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the virtual cameras.")] = 0,
    distance: Annotated[
        float,
        typer.Option(metavar="FACTOR", help="Move the virtual cameras to this many times their distance, such as 4."),
    ] = 1.0,
    flip: Annotated[bool, typer.Option("--flip", help="Also measure FLIP; needs the extra kissgs\\[flip].")] = False,
    lpips: Annotated[
        bool, typer.Option("--lpips", help="Also measure LPIPS; needs the extra kissgs\\[lpips].")
    ] = False,
    html: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write an HTML report with renderings of both scenes and error maps."),
    ] = None,
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON report.")] = False,
    common: SceneOptions,
) -> None:
    """Compare the renderings of a scene with those of its original, and with photographs: PSNR, SSIM and MS-SSIM."""
    from kissgs.core.positions import with_origin
    from kissgs.core.progress import Context
    from kissgs.evaluation.evaluate import evaluate as measure
    from kissgs.evaluation.html import html_report
    from kissgs.evaluation.results import Split
    from kissgs.io.files import atomic_file, refuse_existing

    quiet, threads = common.quiet or as_json, common.threads
    used_split = cast(Split, choice("--split", split, Split))
    device = device_of(capture.device)
    if html is not None:
        refuse_existing(html, overwrite=force)
    views = capture.open()
    with progress_bar(quiet) as progress:
        sides = _sides_of((reference, candidate), common, progress)
        sides[1] = replace(sides[1], splats=with_origin(sides[1].splats, sides[0].splats.origin))
        scenes = sides[0].splats, sides[1].splats
        result = measure(
            *scenes,
            views,
            split=used_split,
            seed=seed,
            distance=distance,
            flip=flip,
            lpips=lpips,
            device=device,
            threads=threads,
            progress=progress,
        )
        if html is not None:
            page = html_report(result, sides[0], sides[1], Context(threads, device, progress))
            with atomic_file(html, overwrite=force) as file:
                file.write(page.encode(errors="replace"))  # file names may be invalid UTF-8
    if not common.quiet:
        _warn_of_differences(sides)
    sizes = {"reference": sides[0].bytes, "candidate": sides[1].bytes}
    if as_json:
        print_json({**result.as_dict(), "bytes": sizes})
    elif not quiet:
        from kissgs.cli.tables import evaluation_table

        show(evaluation_table(result, sides[0], sides[1], asked=split))
        if html is not None:
            show(f"\nreport  {html}")


def _sides_of(paths: Sequence[Path], common: SceneOptions, progress: Progress) -> list[ReportScene]:
    """Read the scenes to compare; the level of detail concerns those that have levels, which one of them must."""
    from kissgs.evaluation.html import ReportScene
    from kissgs.pipeline.scene_files import has_levels, load, stored_bytes

    streamed = [path for path in paths if has_levels(path)]
    sides = []
    for path in paths:
        reading = asdict(common.reading())
        if streamed and path not in streamed:
            reading["level"] = 0
        splats = load(path, threads=common.threads, progress=progress, **reading)
        sides.append(ReportScene(name=path.name, splats=splats, bytes=stored_bytes(path)))
    return sides


def _warn_of_differences(sides: list[ReportScene]) -> None:
    for side in sides:
        say_notes(side.name, side.splats.notes, quiet=False)
    if sides[0].splats.antialiased != sides[1].splats.antialiased:
        marked, other = sides if sides[0].splats.antialiased else sides[::-1]
        sys.stderr.write(
            f"kissgs: {marked.name} is marked as trained with antialiasing, and {other.name} is not; each is drawn so "
            "(for both: --antialiased or --classic)\n"
        )


# ``kissgs bench``: bytes, seconds and quality of a scene with each preset and in limited times.
#
# The studies behind the documentation's figures are in ``bench/`` of the source repository, and use :func:`measured`.

Result = TypeVar("Result")

TIMES = ("5s", "30s", "2min")
"""Default time limits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A scene that was compressed, decompressed and evaluated."""

    report: Report  # with the times from file to zip
    decode_seconds: float  # from there to arrays
    decode_cpu_seconds: float
    peak_memory: int  # of both, bytes; 0 where the system does not report it
    evaluation: Evaluation


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """A row of the table, and a line of the CSV file; bytes, seconds and decibels."""

    name: str  # the preset, or the time limit as "in 30s"
    bytes: int
    bytes_per_gaussian: float
    seconds: float  # wall time of encoding
    cpu_seconds: float  # of encoding, all threads
    decode_seconds: float
    peak_memory: int  # of encoding and decoding
    against: str  # "photos", or "renderings" of the scene
    psnr: float  # mean over views
    psnr_change: float | None  # from the PSNR of the scene itself to photographs
    ssim: float  # mean over views
    worst_view: float  # largest loss to a photograph, negative; without photographs the lowest PSNR


def bench(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene of any format that kissgs reads.")],
    presets: Annotated[
        list[str] | None,
        typer.Option("--preset", "-p", help="Preset to measure; repeatable. Default, without --time: all."),
    ] = None,
    times: Annotated[
        list[str] | None,
        typer.Option(
            "--time",
            metavar="TIME",
            help="Time limit to measure; repeatable. Default, without --preset: 5s, 30s and 2min.",
        ),
    ] = None,
    views: ViewsOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FILE.csv", help="Write the table as CSV, and beside it a plot as PNG."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Measure bytes, seconds, memory and quality of a scene with each preset and in limited times.

    Each is compressed, decompressed and evaluated in a process of its own.
    """
    from kissgs.settings import Preset

    if not presets and not times:
        presets, times = list(Preset), list(TIMES)
    runs = {str(name): chosen(name, None) for name in presets or []}
    runs.update({f"in {limit}": chosen("balanced", None, time=limit) for limit in times or []})
    plot = None if output is None else _plot_beside(output, force)
    capture = open_views(views)
    rows, failed = list[Row](), False
    try:
        with progress_bar(False) as progress:
            for done, (name, settings) in enumerate(runs.items()):
                progress("measure", done / len(runs), name)
                try:
                    rows.append(row_of(name, measured(scene, settings, views=capture)))
                except KissgsError as error:
                    if not rows:
                        raise
                    failed = True
                    sys.stderr.write(f"kissgs: {name}: {error}\n")
    finally:  # after an interrupt too, since these may have taken hours
        if rows:
            _print_and_write(rows, output, plot, force)
    if failed:
        raise typer.Exit(2)


def _plot_beside(output: Path, force: bool) -> Path | None:
    """Check that the outputs can be written, before a long measurement; return the path of the plot, if any."""
    from kissgs.io.files import refuse_existing

    if output.suffix.lower() != ".csv":
        raise OutputError(f"{output!s:.100} is no name of a table; end it in .csv")
    refuse_existing(output, overwrite=force)
    if find_spec("matplotlib") is None:
        sys.stderr.write("kissgs: no plot without matplotlib, which is missing: pip install 'kissgs[bench]'\n")
        return None
    refuse_existing(output.with_suffix(".png"), overwrite=force)
    return output.with_suffix(".png")


def measured(
    scene: Path, settings: Settings, *, container: ContainerName = "sogxt", views: Views | None = None
) -> Measurement:
    """Compress, decompress and evaluate a scene in a process of its own, with ``views`` for both."""
    return isolated(partial(_measure, scene, settings, container, views), str(scene))


def _measure(scene: Path, settings: Settings, container: ContainerName, views: Views | None) -> Measurement:
    from kissgs.core.resources import peak_memory
    from kissgs.evaluation.evaluate import evaluate
    from kissgs.pipeline.pipeline import compress
    from kissgs.pipeline.scene_files import decompress, load

    result = compress(scene, settings=settings, container=container, views=views)
    archive = result.to_zip()
    wall, cpu = time.perf_counter(), time.process_time()
    decoded = decompress(archive)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    peak = peak_memory()
    return Measurement(
        report=result.report,
        decode_seconds=wall,
        decode_cpu_seconds=cpu,
        peak_memory=peak,
        evaluation=evaluate(load(scene), decoded, views),
    )


def isolated(work: Callable[[], Result], what: str) -> Result:
    """Call ``work`` in a separate process, so that its times and memory are its own; ``what`` is for error messages."""
    ignore = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for this process, which ends the other
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"), initializer=ignore) as pool:
        try:
            worker = pool.submit(os.getpid).result()
            result = pool.submit(work)
            try:
                return result.result()
            finally:
                if not result.done():
                    with contextlib.suppress(ProcessLookupError):
                        os.kill(worker, signal.SIGTERM)
        except BrokenProcessPool as error:
            raise UnsupportedError(
                f"{what}: the measurement was killed, most likely for lack of memory; free some or give a smaller scene"
            ) from error


def row_of(name: str, found: Measurement) -> Row:
    """Return the row of a measurement."""
    report, evaluation = found.report, found.evaluation
    mean, all_views = evaluation.mean, [view.comparison for view in evaluation.views]
    losses = [change for comparison in all_views if (change := comparison.change) is not None]
    return Row(
        name=name,
        bytes=report.container_bytes,
        bytes_per_gaussian=report.bytes_per_gaussian,
        seconds=sum(report.seconds.values()),
        cpu_seconds=report.cpu_seconds,
        decode_seconds=found.decode_seconds,
        peak_memory=found.peak_memory,
        against=evaluation.against,
        psnr=mean.candidate.psnr,
        psnr_change=mean.change,
        ssim=mean.candidate.ssim,
        worst_view=min(losses) if losses else min(comparison.candidate.psnr for comparison in all_views),
    )


def _print_and_write(rows: Sequence[Row], output: Path | None, plot: Path | None, force: bool) -> None:
    """Print the table, write it and plot it; what cannot be printed is written nevertheless."""
    try:
        show(_table(rows))
    finally:
        if output is not None:
            text = io.StringIO(newline="")
            writer = csv.DictWriter(text, list(asdict(rows[0])))
            writer.writeheader()
            writer.writerows(map(asdict, rows))
            write_output(output, text.getvalue().encode(), force=force)
        if plot is not None:
            write_output(plot, _png(rows), force=force)


def _table(rows: Sequence[Row]) -> Table:
    """Return the table for the terminal, at most 120 columns wide."""
    from rich.table import Column, Table

    from kissgs.evaluation.results import format_metric

    photos = rows[0].against == "photos"
    heads = [
        *("bytes", "per\nGaussian", "encode\nwall s", "encode\nCPU s", "decode\ns", "peak\nMB"),
        *(("PSNR to\nphotos", "change\ndB") if photos else ("PSNR",)),
        *("SSIM", "worst\nchange" if photos else "worst\nview"),
    ]
    table = Table("", *(Column(head, justify="right") for head in heads), box=None, pad_edge=False)
    for row in rows:
        table.add_row(
            row.name,
            *(f"{row.bytes:,}", f"{row.bytes_per_gaussian:.2f}", f"{row.seconds:.1f}", f"{row.cpu_seconds:.1f}"),
            *(f"{row.decode_seconds:.2f}", f"{row.peak_memory / 1e6:.0f}", format_metric(row.psnr, 2)),
            *(() if row.psnr_change is None else (format_metric(row.psnr_change, 2, signed=True),)),
            *(format_metric(row.ssim, 4), format_metric(row.worst_view, 2, signed=photos)),
        )
    return table


def _png(rows: Sequence[Row]) -> bytes:
    """Plot quality over size, and size over time."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(11, 4.8), layout="constrained")
    quality, speed = figure.subplots(1, 2)
    for n, row in enumerate(rows):  # open squares, so that a preset shows where a time limit has chosen the same
        style = (
            {"marker": "s", "facecolors": "none", "s": 90}
            if row.name.startswith("in ")
            else {"marker": "o", "facecolors": f"C{n}", "s": 40}
        )
        at = row.bytes / 1000, row.seconds, row.psnr if math.isfinite(row.psnr) else math.nan
        quality.scatter(at[0], at[2], edgecolors=f"C{n}", label=row.name, **style)
        speed.scatter(at[1], at[0], edgecolors=f"C{n}", **style)
    images = "photographs" if rows[0].against == "photos" else "renderings of the scene"
    quality.set(xlabel="kilobytes", ylabel=f"PSNR to {images}, dB")
    speed.set(xlabel="encoding, seconds", ylabel="kilobytes", ylim=(0, 1.15 * max(row.bytes for row in rows) / 1000))
    for axes in (quality, speed):
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:,g}")
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.legend(loc="outside right center")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
