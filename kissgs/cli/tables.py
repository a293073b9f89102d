"""Reports as tables and lines for the terminal. This module only formats."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.cli.files import gaussians
from kissgs.core.positions import relative_to
from kissgs.core.splats import CLEANED_TEXTS
from kissgs.evaluation.results import Detail, Evaluation, ImageMetrics, detail_text, format_metric
from kissgs.formats import FORMATS
from kissgs.settings import Preset, Settings

if TYPE_CHECKING:
    from kissgs.compaction.result import CompactionReport
    from kissgs.evaluation.html import ReportScene
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

TARGETS = {"photos": "photographs", "renderings": "renderings of the scene"}  # of training


def table_of(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table: names at the left, figures at the right."""
    table = Table(heads[0], *(Column(head, justify="right") for head in heads[1:]), box=None, pad_edge=False)
    for row in rows:
        table.add_row(*row)
    return table


def size(count: float) -> str:
    """Format bytes with a decimal unit: "812 B", "9.41 kB", "61.5 MB"."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.0f} B" if unit == "B" else f"{count:.{2 if count < 10 else 1}f} {unit}"
        count /= 1000
    return f"{count:.2f} GB"


def _noted(*notes: str) -> list[Text]:
    return [Text(note, style="yellow") for note in notes if note]


def _changes(changed: Mapping[str, int]) -> list[Text]:
    """Return a phrase for each kind of removed or changed Gaussians that occurs, by key of the report."""
    known = ((count, CHANGES[name]) for name, count in changed.items() if count and name in CHANGES)
    return _noted(*(f"{gaussians(count)} {text}" for count, text in known))


def _how_to_view(target: str) -> list[Text]:
    """Return the command that shows a file in the browser; nothing for standard output."""
    return [] if target == "-" else [Text(f"see it: kissgs view {shlex.quote(target)}", style="dim")]


def report_table(report: Report, target: str) -> RenderableType:
    """Format the report of one compression."""
    sizes, counts = (report.source_bytes, report.container_bytes), (report.source_count, report.count)
    head = _result(target, sizes, counts, report.sh_degree, (sum(report.seconds.values()), report.cpu_seconds))
    head.append(f", peak memory {size(report.peak_memory)}")
    details: list[RenderableType] = []
    if report.compaction is not None:
        details += _compaction(report.compaction, search=not report.trials)
    if report.trials:
        details.append(_search_table(report))
    if (tuned := report.finetuning) is not None:
        first_size = "" if tuned.bytes_before is None else f"{size(tuned.bytes_before)} -> "
        first_psnr = "" if tuned.psnr_before is None else f"{format_metric(tuned.psnr_before, 2)} -> "
        line = (
            f"fine-tuned on {TARGETS[tuned.target_source]}: {first_size}{size(tuned.bytes_after)}, held-out PSNR "
            f"{first_psnr}{format_metric(tuned.psnr_after, 2)} dB, {tuned.seconds:.0f} s"
        )
        details += [Text(line), *_noted(tuned.note)]
    details += _noted(report.note)
    if report.evaluation is not None:
        details.append(_evaluation(report.evaluation, report.note))
    names = ("invisible", "pruned_by_rd", "clipped_colors")
    changed = {**{name: getattr(report, name) for name in names}, **report.cleaned.as_dict()}
    return Group(head, *details, *_changes(changed), *_how_to_view(target))


def status_table(status: Mapping[str, Any], target: str) -> RenderableType:
    """Format the status of a job of a service that has succeeded, as :func:`report_table` does it for a report."""
    timings, evaluation = status["timings"], status.get("evaluation")
    sizes, counts = (status["upload_bytes"], status["sizes"]["container"]), (status["gaussians"], status["kept"])
    times = sum(timings["stages"].values()), timings["cpu_seconds"]
    head = _result(target, sizes, counts, status["sh_degree"], times)
    details = _noted(status.get("note") or "")
    if evaluation is not None:
        psnr = evaluation.get("psnr")  # null: infinite
        mean = ImageMetrics(
            psnr=float("inf" if psnr is None else psnr), ssim=evaluation["ssim"], ms_ssim=evaluation["ms_ssim"]
        )
        text, patches = f"{mean.summary} to the scene's own renderings", evaluation.get("detail")
        if patches is not None:  # a failed rendering is the text "NaN"
            detail = Detail(*(float(patches[name]) for name in ("worst", "worst_percent", "share_below")))
            text += f"; {detail_text(detail, 'renderings')}"
        details.append(Text(text))
    changed = {"invisible": status.get("invisible") or 0, **(status.get("cleaned") or {})}
    return Group(head, *details, *_changes(changed), *_how_to_view(target))


def _result(
    target: str, sizes: tuple[int, int], counts: tuple[int, int], degree: int, times: tuple[float, float]
) -> Text:
    """Format the result of a compression: sizes and counts before and after it, and its wall and CPU time."""
    (before, after), (all_of_them, kept), (seconds, cpu_seconds) = sizes, counts, times
    return Text.assemble(
        (target, "bold"),
        f"  {size(before)} -> {size(after)}, ",
        (f"{before / after:.1f}x smaller", "bold green"),
        f", {after / max(all_of_them, 1):.2f} bytes per Gaussian\n",
        f"{kept:,} of {gaussians(all_of_them)}, SH degree {degree}; {seconds:.1f} s ({cpu_seconds:.1f} CPU s)",
    )


def compaction_table(report: CompactionReport, target: str) -> RenderableType:
    """Format the report of one compaction."""
    head = Text.assemble(
        (target, "bold"),
        f"  {report.source_count:,} -> ",
        (f"{report.count:,} Gaussians", "bold green"),
        f", {sum(step.seconds for step in report.steps):.1f} s",
    )
    return Group(head, *_compaction(report), *_changes(report.cleaned.as_dict()), *_how_to_view(target))


def streamed_table(report: StreamedReport, target: str) -> RenderableType:
    """Format the report of a streamed compression."""
    stored = report.counts[0] + report.environment_count
    head = Text.assemble(
        (target, "bold"),
        f"  {stored:,} of {gaussians(report.source_count)} in {report.chunks} chunk{'s' * (report.chunks > 1)}, ",
        (size(report.total_bytes), "bold green"),
    )
    rows = [(str(level), *each) for level, each in enumerate(zip(report.counts, report.level_bytes, strict=True))]
    if report.environment_count:
        rows.append(("environment", report.environment_count, report.environment_bytes))
    cells = [(name, f"{count:,}", f"{taken:,}", f"{taken / max(count, 1):.2f}") for name, count, taken in rows]
    table = table_of(("level", "Gaussians", "bytes", "per Gaussian"), cells)
    return Group(head, *_noted(report.note), table, *_changes(report.changed), *_how_to_view(target))


def _compaction(report: CompactionReport, *, search: bool = True) -> list[RenderableType]:
    """Format the steps of a compaction, and unless ``search`` is false the counts that were tried."""
    lines: list[RenderableType] = [*_noted(report.note)]
    if report.trials and search:
        lines.append(Text(f"search: {'; '.join(trial.summary() for trial in report.trials)}"))
    if not report.steps:
        return lines
    if report.source:
        how = f"trained on {TARGETS[report.target_source]}" if report.target_source in TARGETS else "scored with"
        lines.append(Text(f"{how}: {report.source}"))
    heads, rows = ["step", "Gaussians", "seconds"], []
    if report.steps[0].bytes is not None:
        heads += ["PSNR", "SSIM", "MS-SSIM", "bytes"]
    for step in report.steps:
        row = [step.name, f"{step.count:,}", f"{step.seconds:.1f}"]
        if step.psnr is not None and step.ssim is not None and step.bytes is not None:
            coarse = "" if step.ms_ssim is None else format_metric(step.ms_ssim, 4)
            row += [format_metric(step.psnr, 2), format_metric(step.ssim, 4), coarse, f"{step.bytes:,}"]
        rows.append(row)
    return [*lines, table_of(heads, rows)]


def _search_table(report: Report) -> Table:
    """Format what a search tried: scenes with fewer Gaussians before encoding, and containers, the kept one marked."""
    scenes = () if report.compaction is None else report.compaction.trials
    rows = [("scene", f"{scene.count:,}", "", f"loses {scene.loss()}") for scene in scenes]
    kept = [n for n, trial in enumerate(report.trials) if trial.bytes == report.container_bytes]
    for n, trial in enumerate(report.trials):
        name = "container, kept" if n in kept[-1:] else "container"
        rows.append((name, f"{trial.count:,}", f"{trial.bytes:,}", trial.quality()))
    table = table_of(("tried", "Gaussians", "bytes", "quality"), rows)
    table.columns[-1].justify = "left"
    return table


def _evaluation(evaluation: Evaluation, said: str) -> Text:
    """Format an evaluation; ``said`` are notes of the report, which are not said again."""
    mean = evaluation.mean
    against = f"to the scene's own renderings from {evaluation.views_used}"
    if mean.reference is not None:
        own = "{PSNR} dB, {SSIM}, {MS-SSIM}".format_map(mean.reference.texts())
        against = f"to {evaluation.views_used}; the scene itself {own}"
    rest = "" if evaluation.surroundings is None else f"\n{_beyond(evaluation.surroundings)}"
    note = f"; {evaluation.note}" if evaluation.note not in ("", *said.split("; ")) else ""
    return Text.assemble(f"{mean.candidate.summary} {against}; {evaluation.extremes}", (note, "yellow"), rest)


def _beyond(surroundings: Evaluation) -> str:
    """Format the evaluation from virtual cameras over the whole scene."""
    psnr = format_metric(surroundings.mean.candidate_vs_reference.psnr, 2)
    mean = f"PSNR {psnr} dB to the scene's own renderings from {surroundings.views_used}"
    return f"beyond the capture: {mean}; {surroundings.extremes}"


def info_table(info: Info) -> RenderableType:
    """Format the output of ``kissgs info``."""
    streamed = FORMATS[info.kind].manifest is not None
    head = Text.assemble((info.path, "bold"), f"  {info.title}, {size(info.bytes)}{' in all levels' * streamed}")
    body = f"{gaussians(info.count)}, SH degree {info.sh_degree}, {info.bits_per_gaussian:.1f} bits per Gaussian"
    blocks: list[RenderableType] = [head, Text(body)]
    if info.parts:
        total, count = sum(info.parts.values()), max(info.count, 1)
        parts = [(name, f"{n:,}", f"{n / max(total, 1):.1%}", f"{8 * n / count:.2f}") for name, n in info.parts.items()]
        table = table_of(("part", "bytes", "share", "bits/Gaussian"), parts)
        whole = f"total of level {info.details['level']}" if streamed else "total"
        table.add_row(whole, f"{total:,}", "", f"{8 * total / count:.2f}", style="bold")
        blocks.append(table)
    # Channels of a container share a step, so few reach the highest level.
    of = "value of {} level" if FORMATS[info.kind].is_container else "{} value"
    ranges = [(name, f"{low:.5g}", f"{high:.5g}") for name, (low, high) in info.ranges.items()]
    blocks.append(table_of(("attribute", of.format("lowest"), of.format("highest")), ranges))
    if "origin" in info.details:
        blocks.append(Text(relative_to(tuple(info.details["origin"]))))
    return Group(*blocks, *map(Text, info.lines), *_noted(*info.notes), *_changes(info.changed))


def settings_table() -> RenderableType:
    """Return a table of the settings that users may change, with their values in the preset balanced."""
    settings = Settings.from_preset(Preset.BALANCED)
    table = table_of(("setting", "balanced", "meaning"), [])
    table.columns[1].justify = table.columns[2].justify = "left"
    for prefix, group in (("", settings.encode), ("compact.", settings.compact), ("finetune.", settings.finetune)):
        for name in group.public():
            value = getattr(group, name)
            meaning = type(group).model_fields[name].description or ""
            table.add_row(prefix + name, "" if value is None else str(value), meaning)
    return table


def evaluation_table(
    evaluation: Evaluation, reference: ReportScene, candidate: ReportScene, *, asked: str
) -> RenderableType:
    """Format the output of ``kissgs evaluate``; ``asked`` is the value of ``--split``."""
    from kissgs.evaluation.evaluate import USUAL_PSNR  # loads the rasteriser

    own, surroundings, notes = evaluation.mean.reference, evaluation.surroundings, [evaluation.note]
    if own is not None and own.psnr < USUAL_PSNR:
        notes.append(
            f"the photographs differ much from renderings of {reference.name}: PSNR {own.psnr:.1f} dB, where more than "
            f"{USUAL_PSNR:g} are usual"
        )
    if evaluation.split == "train" != asked:
        notes.append("no view is held out: the scene may have been trained on these views")
    head = Text.assemble((candidate.name, "bold"), " compared with ", (reference.name, "bold"))
    if reference.bytes is not None and candidate.bytes:
        ratio = reference.bytes / candidate.bytes
        change = f"{ratio:.1f}x smaller" if ratio >= 1 else f"{1 / ratio:.1f}x larger"
        head.append(f"  {size(reference.bytes)} -> {size(candidate.bytes)}, ").append(change, "bold green")
    head.append(f"; {evaluation.candidate_count:,} of {evaluation.reference_count:,} Gaussians")
    extremes = [evaluation.extremes, *([] if surroundings is None else [_beyond(surroundings)])]
    return Group(
        head,
        f"{evaluation.views_used}, {evaluation.size}: {evaluation.source}",
        *_noted(*notes),
        "",
        *_metrics_of_views(evaluation),
        "",
        *(f"{text[0].upper()}{text[1:]}." for text in extremes),
    )


def _metrics_of_views(evaluation: Evaluation) -> list[RenderableType]:
    """Return a table of all views and, with photographs, of the means of metrics for which it is too narrow."""
    mean, names = evaluation.mean, list(evaluation.mean.candidate.texts())
    if mean.reference is None:
        heads, shown = _under("candidate\nto reference", names), names
    else:
        shown = names[:2]
        to_photo = [head for of in ("reference\nto photo", "candidate\nto photo") for head in _under(of, shown)]
        heads = [*to_photo, "change\n\ndB", *_under("candidate\nto reference", shown)]
    table = table_of(["view", *heads], [])
    table.columns[0].vertical, table.columns[0].overflow = "bottom", "fold"
    for compared in evaluation.views:
        table.add_row(Text(compared.view.name), *compared.comparison.cells(shown))
    table.add_row("mean", *mean.cells(shown), style="bold")
    if mean.reference is None:
        return [table]
    means = {
        "reference to photo": mean.reference,
        "candidate to photo": mean.candidate,
        "candidate to reference": mean.candidate_vs_reference,
    }
    rows = [(title, *(metrics.texts()[name] for name in names[2:])) for title, metrics in means.items()]
    return [table, "", table_of(["", *names[2:]], rows)]


def _under(title: str, names: Sequence[str]) -> list[str]:
    """Return heads of columns with one common title, over the first of them."""
    return [f"{title}\n{names[0]}", *(f"\n\n{name}" for name in names[1:])]
