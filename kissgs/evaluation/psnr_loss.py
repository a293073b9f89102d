"""PSNR of an evaluation, and its loss of PSNR and of SSIM, as goals of rate control and compaction define them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kissgs.evaluation.results import Evaluation

ASSUMED_PSNR = 30.0
"""PSNR, decibels, that renderings are assumed to have to photographs if there are none: about that of good captures."""

ESTIMATED_DROP = f"without photographs, the drop of PSNR is estimated for a scene that has {ASSUMED_PSNR:g} dB to them"
"""Note for a drop that was not measured with photographs."""

SEARCH_SEED = 20_011
"""Seed of the cameras that evaluate the trials of a search. ``evaluate`` has seed 0: a result selected with some
cameras is better from these than from others."""

WORST_SHARE = 0.05
"""Share of the views, the worst ones, that a goal limits separately."""

MAX_ERROR_RATIO = 20.0
"""Largest ratio of the worst views' squared error to that of the goal. The mean alone would accept the loss of a part
that few views show: there the ratio is in the hundreds, in views that are merely difficult below ten."""

MAX_SSIM_RATIO = 5.0
"""Largest ratio of the worst views' loss of SSIM to that of the goal.

No loss to renderings is negative, so that the mean of all views already limits the worst twentieth to 20 times itself.
"""


def over_scene(evaluation: Evaluation) -> Evaluation:
    """Return what says how near the candidate's renderings are to the reference's.

    Without photographs, that are the cameras drawn over the whole scene (the surroundings), where there are any.
    """
    surroundings = evaluation.surroundings
    return evaluation if surroundings is None or evaluation.against == "photos" else surroundings


def psnr_of(evaluation: Evaluation) -> float:
    """Return the PSNR of the candidate to the reference as goals define it, decibels; NaN if a rendering failed.

    It is the mean over views (:func:`over_scene`), limited by the worst views: at most the PSNR of their mean squared
    error divided by :data:`MAX_ERROR_RATIO`.
    """
    evaluation = over_scene(evaluation)
    mean = evaluation.mean.candidate_vs_reference.psnr
    worst = (
        _mean_of_worst([_squared_error(view.comparison.candidate_vs_reference.psnr) for view in evaluation.views])
        / MAX_ERROR_RATIO
    )
    return mean if math.isnan(mean) or worst <= 0 else min(mean, -10 * math.log10(worst))


def drop_of(evaluation: Evaluation) -> float:
    """Return the drop of PSNR from reference to candidate as goals define it, decibels; NaN if a rendering failed.

    With photographs it is the drop of the mean PSNR to them. Without, the reference is assumed to have
    :data:`ASSUMED_PSNR` to photographs, with errors independent of the new ones, so that squared errors add up.

    The worst views limit it, those of the surroundings apart: it is at least the drop that their additional squared
    error, divided by :data:`MAX_ERROR_RATIO`, would cause in all views.
    """
    mean = evaluation.mean
    if mean.change is None:
        drop = _drop_by(_squared_error(mean.candidate_vs_reference.psnr) / _squared_error(ASSUMED_PSNR))
        groups = [_errors_to_renderings(evaluation), _errors_to_renderings(over_scene(evaluation))]
    else:
        drop, groups = -mean.change, [_errors_added(evaluation)]
    worst = _worst(groups) / MAX_ERROR_RATIO
    if math.isnan(drop) or math.isnan(worst):
        return math.nan
    return drop if worst <= 0 else max(drop, _drop_by(worst))


def ssim_drop_of(evaluation: Evaluation) -> float:
    """Return the drop of SSIM from reference to candidate as goals define it; NaN if a rendering failed.

    With photographs it is the drop of the mean SSIM to them, without photographs 1 - SSIM to the renderings of the
    reference. The worst views limit it, those of the surroundings apart: it is at least their mean drop divided by
    :data:`MAX_SSIM_RATIO`.
    """
    groups = [_ssim_drops(evaluation), _ssim_drops(over_scene(evaluation))]
    mean, worst = sum(groups[0]) / len(groups[0]), _worst(groups) / MAX_SSIM_RATIO
    if math.isnan(mean) or math.isnan(worst):
        return math.nan
    return mean if worst <= 0 else max(mean, worst)


def _ssim_drops(evaluation: Evaluation) -> list[float]:
    """Return each view's drop of SSIM to its photograph, without photographs 1 - SSIM to the rendering."""
    return [
        (1.0 if view.reference is None else view.reference.ssim) - view.candidate.ssim
        for view in (compared.comparison for compared in evaluation.views)
    ]


def _errors_to_renderings(evaluation: Evaluation) -> list[float]:
    """Return each view's squared error to the reference's rendering, in units of that of :data:`ASSUMED_PSNR`."""
    psnrs = [view.comparison.candidate_vs_reference.psnr for view in evaluation.views]
    return [_squared_error(psnr) / _squared_error(ASSUMED_PSNR) for psnr in psnrs]


def _errors_added(evaluation: Evaluation) -> list[float]:
    """Return the growth of each view's squared error to its photograph, in units of the reference's mean error."""
    pairs = [
        (_squared_error(view.comparison.candidate.psnr), _squared_error(view.comparison.reference.psnr))
        for view in evaluation.views
        if view.comparison.reference is not None
    ]
    mean_error = sum(reference for _, reference in pairs) / len(pairs)
    return [(candidate - reference) / max(mean_error, 1e-30) for candidate, reference in pairs]


def _worst(groups: Sequence[Sequence[float]]) -> float:
    """Return the largest :func:`_mean_of_worst` of groups of views; NaN if any error is."""
    if any(math.isnan(error) for errors in groups for error in errors):
        return math.nan
    return max(_mean_of_worst(errors) for errors in groups)


def _mean_of_worst(errors: Sequence[float]) -> float:
    """Return the mean of the largest errors: :data:`WORST_SHARE` of them, at least one."""
    count = math.ceil(WORST_SHARE * len(errors))
    return sum(sorted(errors)[-count:]) / count


def _squared_error(psnr: float) -> float:
    """Return the mean squared error of a PSNR in decibels; 0 if that is infinite."""
    return float(10 ** (-psnr / 10))


def _drop_by(errors: float) -> float:
    """Return the drop of PSNR, decibels, caused by additional squared error in units of the former error."""
    return 10 * math.log10(1 + max(errors, 0.0))
