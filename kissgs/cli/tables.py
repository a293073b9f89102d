"""Reports as tables and lines for the terminal. This module only formats."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.core.positions import relative_to
from kissgs.core.splats import CLEANED_TEXTS
from kissgs.evaluation.evaluate import USUAL_PSNR
from kissgs.evaluation.html import ReportScene
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, format_metric
from kissgs.formats import FORMATS

if TYPE_CHECKING:
    from kissgs.compaction.result import CompactionReport
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.pipeline.pipeline import Report
    from kissgs.pipeline.scene_files import Info
    from kissgs.streaming.compress import StreamedReport

CHANGES = {
    "invisible": "left out: opacity at most 1/255, which no renderer draws",
    "pruned_by_rd": "left out: rate cost above the distortion saved",
    "clipped_colors": "with an outlying base colour: clipped, to keep the quantisation step of all others small",
    "compacted": "removed by compaction",
    **CLEANED_TEXTS,
}
"""Text for each kind of removed or changed Gaussians, by key of the report."""


def size(count: float) -> str:
    """Format bytes with a decimal unit: "812 B", "9.41 kB", "61.5 MB"."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.{2 if count < 10 else 1}f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def gaussians(count: int) -> str:
    """Format a number of Gaussians: "1 Gaussian", "60,000 Gaussians"."""
    return f"{count:,} Gaussian{'' if count == 1 else 's'}"


def report_table(report: Report, target: str) -> RenderableType:
    """Format the report of one compression."""
    head = _result(
        target,
        bytes_of=(report.source_bytes, report.container_bytes),
        counts=(report.source_count, report.count),
        sh_degree=report.sh_degree,
        seconds=sum(report.seconds.values()),
        cpu_seconds=report.cpu_seconds,
    )
    head.append(f", peak memory {size(report.peak_memory)}")
    changed = {
        "invisible": report.invisible,
        "pruned_by_rd": report.pruned_by_rd,
        "clipped_colors": report.clipped_colors,
        **report.cleaned.as_dict(),
    }
    search = [_search_table(report)] if report.trials else []
    evaluation = [] if report.evaluation is None else [_evaluation(report.evaluation)]
    compaction = [] if report.compaction is None else _compaction(report.compaction, search=not report.trials)
    finetuning = [] if report.finetuning is None else _finetuning(report.finetuning)
    note = [Text(report.note, style="yellow")] if report.note else []
    details = [*compaction, *search, *finetuning, *note, *evaluation]
    return Group(head, *details, parts_table(dict(sorted(report.file_bytes.items())), report.count), *_changes(changed))


def status_table(status: Mapping[str, Any], target: str) -> RenderableType:
    """Format the status of a job of a service that has succeeded, as :func:`report_table` does it for a report."""
    timings, sizes, evaluation = status["timings"], status["sizes"], status.get("evaluation")
    head = _result(
        target,
        bytes_of=(status["upload_bytes"], sizes["container"]),
        counts=(status["gaussians"], status["kept"]),
        sh_degree=status["sh_degree"],
        seconds=sum(timings["stages"].values()),
        cpu_seconds=timings["cpu_seconds"],
    )
    details = [Text(status["note"], style="yellow")] if status.get("note") else []
    if evaluation is not None:
        psnr = evaluation.get("psnr")  # null: infinite
        mean = ImageMetrics(
            psnr=float("inf" if psnr is None else psnr), ssim=evaluation["ssim"], ms_ssim=evaluation["ms_ssim"]
        )
        details.append(Text(f"{_metrics(mean)} to the scene's own renderings"))
    changed = {"invisible": status.get("invisible") or 0, **(status.get("cleaned") or {})}
    return Group(head, *details, parts_table(dict(sorted(sizes["files"].items())), status["kept"]), *_changes(changed))


def _result(
    target: str,
    *,
    bytes_of: tuple[int, int],
    counts: tuple[int, int],
    sh_degree: int,
    seconds: float,
    cpu_seconds: float,
) -> Text:
    """Format the result of a compression: sizes and counts of the scene and of the container, and its time."""
    (before, after), (all_of_them, kept) = bytes_of, counts
    return Text.assemble(
        (target, "bold"),
        f"  {size(before)} -> {size(after)}, ",
        (f"{before / after:.1f}x smaller", "bold green"),
        f", {after / max(all_of_them, 1):.2f} bytes per Gaussian\n",
        f"{kept:,} of {gaussians(all_of_them)}, SH degree {sh_degree}; {seconds:.1f} s ({cpu_seconds:.1f} CPU s)",
    )


def compaction_table(report: CompactionReport, target: str) -> RenderableType:
    """Format the report of one compaction."""
    seconds = sum(step.seconds for step in report.steps)
    head = Text.assemble(
        (target, "bold"),
        f"  {report.source_count:,} -> ",
        (f"{report.count:,} Gaussians", "bold green"),
        f", {seconds:.1f} s",
    )
    return Group(head, *_compaction(report), *_changes(report.cleaned.as_dict()))


def streamed_table(report: StreamedReport, target: str) -> RenderableType:
    """Format the report of a streamed compression."""
    stored = report.counts[0] + report.environment_count
    chunks = f"{report.chunks} chunk{'s' * (report.chunks > 1)}"
    head = Text.assemble(
        (target, "bold"),
        f"  {stored:,} of {gaussians(report.source_count)} in {chunks}, ",
        (size(report.total_bytes), "bold green"),
    )
    table = Table("level", *map(_right, ("Gaussians", "bytes", "per Gaussian")), box=None, pad_edge=False)
    for level, (count, taken) in enumerate(zip(report.counts, report.level_bytes, strict=True)):
        table.add_row(str(level), f"{count:,}", f"{taken:,}", f"{taken / max(count, 1):.2f}")
    if count := report.environment_count:
        taken = report.environment_bytes
        table.add_row("environment", f"{count:,}", f"{taken:,}", f"{taken / count:.2f}")
    note = [Text(report.note, style="yellow")] if report.note else []
    return Group(head, *note, table, *_changes(report.changed))


def _compaction(report: CompactionReport, *, search: bool = True) -> list[RenderableType]:
    """Format the steps of a compaction, and unless ``search`` is false the counts that were tried."""
    lines: list[RenderableType] = [Text(report.note, style="yellow")] if report.note else []
    if report.trials and search:
        lines.append(Text(f"search: {'; '.join(trial.summary() for trial in report.trials)}"))
    if not report.steps:
        return lines
    trained = {"photos": "trained on photographs", "renderings": "trained on renderings of the scene"}
    if report.source:
        lines.append(Text(f"{trained.get(report.target_source, 'scored with')}: {report.source}"))
    evaluated = report.steps[0].bytes is not None
    columns = [
        _right(name) for name in ("Gaussians", "seconds", *(("PSNR", "SSIM", "MS-SSIM", "bytes") if evaluated else ()))
    ]
    table = Table("step", *columns, box=None, pad_edge=False)
    for step in report.steps:
        cells = [f"{step.count:,}", f"{step.seconds:.1f}"]
        if step.psnr is not None and step.ssim is not None and step.bytes is not None:
            coarse = "" if step.ms_ssim is None else format_metric(step.ms_ssim, 4)
            cells += [format_metric(step.psnr, 2), format_metric(step.ssim, 4), coarse, f"{step.bytes:,}"]
        table.add_row(step.name, *cells)
    return [*lines, table]


def _finetuning(report: FinetuneReport) -> list[Text]:
    """Format the result of fine-tuning in one line, and its note."""
    targets = "photographs" if report.target_source == "photos" else "renderings of the scene"
    first_size = "" if report.bytes_before is None else f"{size(report.bytes_before)} -> "
    first_psnr = "" if report.psnr_before is None else f"{format_metric(report.psnr_before, 2)} -> "
    line = (
        f"fine-tuned on {targets}: {first_size}{size(report.bytes_after)}, held-out PSNR "
        f"{first_psnr}{format_metric(report.psnr_after, 2)} dB, {report.seconds:.0f} s"
    )
    return [Text(line), *([Text(report.note, style="yellow")] if report.note else [])]


def _search_table(report: Report) -> Table:
    """Format what a search tried: scenes with fewer Gaussians before encoding, and containers, the kept one marked."""
    table = Table("tried", *map(_right, ("Gaussians", "bytes")), "quality", box=None, pad_edge=False)
    for count in () if report.compaction is None else report.compaction.trials:
        table.add_row("scene", f"{count.count:,}", "", f"loses {count.loss()}")
    kept = [n for n, trial in enumerate(report.trials) if trial.bytes == report.container_bytes]
    for n, trial in enumerate(report.trials):
        name = "container, kept" if n in kept[-1:] else "container"
        table.add_row(name, f"{trial.count:,}", f"{trial.bytes:,}", trial.quality())
    return table


def _evaluation(evaluation: Evaluation) -> Text:
    mean = evaluation.mean
    metrics = _metrics(mean.candidate)
    if mean.reference is None:
        against = f"to the scene's own renderings from {evaluation.views_used}"
    else:
        own = "{PSNR} dB, {SSIM}, {MS-SSIM}".format_map(mean.reference.texts())
        against = f"to {evaluation.views_used}; the scene itself {own}"
    surroundings = evaluation.surroundings
    rest = "" if surroundings is None else f"\nbeyond the capture: {surroundings_summary(surroundings)}"
    note = f"; {evaluation.note}" if evaluation.note else ""
    return Text.assemble(f"{metrics} {against}; {evaluation.extremes}", (note, "yellow"), rest)


def _metrics(metrics: ImageMetrics) -> str:
    return "PSNR {PSNR} dB, SSIM {SSIM}, MS-SSIM {MS-SSIM}".format_map(metrics.texts())


def surroundings_summary(surroundings: Evaluation) -> str:
    """Format the evaluation from virtual cameras over the whole scene, beyond the views of a capture."""
    mean = f"PSNR {format_metric(surroundings.mean.candidate_vs_reference.psnr, 2)} dB to the scene's own renderings"
    return f"{mean} from {surroundings.views_used}; {surroundings.extremes}"


def parts_table(parts: Mapping[str, int], count: int, whole: str = "total") -> Table:
    """Return a table of bytes per file or attribute: absolute, share of the whole, and bits per Gaussian."""
    table = Table("part", _right("bytes"), _right("share"), _right("bits/Gaussian"), box=None, pad_edge=False)
    total = sum(parts.values())
    for name, value in parts.items():
        table.add_row(name, f"{value:,}", f"{value / max(total, 1):.1%}", f"{8 * value / max(count, 1):.2f}")
    table.add_row(whole, f"{total:,}", "", f"{8 * total / max(count, 1):.2f}", style="bold")
    return table


def info_table(info: Info) -> RenderableType:
    """Format the output of ``kissgs info``."""
    streamed = FORMATS[info.kind].manifest is not None
    head = Text.assemble((info.path, "bold"), f"  {info.title}, {size(info.bytes)}{' in all levels' * streamed}")
    body = f"{gaussians(info.count)}, SH degree {info.sh_degree}, {info.bits_per_gaussian:.1f} bits per Gaussian"
    # Channels of a container share a step, so few reach the highest level.
    of = "value of {} level" if FORMATS[info.kind].is_container else "{} value"
    ends = [_right(of.format(end)) for end in ("lowest", "highest")]
    ranges = Table("attribute", *ends, box=None, pad_edge=False)
    for name, (low, high) in info.ranges.items():
        ranges.add_row(name, f"{low:.5g}", f"{high:.5g}")
    blocks: list[RenderableType] = [head, Text(body), ranges]
    if info.parts:
        whole = f"total of level {info.details['level']}" if streamed else "total"
        blocks.insert(2, parts_table(info.parts, info.count, whole))
    if "origin" in info.details:
        blocks.append(Text(relative_to(tuple(info.details["origin"]))))
    blocks += [Text(line) for line in info.lines]
    return Group(*blocks, *(Text(note, style="yellow") for note in info.notes), *_changes(info.changed))


def _changes(changed: Mapping[str, int]) -> list[Text]:
    """Return a phrase for each kind of removed or changed Gaussians that occurs, by key of the report."""
    known = ((count, CHANGES[name]) for name, count in changed.items() if count and name in CHANGES)
    return [Text(f"{gaussians(count)} {text}", style="yellow") for count, text in known]


def _right(title: str) -> Column:
    return Column(title, justify="right")


# Evaluations as tables for the terminal. This module only formats.


def evaluation_table(
    evaluation: Evaluation, reference: ReportScene, candidate: ReportScene, *, asked: str
) -> RenderableType:
    """Format the output of ``kissgs evaluate``; ``asked`` is the value of ``--split``."""
    what = Text(f"{evaluation.views_used}, {evaluation.size}: {evaluation.source}")
    notes = [Text(evaluation.note, "yellow")] if evaluation.note else []
    own = evaluation.mean.reference
    if own is not None and own.psnr < USUAL_PSNR:
        notes.append(
            Text(
                f"the photographs differ much from renderings of {reference.name}: PSNR {own.psnr:.1f} dB, where more "
                f"than {USUAL_PSNR:g} are usual",
                "yellow",
            )
        )
    if evaluation.split == "train" != asked:
        notes.append(Text("no view is held out: the scene may have been trained on these views", "yellow"))
    views = [_views(evaluation), *_other_means(evaluation.mean)]
    found: list[RenderableType] = [*views, Text(), Text(_sentence(evaluation.extremes))]
    if evaluation.surroundings is not None:
        found.append(Text(_sentence(f"beyond the capture: {surroundings_summary(evaluation.surroundings)}")))
    return Group(_sizes(evaluation, reference, candidate), what, *notes, Text(), *found)


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _sizes(evaluation: Evaluation, reference: ReportScene, candidate: ReportScene) -> Text:
    head = Text.assemble((candidate.name, "bold"), " compared with ", (reference.name, "bold"))
    if reference.bytes is not None and candidate.bytes:
        ratio = reference.bytes / candidate.bytes
        change = f"{ratio:.1f}x smaller" if ratio >= 1 else f"{1 / ratio:.1f}x larger"
        head.append(f"  {size(reference.bytes)} -> {size(candidate.bytes)}, ").append(change, "bold green")
    return head.append(f"; {evaluation.candidate_count:,} of {evaluation.reference_count:,} Gaussians")


def _views(evaluation: Evaluation) -> Table:
    mean = evaluation.mean
    parts = list(mean.candidate_vs_reference.texts())[: 2 if mean.reference is not None else None]
    groups = ["reference\nto photo", "candidate\nto photo"] if mean.reference is not None else []
    columns = [_group(group, parts) for group in groups]
    changes = [Column("change\n\ndB", justify="right")] if groups else []
    columns += [changes, _group("candidate\nto reference", parts)]
    table = Table(
        Column("view", vertical="bottom", overflow="fold"),
        *(column for group in columns for column in group),
        box=None,
        pad_edge=False,
    )
    for compared in evaluation.views:
        table.add_row(Text(compared.view.name), *compared.comparison.cells(parts))
    table.add_row("mean", *mean.cells(parts), style="bold")
    return table


def _other_means(mean: Comparison) -> list[RenderableType]:
    """Return the means of the metrics for which the table of views is too narrow; nothing without photographs."""
    if mean.reference is None:
        return []
    rows = mean.reference.texts(), mean.candidate.texts(), mean.candidate_vs_reference.texts()
    names = list(rows[0])[2:]
    table = Table("", *(Column(name, justify="right") for name in names), box=None, pad_edge=False)
    for title, row in zip(("reference to photo", "candidate to photo", "candidate to reference"), rows, strict=True):
        table.add_row(title, *(row[name] for name in names))
    return [Text(), table]


def _group(title: str, parts: list[str]) -> list[Column]:
    """Return columns with one common title, over the first of them."""
    first = Column(f"{title}\n{parts[0]}", justify="right")
    return [first, *(Column(f"\n\n{part}", justify="right") for part in parts[1:])]
