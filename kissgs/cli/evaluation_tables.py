"""Evaluations as tables for the terminal. This module only formats."""

from __future__ import annotations

from rich.console import Group, RenderableType
from rich.table import Column, Table
from rich.text import Text

from kissgs.cli.tables import size, surroundings_summary
from kissgs.evaluation.html import ReportScene
from kissgs.evaluation.results import Comparison, Evaluation


def evaluation_table(
    evaluation: Evaluation, reference: ReportScene, candidate: ReportScene, *, asked: str
) -> RenderableType:
    """Format the output of ``kissgs evaluate``; ``asked`` is the value of ``--split``."""
    what = Text(f"{evaluation.views_used}, {evaluation.size}: {evaluation.source}")
    notes = [Text(evaluation.note, "yellow")] if evaluation.note else []
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
