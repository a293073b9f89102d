"""``kissgs bench`` and ``warmup``: measurements of a scene and of this machine."""

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
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer
from typer import Argument, Option

from kissgs.cli.files import progress_bar, show, write_output
from kissgs.cli.options import ForceOption, ViewsOption, chosen, open_views, output_option
from kissgs.core.context import has_torch
from kissgs.core.errors import KissgsError, OutputError, UnsupportedError

if TYPE_CHECKING:
    from rich.table import Table

    from kissgs.cameras.views import Views
    from kissgs.evaluation.results import Evaluation
    from kissgs.formats import ContainerName
    from kissgs.pipeline.pipeline import Report
    from kissgs.settings import Settings


# ``kissgs warmup``: compile all kernels in advance, and measure the speed of the machine.

SAMPLE_COUNT = 20_000  # Gaussians of the synthetic scene that is encoded to measure the speed


def warmup() -> None:
    """Compile and cache all kernels, and measure the speed of this machine, by which --time chooses what to do."""
    from kissgs.compaction import merging  # noqa: F401
    from kissgs.core import numba_kernels
    from kissgs.pipeline.limited_time import save_speed
    from kissgs.pipeline.pipeline import compress
    from kissgs.planning import kernels, kmeans_kernels  # noqa: F401
    from kissgs.rendering import ssim_kernels  # noqa: F401
    from kissgs.rendering.cpu import frame, neighbours  # noqa: F401
    from kissgs.settings import Preset, Settings
    from kissgs.synthetic import sample_scene

    if has_torch():  # without it nothing is trained
        from kissgs.finetuning import planes  # noqa: F401
        from kissgs.training import model  # noqa: F401

    with progress_bar(False) as progress:
        for number, kernel in enumerate(numba_kernels.kernels):
            progress("kernels", number / len(numba_kernels.kernels))
            kernel.load()
        scene, settings = sample_scene(SAMPLE_COUNT), Settings(preset=Preset.BALANCED)
        compress(scene, settings=settings)  # loads what is needed
        started = time.perf_counter()
        compress(scene, settings=settings)
        try:
            save_speed(time.perf_counter() - started, settings.preset, SAMPLE_COUNT)
        except OutputError as error:
            sys.stderr.write(f"kissgs: the speed of this machine is not saved, --time assumes the usual one: {error}\n")


# ``kissgs bench``: bytes, seconds and quality of a scene with each preset and in limited times.
#
# The studies in ``bench/`` of the source repository use :func:`measured`, too.

Measured = TypeVar("Measured")

Row = dict[str, Any]  # a line of the CSV file: bytes, seconds and decibels by name
TIMES = ("5s", "30s", "2min")  # default time limits


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """A scene that was compressed, decompressed and evaluated."""

    report: Report  # with the times from file to zip
    decode_seconds: float  # from there to arrays
    decode_cpu_seconds: float
    peak_memory: int  # of both, bytes; 0 where the system does not report it
    evaluation: Evaluation


def bench(
    scene: Annotated[Path, Argument(metavar="SCENE", help="Scene of any format that kissgs reads.")],
    presets: Annotated[
        list[str] | None, Option("--preset", "-p", help="Preset to measure; repeatable. Default, without --time: all.")
    ] = None,
    times: Annotated[
        list[str] | None,
        Option(
            "--time",
            metavar="TIME",
            help="Time limit to measure; repeatable. Default, without --preset: 5s, 30s and 2min.",
        ),
    ] = None,
    views: ViewsOption = None,
    output: Annotated[
        Path | None, output_option("Write the table as CSV, and beside it a plot as PNG.", metavar="FILE.csv")
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
    runs |= {f"in {limit}": chosen("balanced", None, time=limit) for limit in times or []}
    files = {} if output is None else _outputs(output, force)
    capture = open_views(views, scene)
    rows, failed = list[Row](), False
    try:
        with progress_bar(False) as progress:
            for done, (name, settings) in enumerate(runs.items()):
                progress("measure", done / len(runs), name)
                try:
                    rows.append(_row(name, measured(scene, settings, views=capture)))
                except KissgsError as error:
                    if not rows:
                        raise
                    failed = True
                    sys.stderr.write(f"kissgs: {name}: {error}\n")
    finally:  # after an interrupt too, since these may have taken hours
        if rows:
            try:
                show(_table(rows))
            finally:  # what cannot be printed is written nevertheless
                for path, content in files.items():
                    write_output(path, content(rows), force=force)
    if failed:
        raise typer.Exit(2)


def _outputs(table: Path, force: bool) -> dict[Path, Callable[[Sequence[Row]], bytes]]:
    """Return the files to write, and what makes their content; check before a long measurement that they can be."""
    from kissgs.io.files import refuse_existing

    if table.suffix.lower() != ".csv":
        raise OutputError(f"{table!s:.100} is no name of a table; end it in .csv")
    files: dict[Path, Callable[[Sequence[Row]], bytes]] = {table: _csv, table.with_suffix(".png"): _png}
    if find_spec("matplotlib") is None:
        sys.stderr.write("kissgs: no plot without matplotlib, which is missing: pip install matplotlib\n")
        del files[table.with_suffix(".png")]
    for path in files:
        refuse_existing(path, overwrite=force)
    return files


def measured(
    scene: Path, settings: Settings, *, container: ContainerName = "sogxt", views: Views | None = None
) -> Measurement:
    """Compress, decompress and evaluate a scene in a process of its own, with ``views`` for both."""
    return isolated(partial(_measure, scene, settings, container, views), str(scene))


def _measure(scene: Path, settings: Settings, container: ContainerName, views: Views | None) -> Measurement:
    from kissgs.core.context import peak_memory
    from kissgs.evaluation.evaluate import evaluate
    from kissgs.pipeline.pipeline import compress
    from kissgs.pipeline.scene_files import decompress, load

    result = compress(scene, settings=settings, container=container, views=views)
    archive = result.to_zip()
    wall, cpu = time.perf_counter(), time.process_time()
    decoded = decompress(archive)
    wall, cpu, peak = time.perf_counter() - wall, time.process_time() - cpu, peak_memory()
    return Measurement(
        report=result.report,
        decode_seconds=wall,
        decode_cpu_seconds=cpu,
        peak_memory=peak,
        evaluation=evaluate(load(scene), decoded, views),
    )


def isolated(work: Callable[[], Measured], what: str) -> Measured:
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


def _row(name: str, found: Measurement) -> Row:
    report, evaluation = found.report, found.evaluation
    mean, views = evaluation.mean, [view.comparison for view in evaluation.views]
    changes = [view.change for view in views if view.change is not None]
    return {
        "name": name,  # the preset, or the time limit as "in 30s"
        "bytes": report.container_bytes,
        "bytes_per_gaussian": report.bytes_per_gaussian,
        "seconds": sum(report.seconds.values()),  # wall time of encoding
        "cpu_seconds": report.cpu_seconds,  # of encoding, all threads
        "decode_seconds": found.decode_seconds,
        "peak_memory": found.peak_memory,  # of encoding and decoding
        "against": evaluation.against,  # "photos", or "renderings" of the scene
        "psnr": mean.candidate.psnr,  # mean over views
        "psnr_change": mean.change,  # from the PSNR of the scene itself to photographs
        "ssim": mean.candidate.ssim,  # mean over views
        # The largest loss to a photograph, negative; without photographs the lowest PSNR.
        "worst_view": min(changes or [view.candidate.psnr for view in views]),
    }


def _table(rows: Sequence[Row]) -> Table:
    """Return the table for the terminal, at most 120 columns wide."""
    from kissgs.cli.tables import table_of
    from kissgs.evaluation.results import format_metric

    photos = rows[0]["against"] == "photos"
    signed = partial(format_metric, digits=2, signed=True)
    columns: dict[str, tuple[str, Callable[[Any], str]]] = {
        "name": ("", str),
        "bytes": ("bytes", "{:,}".format),
        "bytes_per_gaussian": ("per\nGaussian", "{:.2f}".format),
        "seconds": ("encode\nwall s", "{:.1f}".format),
        "cpu_seconds": ("encode\nCPU s", "{:.1f}".format),
        "decode_seconds": ("decode\ns", "{:.2f}".format),
        "peak_memory": ("peak\nMB", lambda count: f"{count / 1e6:.0f}"),
        "psnr": ("PSNR to\nphotos" if photos else "PSNR", partial(format_metric, digits=2)),
        **({"psnr_change": ("change\ndB", signed)} if photos else {}),
        "ssim": ("SSIM", partial(format_metric, digits=4)),
        "worst_view": ("worst\nchange", signed) if photos else ("worst\nview", partial(format_metric, digits=2)),
    }
    cells = [[text(row[name]) for name, (_, text) in columns.items()] for row in rows]
    return table_of([head for head, _ in columns.values()], cells)


def _csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _png(rows: Sequence[Row]) -> bytes:
    """Plot quality over size."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for row in rows:  # open squares, so that a preset shows where a time limit has chosen the same
        limited = row["name"].startswith("in ")
        form = {"marker": "s", "ms": 10, "fillstyle": "none"} if limited else {"marker": "o"}
        psnr = row["psnr"] if math.isfinite(row["psnr"]) else math.nan
        axes.plot(row["bytes"] / 1000, psnr, linestyle="", label=f"{row['name']}: {row['seconds']:.1f} s", **form)
    images = "photographs" if rows[0]["against"] == "photos" else "renderings of the scene"
    axes.set(xscale="log", xlabel="kilobytes", ylabel=f"PSNR to {images}, dB")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:,g}")
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right center")
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150)
    return file.getvalue()
