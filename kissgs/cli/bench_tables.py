"""What ``kissgs bench`` prints: presets and peers as tables, within 120 columns. Nothing here computes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.benchmark.ablation import Ablated
from kissgs.benchmark.results import Equal, Figure, Measured
from kissgs.evaluation.results import Evaluation, format_metric

FIGURES: dict[Figure, str] = {"original": "to the original", "photographs": "to photographs"}


def bench_tables(rows: Sequence[Measured], equals: Sequence[Equal]) -> RenderableType:
    """For every scene: all figures, seconds by stage, bytes by file, and what is said of equal quality."""
    blocks: list[RenderableType] = []
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        whole = [row for row in here if row.quality_offset_db is None and not row.is_peer]
        repeats = max(len(row.runs) for row in here)
        medians = f"; times are medians of {repeats} runs, memory the most" if repeats > 1 else ""
        blocks += [Text.assemble((scene, "bold"), f"  {_counts(here)} Gaussians{medians}"), _figures(here)]
        for count in dict.fromkeys(row.gaussians for row in whole):
            of = [row for row in whole if row.gaussians == count]
            at, names = ("" if len(of) == len(whole) else f", {count:,}"), [row.name for row in of]
            blocks.append(_columns(f"seconds{at}", names, [row.took.stage_seconds for row in of], "{:.2f}"))
            blocks.append(_columns(f"bytes{at}", names, [row.file_bytes for row in of], "{:,}"))
        blocks += [Text(_equal(equal)) for equal in equals if equal.scene == scene]
        blocks += [Text(_unsteady(row), style="red") for row in here if not row.steady]
    return Group(*blocks)


def ablation_table(rows: Sequence[tuple[str, Ablated]]) -> RenderableType:
    """For every scene: KISS-GS with a part left out beside what it published, then changes of settings."""
    blocks: list[RenderableType] = []
    for scene, name in dict.fromkeys((scene, row.table) for scene, row in rows):
        here = [row for of, row in rows if (of, row.table) == (scene, name)]
        published = any(row.published_change is not None for row in here)
        photographed = any(row.photo_psnr is not None for row in here)
        equal = any(row.equal_change is not None for row in here)
        heads = [
            *("bytes", "change"),
            *(("at equal\nPSNR",) if equal else ()),
            "PSNR to\noriginal",
            *(("PSNR to\nphoto",) if photographed else ()),
            *(("published\nbytes", "published\nPSNR") if published else ("CPU s",)),
        ]
        table = Table("left out" if published else "changed", *map(_right, heads), box=None, pad_edge=False)
        for row in here:
            told = (
                (_share(row.published_change), _signed(row.published_psnr))
                if published
                else (f"{row.cpu_seconds:.1f}",)
            )
            table.add_row(
                *(row.name, f"{row.bytes:,}", _share(row.change)),
                *((_share(row.equal_change),) if equal else ()),
                _signed(row.psnr_change) if row.name != "nothing" else format_metric(row.psnr, 2),
                *((_photo(row),) if photographed else ()),
                *told,
            )
        blocks += [Text.assemble((scene, "bold"), f"  {name}"), table]
    return Group(*blocks)


def _photo(row: Ablated) -> str:
    if row.photo_psnr is None:
        return ""
    return format_metric(row.photo_psnr, 2) if row.name == "nothing" else _signed(row.photo_change)


def _share(change: float | None) -> str:
    return "" if change is None else f"{100 * change:+.1f} %"


def _signed(change: float | None) -> str:
    return "" if change is None else format_metric(change, 2, signed=True)


def _counts(rows: Sequence[Measured]) -> str:
    return " and ".join(f"{count:,}" for count in dict.fromkeys(row.gaussians for row in rows))


def _names(rows: Sequence[Measured]) -> list[str]:
    """Of encoders, with the number of Gaussians where that is not always the same."""
    several = len({row.gaussians for row in rows}) > 1
    return [f"{row.name}, {row.gaussians:,}" if several else row.name for row in rows]


def _figures(rows: Sequence[Measured]) -> Table:
    seen = [row.pictures for row in rows if row.pictures is not None]
    photographed = any(pictures.mean.reference is not None for pictures in seen)
    heads = [
        *("B per\nGaussian", "bytes", "encode\nCPU s", "wall\ns", "decode\nCPU s", "peak\nMB"),
        *("rotation\n°", "log-\nscale", "SH\nRMSE"),
        *(("PSNR to\nphoto", "change\ndB", "SSIM") if photographed else ()),
        *(("PSNR to\noriginal", "SSIM") if seen else ()),
        *(("worst\nview",) if seen and not photographed else ()),
    ]
    table = Table("encoder", *map(_right, heads), box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for name, row in zip(_names(rows), rows, strict=True):
        took, errors = row.took, row.errors
        cells = (
            *(f"{row.bytes / max(row.gaussians, 1):.2f}", f"{row.bytes:,}", f"{took.encode_cpu_seconds:.1f}"),
            *(f"{took.encode_seconds:.1f}", f"{took.decode_cpu_seconds:.2f}", f"{took.peak_memory / 1e6:.0f}"),
            *(f"{errors.rotation_degrees.rmse:.2f}", f"{errors.scales.rmse:.3f}", f"{errors.shN.rmse:.4f}"),
        )
        table.add_row(name, *cells, *_picture_cells(row.pictures, photographed))
    return table


def _picture_cells(evaluation: Evaluation | None, photographed: bool) -> list[str]:
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


def _columns(what: str, names: Sequence[str], parts: Sequence[Mapping[str, float]], form: str) -> Table:
    """A column for each encoder, a row for each part, and their sum."""
    table = Table(what, *map(_right, names), box=None, pad_edge=False)
    for part in dict.fromkeys(part for each in parts for part in each):
        table.add_row(part, *(form.format(each[part]) if part in each else "" for each in parts))
    table.add_row("together", *(form.format(sum(each.values())) for each in parts), style="bold")
    return table


def _equal(equal: Equal) -> str:
    at = f"at the PSNR of .{equal.peer} {FIGURES[equal.figure]} ({equal.psnr:.2f} dB)"
    if equal.bytes is None or equal.ratio is None:
        return f"{at}: beyond the curve of {equal.preset}; give more fidelities"
    return f"{at}: {equal.preset} {equal.bytes:,.0f} bytes, {equal.ratio:.3f} of its {equal.peer_bytes:,}"


def _unsteady(row: Measured) -> str:
    sizes: Iterable[str] = dict.fromkeys(f"{run.bytes:,}" for run in row.runs)
    return f"{row.name} is not the same every time: {', '.join(sizes)} bytes"


def _right(title: str) -> Column:
    return Column(title, justify="right")
