"""The figures of an evaluation's page: in words, on cards and in a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, spell


def summary_line(evaluation: Evaluation, shown: int) -> str:
    """What was compared, where from; ``shown`` views have pictures. Plain text, to be escaped."""
    rest = " Their pictures are below" if shown == len(evaluation.views) else f" Pictures of {shown} of them are below"
    rest += ", the worst first."
    return f"{evaluation.views_used}, {evaluation.size.replace('x', '×')}: {evaluation.source}.{rest}"


def figure_cards(evaluation: Evaluation, before: int | None, after: int | None) -> Iterable[str]:
    """The means, and the bytes of both files where they are known."""
    mean = evaluation.mean
    if mean.reference is not None:
        change = f"{change_of(mean)} dB: the reference has {spell(mean.reference.psnr, 2)} dB"
        yield _card("PSNR, candidate to photographs", f"{spell(mean.candidate.psnr, 2)} dB", change)
        ssim = f"the reference has {spell(mean.reference.ssim, 4)}"
        yield _card("SSIM, candidate to photographs", spell(mean.candidate.ssim, 4), ssim)
    between = f"of their renderings; {in_words(mean.candidate_vs_reference)}"
    yield _card("PSNR, candidate to reference", f"{spell(mean.candidate_vs_reference.psnr, 2)} dB", between)
    fifth = f"{spell(evaluation.fifth_percentile, 2)} dB is the 5th percentile"
    yield _card("PSNR, worst view", f"{spell(evaluation.worst.comparison.candidate_vs_reference.psnr, 2)} dB", fifth)
    counts = f"{evaluation.candidate_count:,} of {evaluation.reference_count:,} Gaussians"
    if before and after:
        change = f"{before / after:.1f}× smaller" if before >= after else f"{after / before:.1f}× larger"
        yield _card("Size", change, f"{before / 1e6:,.2f} → {after / 1e6:,.2f} MB; {counts}")
    else:
        yield _card("Gaussians", f"{evaluation.candidate_count:,}", counts)


def extremes_lines(evaluation: Evaluation) -> str:
    """Where the worst views are, of the scene beside those of a capture too. Plain text, to be escaped."""
    told, around = f"Candidate to reference: {evaluation.extremes}.", evaluation.surroundings
    if around is None:
        return told
    found = around.mean.candidate_vs_reference
    mean = f"PSNR {spell(found.psnr, 2)} dB, SSIM {spell(found.ssim, 4)}"
    return f"{told} Elsewhere, {around.views_used} ({around.source}): {mean}; {around.extremes}."


def _card(name: str, value: str, remark: str) -> str:
    return f'<div class="card"><dt>{name}</dt><dd>{value}</dd><dd class="remark">{remark}</dd></div>'


def in_words(likeness: ImageMetrics) -> str:
    """All but the PSNR."""
    lpips = "" if likeness.lpips is None else f", LPIPS {spell(likeness.lpips, 4)}"
    return f"SSIM {spell(likeness.ssim, 4)}{lpips}"


def change_of(comparison: Comparison) -> str:
    """Of the PSNR to the photograph, a loss in red."""
    text = "" if comparison.change is None else spell(comparison.change, 2, signed=True)
    return f'<span class="worse">−{text[1:]}</span>' if text.startswith("-") else text


def views_table(evaluation: Evaluation, shown: Sequence[int]) -> str:
    """A row for each view, linked to its pictures if it is among ``shown``, and their mean."""
    mean = evaluation.mean
    parts = ["PSNR", "SSIM", "LPIPS"][: len(mean.candidate_vs_reference.spelled())]
    between = [("candidate to reference", parts)]
    photographed = [("reference to photograph", parts), ("candidate to photograph", parts), ("change", ["dB"])]
    groups = between if mean.reference is None else photographed + between
    upper = "".join(f'<th colspan="{len(below)}">{title}</th>' for title, below in groups)
    lower = "".join(f"<th>{part}</th>" for _, below in groups for part in below)
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
        for cell in comparison.spelled()
    )
