"""Measurements of codecs as tables for the terminal, within 120 columns. This module only formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.benchmark.ablation import AblationRow
from kissgs.benchmark.results import EqualPsnr, Measurement, PsnrTarget, curve_name
from kissgs.evaluation.attributes import AttributeErrors
from kissgs.evaluation.metric_text import format_metric
from kissgs.evaluation.results import Evaluation

TARGETS: dict[PsnrTarget, str] = {"original": "to the original", "photographs": "to photographs"}


def bench_tables(rows: Sequence[Measurement], equals: Sequence[EqualPsnr]) -> RenderableType:
    """Return, for each scene, tables of all metrics, of seconds by stage and bytes by file, and bytes at equal PSNR."""
    blocks: list[RenderableType] = []
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        whole = [row for row in here if row.quality_offset_db is None and not row.is_external]
        repeats = max(len(row.runs) for row in here)
        medians = f"; times are medians of {repeats} runs, memory is the maximum" if repeats > 1 else ""
        blocks += [Text.assemble((scene, "bold"), f"  {_counts(here)} Gaussians{medians}"), metrics_table(here)]
        for count in dict.fromkeys(row.gaussians for row in whole):
            group = [row for row in whole if row.gaussians == count]
            suffix, names = ("" if len(group) == len(whole) else f", {count:,}"), [row.name for row in group]
            seconds = [row.median_run.stage_seconds for row in group]
            blocks.append(columns_table(f"seconds{suffix}", names, seconds, "{:.2f}"))
            blocks.append(columns_table(f"bytes{suffix}", names, [row.file_bytes for row in group], "{:,}"))
        blocks += [Text(_equal(equal)) for equal in equals if equal.scene == scene]
        blocks += [Text(not_reproducible(row), style="red") for row in here if not row.reproducible]
    return Group(*blocks)


def ablation_table(rows: Sequence[tuple[str, AblationRow]]) -> RenderableType:
    """Return, for each scene, the ablation of KISS-GS beside published values, and the ablations of presets."""
    blocks: list[RenderableType] = []
    for scene, name in dict.fromkeys((scene, row.table) for scene, row in rows):
        here = [row for row_scene, row in rows if (row_scene, row.table) == (scene, name)]
        published = any(row.published_bytes_change is not None for row in here)
        photographed = any(row.photo_psnr is not None for row in here)
        equal = any(row.equal_psnr_change is not None for row in here)
        heads = [
            *("bytes", "change"),
            *(("at equal\nPSNR",) if equal else ()),
            "PSNR to\noriginal",
            *(("PSNR to\nphoto",) if photographed else ()),
            *(("published\nbytes", "published\nPSNR") if published else ("CPU s",)),
        ]
        table = Table("left out" if published else "changed", *map(_right, heads), box=None, pad_edge=False)
        for row in here:
            last = (
                (_share(row.published_bytes_change), _signed(row.published_psnr_change))
                if published
                else (f"{row.cpu_seconds:.1f}",)
            )
            table.add_row(
                row.name,
                f"{row.bytes:,}",
                _share(row.bytes_change),
                *((_share(row.equal_psnr_change),) if equal else ()),
                _signed(row.psnr_change) if row.name != "nothing" else format_metric(row.psnr, 2),
                *((_photo(row),) if photographed else ()),
                *last,
            )
        blocks += [Text.assemble((scene, "bold"), f"  {name}"), table]
    return Group(*blocks)


def _photo(row: AblationRow) -> str:
    if row.photo_psnr is None:
        return ""
    return format_metric(row.photo_psnr, 2) if row.name == "nothing" else _signed(row.photo_psnr_change)


def _share(change: float | None) -> str:
    return "" if change is None else f"{100 * change:+.1f} %"


def _signed(change: float | None) -> str:
    return "" if change is None else format_metric(change, 2, signed=True)


def _counts(rows: Sequence[Measurement]) -> str:
    return " and ".join(f"{count:,}" for count in dict.fromkeys(row.gaussians for row in rows))


def _names(rows: Sequence[Measurement]) -> list[str]:
    """Return the names of the codecs, with the number of Gaussians if it differs between rows."""
    several = len({row.gaussians for row in rows}) > 1
    return [f"{row.name}, {row.gaussians:,}" if several else row.name for row in rows]


def metrics_table(rows: Sequence[Measurement]) -> Table:
    """Return a table of sizes, times, memory, errors and quality, a row for each measurement."""
    evaluations = [row.evaluation for row in rows if row.evaluation is not None]
    photographed = any(evaluation.mean.reference is not None for evaluation in evaluations)
    compared = any(row.errors is not None for row in rows)
    heads = [
        *("bytes/\nGauss.", "bytes", "encode\nCPU s", "wall\ns", "decode\nCPU s"),
        *("peak\nMB", "peak/\nGauss.", "peak/\nscene"),
        *(("rot.\n°", "log-\nscale", "SH\nRMSE") if compared else ()),
        *(("PSNR to\nphoto", "change\ndB", "SSIM") if photographed else ()),
        *(("PSNR to\noriginal", "SSIM") if evaluations else ()),
        *(("worst\nview",) if evaluations and not photographed else ()),
    ]
    table = Table("codec", *map(_right, heads), box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name, row in zip(_names(rows), rows, strict=True):
        run = row.median_run
        cells = (
            *(f"{row.bytes / max(row.gaussians, 1):.2f}", f"{row.bytes:,}", f"{run.encode_cpu_seconds:.1f}"),
            *(f"{run.encode_seconds:.1f}", f"{run.decode_cpu_seconds:.2f}"),
            *(f"{run.peak_memory / 1e6:.0f}", f"{row.peak_memory_per_gaussian:.0f}", f"{row.peak_memory_ratio:.1f}"),
            *_error_cells(row.errors, compared),
        )
        table.add_row(name, *cells, *_evaluation_cells(row.evaluation, photographed))
    return table


def _error_cells(errors: AttributeErrors | None, compared: bool) -> list[str]:
    if errors is None:
        return [""] * 3 if compared else []
    return [f"{errors.rotation_degrees.rmse:.2f}", f"{errors.scales.rmse:.3f}", f"{errors.shN.rmse:.4f}"]


def _evaluation_cells(evaluation: Evaluation | None, photographed: bool) -> list[str]:
    if evaluation is None:
        return []
    mean = evaluation.mean
    change = "" if mean.change is None else format_metric(mean.change, 2, signed=True)
    to_photo = [format_metric(mean.candidate.psnr, 2), change, format_metric(mean.candidate.ssim, 4)]
    to_original = [
        format_metric(mean.candidate_vs_reference.psnr, 2),
        format_metric(mean.candidate_vs_reference.ssim, 4),
    ]
    if photographed:
        return [*to_photo, *to_original]
    return [*to_original, format_metric(evaluation.worst.comparison.candidate_vs_reference.psnr, 2)]


def columns_table(
    title: str,
    names: Sequence[str],
    parts: Sequence[Mapping[str, float]],
    form: str,
    total: Callable[[Iterable[float]], float] = sum,
) -> Table:
    """Return a table with a column for each name, a row for each part, and a row of totals, by default of sums."""
    table = Table(title, *map(_right, names), box=None, pad_edge=False)
    for part in dict.fromkeys(part for each in parts for part in each):
        table.add_row(part, *(form.format(each[part]) if part in each else "" for each in parts))
    table.add_row("total", *(form.format(total(each.values())) for each in parts), style="bold")
    return table


def _equal(equal: EqualPsnr) -> str:
    prefix = f"at the PSNR of {equal.reference} {TARGETS[equal.target]} ({equal.psnr:.2f} dB)"
    name = curve_name(equal.preset, equal.container)
    if equal.bytes is None or equal.ratio is None:
        return f"{prefix}: beyond the curve of {name}; give more values of --quality-offset"
    return f"{prefix}: {name} {equal.bytes:,.0f} bytes, {equal.ratio:.3f} of its {equal.reference_bytes:,}"


def not_reproducible(row: Measurement) -> str:
    """Return the message about a measurement whose runs have different bytes."""
    sizes: Iterable[str] = dict.fromkeys(f"{run.bytes:,}" for run in row.runs)
    return f"{row.name} differs between runs: {', '.join(sizes)} bytes"


def _right(title: str) -> Column:
    return Column(title, justify="right")
