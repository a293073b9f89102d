"""What the command line prints: reports as tables. Nothing here computes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.compaction.result import CompactionReport
from kissgs.evaluation.results import Evaluation, spell
from kissgs.finetuning.result import FinetuneReport
from kissgs.pipeline.inspect import Info
from kissgs.pipeline.report import Report
from kissgs.pipeline.trial import Trial

CHANGES = {
    "invisible": "left out: opacity 1/255 or less, which no renderer draws",
    "pruned_by_rd": "left out: its bytes would cost more than it shows",
    "clipped_colors": "base colour far outside all others, pulled in so that it does not coarsen theirs",
    "compacted": "left out by compaction: others do their work",
    "non_finite": "removed: NaN or infinite",
    "far_away": "removed: further away than 1e15",
    "infinite_opacities": "opacity logit infinite, set to that of 1e-6 or 1 - 1e-6",
    "saturated_opacities": "opacity logit beyond that of 1e-6 or 1 - 1e-6, set to it",
    "zero_quats": "rotation of length zero, set to none",
    "unnormalised_quats": "rotation normalised",
    "clamped_scales": "log-scale beyond 30, clamped",
    "clamped_sh": "SH coefficient beyond 1e6, clamped",
}


def size(count: float) -> str:
    """Bytes as people read them."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.{2 if count < 10 else 1}f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def report_table(report: Report, target: str) -> RenderableType:
    """The report of one compression."""
    head = Text.assemble(
        (f"{target}", "bold"),
        f"  {size(report.source_bytes)} -> {size(report.container_bytes)}, ",
        (f"{report.ratio:.1f}x smaller", "bold green"),
        f", {report.bytes_per_gaussian:.2f} bytes per Gaussian",
    )
    took = f"{sum(report.seconds.values()):.1f} s ({report.cpu_seconds:.1f} CPU s), {size(report.peak_memory)} at most"
    body = f"{report.count:,} of {report.source_count:,} Gaussians, SH degree {report.sh_degree}; {took}"
    changed = {
        "invisible": report.invisible,
        "pruned_by_rd": report.pruned_by_rd,
        "clipped_colors": report.clipped_colors,
        **report.cleaned.as_dict(),
    }
    searched = [Text(f"searched: {_path(report.trials)}")] if report.trials else []
    pictures = [] if report.evaluation is None else [_pictures(report.evaluation)]
    changes = _changes(changed)
    compaction = [] if report.compaction is None else _compaction(report.compaction)
    finetuning = [] if report.finetuning is None else _finetuning(report.finetuning)
    note = [Text(report.note, style="yellow")] if report.note else []
    told = [*compaction, *searched, *finetuning, *note, *pictures]
    return Group(head, Text(body), *told, parts_table(report.file_bytes, report.count), *changes)


def compaction_table(report: CompactionReport, target: str) -> RenderableType:
    """The report of one compaction."""
    seconds = sum(step.seconds for step in report.steps)
    head = Text.assemble(
        (target, "bold"),
        f"  {report.source_count:,} -> ",
        (f"{report.count:,} Gaussians", "bold green"),
        f", {seconds:.1f} s",
    )
    return Group(head, *_compaction(report))


def _compaction(report: CompactionReport) -> list[RenderableType]:
    """Where the Gaussians went, step by step."""
    lines: list[RenderableType] = [Text(report.note, style="yellow")] if report.note else []
    if report.trials:
        lines.append(Text("searched: " + ", ".join(f"{count:,} lose {drop:.2f} dB" for count, drop in report.trials)))
    if not report.steps:
        return lines
    taught = {"photos": f"photographs: {report.source}", "renderings": f"the scene itself: {report.source}"}
    lines.append(
        Text(
            f"learnt from {taught[report.target_source]}"
            if report.target_source in taught
            else f"scored by {report.source}"
        )
    )
    judged = report.steps[0].bytes is not None
    columns = [_right(name) for name in ("Gaussians", "seconds", *(("PSNR", "SSIM", "bytes") if judged else ()))]
    table = Table("step", *columns, box=None, pad_edge=False)
    for step in report.steps:
        cells = [f"{step.count:,}", f"{step.seconds:.1f}"]
        if step.psnr is not None and step.ssim is not None and step.bytes is not None:
            cells += [spell(step.psnr, 2), spell(step.ssim, 4), f"{step.bytes:,}"]
        table.add_row(step.name, *cells)
    return [*lines, table]


def _finetuning(report: FinetuneReport) -> list[Text]:
    """What it gave, in a line."""
    taught = "photographs" if report.target_source == "photos" else "the scene itself"
    told = (
        f"fine-tuned by {taught}: {size(report.bytes_before)} -> {size(report.bytes_after)}, held-out PSNR "
        f"{spell(report.psnr_before, 2)} -> {spell(report.psnr_after, 2)} dB, in {report.seconds:.0f} s"
    )
    return [Text(told), *([Text(report.note, style="yellow")] if report.note else [])]


def _path(trials: Sequence[Trial]) -> str:
    """What a search tried, in order."""
    told, count = list[str](), next(iter(trials)).count
    for trial in trials:
        if trial.count != count:
            told.append(f"of {trial.count:,} Gaussians")
            count = trial.count
        told.append(trial.spelled())
    return ", ".join(told)


def _pictures(evaluation: Evaluation) -> Text:
    mean = evaluation.mean
    told = f"PSNR {spell(mean.candidate.psnr, 2)} dB, SSIM {spell(mean.candidate.ssim, 4)}"
    if mean.reference is None:
        against = f"to the scene's own renderings from {evaluation.views_used}"
    else:
        own = f"{spell(mean.reference.psnr, 2)} dB, {spell(mean.reference.ssim, 4)}"
        against = f"to {evaluation.views_used}; the scene itself {own}"
    around = evaluation.surroundings
    rest = "" if around is None else f"\nelsewhere: {elsewhere(around)}"
    note = f"; {evaluation.note}" if evaluation.note else ""
    return Text.assemble(f"{told} {against}; {evaluation.extremes}", (note, "yellow"), rest)


def elsewhere(around: Evaluation) -> str:
    """What views beside those of a capture found."""
    mean = f"PSNR {spell(around.mean.candidate_vs_reference.psnr, 2)} dB to the scene's own renderings"
    return f"{mean} from {around.views_used}; {around.extremes}"


def parts_table(parts: Mapping[str, int], count: int) -> Table:
    """Bytes per file or attribute, and what that is per Gaussian."""
    table = Table("part", _right("bytes"), _right("share"), _right("bits/Gaussian"), box=None, pad_edge=False)
    total = sum(parts.values())
    for name, value in parts.items():
        table.add_row(name, f"{value:,}", f"{value / max(total, 1):.1%}", f"{8 * value / max(count, 1):.2f}")
    table.add_row("total", f"{total:,}", "", f"{8 * total / max(count, 1):.2f}", style="bold")
    return table


def info_table(info: Info) -> RenderableType:
    """What ``kissgs info`` shows."""
    kind = {"ply": "3DGS scene", "sog-xt": "SOG-XT container"}[info.kind]
    if info.kind == "ply":
        kind += f" ({info.details['encoding']}{', packed' if info.details['compressed'] else ''})"
    head = Text.assemble((info.path, "bold"), f"  {kind}, {size(info.bytes)}")
    body = f"{info.count:,} Gaussians, SH degree {info.sh_degree}, {info.bits_per_gaussian:.1f} bits each"
    what = "" if info.kind == "ply" else " level's value"  # channels share a step, so few reach the highest
    ranges = Table("attribute", _right(f"lowest{what}"), _right(f"highest{what}"), box=None, pad_edge=False)
    for name, (low, high) in info.ranges.items():
        ranges.add_row(name, f"{low:.5g}", f"{high:.5g}")
    blocks: list[RenderableType] = [head, Text(body), ranges]
    if info.parts:
        blocks.insert(2, parts_table(info.parts, info.count))
    if info.kind == "sog-xt":
        made = info.details
        origin = f"kissgs {made['version']} from {made['source_count']:,} Gaussians" if made["version"] else "unknown"
        grid, book = made["grid_side"], made["codebook_side"]
        blocks.append(Text(f"grid {grid} x {grid}, codebook {book} x {book}; encoder: {origin}"))
    return Group(*blocks, *_changes(info.changed))


def _changes(changed: Mapping[str, int]) -> list[Text]:
    return [
        Text(f"{count:,} {CHANGES[name]}", style="yellow")
        for name, count in changed.items()
        if count and name in CHANGES
    ]


def _right(title: str) -> Column:
    return Column(title, justify="right")
