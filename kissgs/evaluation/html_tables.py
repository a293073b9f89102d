"""Values of an evaluation's HTML page: summary, cards and table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from kissgs.evaluation.metric_text import format_metric
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics


def summary_line(evaluation: Evaluation, shown: int) -> str:
    """Return what was compared, as plain text to be escaped; ``shown`` is the number of views with images."""
    rest = " Their images are below" if shown == len(evaluation.views) else f" Images of the worst {shown} are below"
    rest += ", the worst first."
    return f"{evaluation.views_used}, {evaluation.size.replace('x', '×')}: {evaluation.source}.{rest}"


def metric_cards(evaluation: Evaluation, before: int | None, after: int | None) -> Iterable[str]:
    """Yield cards with the means, and the bytes of both files if known."""
    mean = evaluation.mean
    if mean.reference is not None:
        change = f"{psnr_change(mean)} dB: the reference has {format_metric(mean.reference.psnr, 2)} dB"
        yield _card("PSNR, candidate to photographs", f"{format_metric(mean.candidate.psnr, 2)} dB", change)
        of_reference, of_candidate = mean.reference.texts(), mean.candidate.texts()
        for name in list(of_candidate)[1:]:
            remark = f"the reference has {of_reference[name]}"
            yield _card(f"{name}, candidate to photographs", of_candidate[name], remark)
    remark = f"of their renderings; {other_metrics(mean.candidate_vs_reference)}"
    yield _card("PSNR, candidate to reference", f"{format_metric(mean.candidate_vs_reference.psnr, 2)} dB", remark)
    fifth = f"{format_metric(evaluation.fifth_percentile, 2)} dB is the 5th percentile"
    yield _card(
        "PSNR, worst view", f"{format_metric(evaluation.worst.comparison.candidate_vs_reference.psnr, 2)} dB", fifth
    )
    counts = f"{evaluation.candidate_count:,} of {evaluation.reference_count:,} Gaussians"
    if before and after:
        change = f"{before / after:.1f}× smaller" if before >= after else f"{after / before:.1f}× larger"
        yield _card("Size", change, f"{before / 1e6:,.2f} → {after / 1e6:,.2f} MB; {counts}")
    else:
        yield _card("Gaussians", f"{evaluation.candidate_count:,}", counts)


def worst_views_text(evaluation: Evaluation) -> str:
    """Return the worst views, those of the surroundings included, as plain text to be escaped."""
    text, surroundings = f"Candidate to reference: {evaluation.extremes}.", evaluation.surroundings
    if surroundings is None:
        return text
    metrics = surroundings.mean.candidate_vs_reference
    mean = f"PSNR {format_metric(metrics.psnr, 2)} dB, {other_metrics(metrics)}"
    return f"{text} Surroundings, {surroundings.views_used} ({surroundings.source}): {mean}; {surroundings.extremes}."


def _card(name: str, value: str, remark: str) -> str:
    return f'<div class="card"><dt>{name}</dt><dd>{value}</dd><dd class="remark">{remark}</dd></div>'


def other_metrics(metrics: ImageMetrics) -> str:
    """Return all metrics but the PSNR, as text."""
    return ", ".join(f"{name} {text}" for name, text in list(metrics.texts().items())[1:])


def psnr_change(comparison: Comparison) -> str:
    """Return the change of the PSNR to the photograph as HTML, a loss in red."""
    text = "" if comparison.change is None else format_metric(comparison.change, 2, signed=True)
    return f'<span class="worse">−{text[1:]}</span>' if text.startswith("-") else text


def views_table(evaluation: Evaluation, shown: Sequence[int]) -> str:
    """Return a table with a row for each view, linked to its images if it is among ``shown``, and the means."""
    mean = evaluation.mean
    metrics = list(mean.candidate_vs_reference.texts())
    renderings = [("candidate to reference", metrics)]
    photographs = [("reference to photograph", metrics), ("candidate to photograph", metrics), ("change", ["dB"])]
    groups = renderings if mean.reference is None else photographs + renderings
    upper = "".join(f'<th colspan="{len(columns)}">{title}</th>' for title, columns in groups)
    lower = "".join(f"<th>{column}</th>" for _, columns in groups for column in columns)
    rows = []
    for i, compared in enumerate(evaluation.views):
        name = escape(compared.view.name)
        name = f'<a href="#view-{i}">{name}</a>' if i in shown else name
        rows.append(f"<tr><td>{name}</td>{_cells(compared.comparison)}</tr>")
    return (
        f"<table><thead><tr><th></th>{upper}</tr><tr><th>view</th>{lower}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody><tfoot><tr><td>mean</td>{_cells(mean)}</tr></tfoot></table>"
    )


def _cells(comparison: Comparison) -> str:
    return "".join(
        f'<td class="worse">−{cell[1:]}</td>' if cell.startswith("-") else f"<td>{cell}</td>"
        for cell in comparison.cells()
    )
