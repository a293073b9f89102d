"""How good a scene's pictures are, in the figures that goals ask for."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kissgs.evaluation.results import Evaluation

USUAL = 30.0
"""Decibels between a scene's pictures and photographs, where there are none to ask: about that of good captures."""

MODELLED = f"without photographs, the drop is that of a scene {USUAL:g} dB from them to which the new errors are added"

SEARCH_SEED = 20_011
"""Of the cameras that judge attempts at a goal. Those of ``evaluate`` have seed 0: what is chosen because certain
cameras find it good is better from these than from others."""

WORST_SHARE = 0.05
"""Share of the views, the worst ones, that a goal looks at by themselves."""

UNEVEN = 20.0
"""How many times the squared error that a goal stands for these may have: a mean alone forgives the loss of a part that
few views show. That costs them hundreds of times as much; what is only harder than the rest, a few times."""


def psnr_of(evaluation: Evaluation) -> float:
    """PSNR of a scene's pictures to its reference's, as goals count it, decibels; NaN where a picture failed.

    The mean over views, but at most that of pictures with a :data:`UNEVEN`-th of the squared error of the worst views.
    """
    mean = evaluation.mean.candidate_vs_reference.psnr
    worst = _worst([_squared(view.comparison.candidate_vs_reference.psnr) for view in evaluation.views]) / UNEVEN
    return mean if math.isnan(mean) or worst <= 0 else min(mean, -10 * math.log10(worst))


def drop_of(evaluation: Evaluation) -> float:
    """By how many decibels a scene's pictures have become worse, as goals count it; NaN where a picture failed.

    Where there are no photographs to ask, as if the scene had been :data:`USUAL` decibels from them and the new errors
    were independent of those: squared errors then add up. (Of fox it predicts 0.40 dB where 0.38 are measured.)

    That is the drop of the mean over views, but at least what a :data:`UNEVEN`-th of the squared error that has come to
    the worst views would be in all of them.
    """
    mean = evaluation.mean
    if mean.change is None:
        drop = _added(_squared(mean.candidate_vs_reference.psnr) / _squared(USUAL))
        each = [_squared(view.comparison.candidate_vs_reference.psnr) / _squared(USUAL) for view in evaluation.views]
    else:
        drop, each = -mean.change, _errors_added(evaluation)
    worst = _worst(each) / UNEVEN
    return drop if math.isnan(drop) or worst <= 0 else max(drop, _added(worst))


def _errors_added(evaluation: Evaluation) -> list[float]:
    """For each view, by how much its squared error to the photograph has grown, in units of the reference's mean."""
    pairs = [
        (_squared(view.comparison.candidate.psnr), _squared(view.comparison.reference.psnr))
        for view in evaluation.views
        if view.comparison.reference is not None
    ]
    usual = sum(reference for _, reference in pairs) / len(pairs)
    return [(candidate - reference) / max(usual, 1e-30) for candidate, reference in pairs]


def _worst(errors: Sequence[float]) -> float:
    """The mean over the largest :data:`WORST_SHARE` of these, one at least."""
    count = math.ceil(WORST_SHARE * len(errors))
    return sum(sorted(errors)[-count:]) / count


def _squared(psnr: float) -> float:
    """The mean squared error; 0 for an infinite PSNR."""
    return float(10 ** (-psnr / 10))


def _added(errors: float) -> float:
    """What squared errors, in units of those that were there, take of the PSNR, decibels."""
    return 10 * math.log10(1 + max(errors, 0.0))
