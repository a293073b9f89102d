"""Estimate of a scene's error by lambda, before it is planned, and the lambda for a given error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.signed_log import signed_log
from kissgs.core.splats import Splats
from kissgs.planning.codebook_error import SH_SHRINK, CodebookErrorModel
from kissgs.planning.gaussian_costs import Costs
from kissgs.planning.quantize import means_bits
from kissgs.planning.rows import for_each_block, row_range, selected
from kissgs.settings import EncodeSettings

DIMENSIONS = 14
"""Rounded degrees of freedom per Gaussian: opacity, scales, rotation, base colour, position."""

GROWTH = 2.2
"""Measured ratio of the rounding error to H d²/12: above 1 because RDO quantisation prefers levels of few bits, and the
errors of several Gaussians add up in a pixel."""

PAPER_RATIO = 8
"""Gaussians per codebook entry of the paper."""

PAPER_SH_GROWTH = 2.0
"""Measured factor on uncompensated shN errors, which add up in pixels."""

OTHER_VIEWS_DB = 9.5
"""Decibels per unit of view uncertainty by which errors in other views exceed those in the measured views, where
planning hides them. It does not apply to shN: its codebook hardly adapts to the measured views once sensitivity is
shrunk towards the prior."""

MIN_ERROR_RATIO = 1.1
"""Smallest error to aim at, in units of the smallest possible one: the last 0.4 dB would cost far too many bits."""

SH_UNCOMPENSATED, SH_UNCOMPENSATED_GROWTH = 0.14, 1.9
"""Measured share of shN errors that base colours cannot compensate, and its growth per unit of view uncertainty."""

REFIT_GAIN = 0.17
"""PSNR gain per iteration of the colour refit, decibels: below the measured mean, so that it holds for most scenes."""


def choose_lambda(
    usual: float,
    costs: Costs,
    sh_model: CodebookErrorModel,
    settings: EncodeSettings,
    view_uncertainty: float,
    refits: int,
) -> tuple[float, float]:
    """Return the lambda of the settings, and that of the default quality.

    Args:
        usual: mean squared error of the default quality (:func:`default_error`).
        costs: costs of all Gaussians that a renderer draws.
        sh_model: error of the view-dependent colour, by codebook size.
        settings: settings of the encoder.
        view_uncertainty: that of the sensitivity, from 0 to 1.
        refits: number of iterations of the colour refit.
    """

    def for_error(error: float, quality_offset_db: float) -> float:
        """Return the lambda at which the squared error is about ``quality_offset_db`` decibels below ``error``."""
        error *= 10 ** (-(quality_offset_db - REFIT_GAIN * refits) / 10)
        bits, ratio = prune_threshold(settings, view_uncertainty), settings.gaussians_per_codebook_entry
        return lambda_for(error, costs, sh_model, bits, ratio, view_uncertainty)

    default_lambda = for_error(usual, 0.0)
    if settings.rd_lambda is not None:
        return settings.rd_lambda, default_lambda
    if settings.psnr is not None:
        return for_error(10 ** (-settings.psnr / 10), 0.0), default_lambda
    return for_error(usual, settings.quality_offset_db), default_lambda


def prune_threshold(settings: EncodeSettings, view_uncertainty: float) -> float:
    """Return the largest number of bits that the removal of a Gaussian may cost."""
    return settings.prune_threshold_bits * (1 - view_uncertainty)


def default_error(costs: Costs, splats: Splats, kept: Int[np.ndarray, " M"], sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of the default quality: the smaller one of the presets ``paper`` and ``fast``.

    The paper's 100 levels for rotations, 256 for the rest and 65,536 for positions are spread from each channel's
    smallest to its largest value, so that a single outlier makes them coarse; the steps of ``fast`` are absolute.

    Args:
        costs: costs of all Gaussians of ``kept``, ``(M,)``.
        splats: the scene.
        kept: indices of the ``M`` Gaussians that a renderer draws.
        sh_model: error of the view-dependent colour, by codebook size.
    """
    scene = {"opacities": splats.opacities[:, None], "scales": splats.scales, "sh0": splats.sh0, "means": splats.means}
    ends = {name: row_range(selected(values, kept)) for name, values in scene.items()}
    spans = [np.ptp(np.array(ends[name], np.float64), axis=0) for name in ("opacities", "scales", "sh0")]
    opacity, scale, color = (span / 255 for span in spans)
    log_extent = np.ptp(signed_log(np.array(ends["means"])), axis=0)
    rotation = np.full(3, 2.0)  # a change of a quaternion by 1 is a rotation by 2 radians
    paper = (opacity, scale, rotation * 2 / 99, color, log_extent / 65535)
    defaults = {name: field.default for name, field in EncodeSettings.model_fields.items()}
    levels = 2 ** means_bits(splats, kept, defaults["means_tolerance"]) - 1
    fast = (
        np.float64(defaults["opacity_step"]),
        np.full(3, defaults["scale_step"]),
        rotation * defaults["quat_step"],
        np.full(3, defaults["sh0_step"]),
        log_extent / levels,
    )
    return min(
        _error(paper, PAPER_RATIO, costs, sh_model),
        _error(fast, defaults["gaussians_per_codebook_entry"], costs, sh_model),
    )


def _error(steps: Sequence[np.ndarray | np.float64], ratio: float, costs: Costs, sh_model: CodebookErrorModel) -> float:
    """Estimate the mean squared error of rounding to such steps of opacity, scale, rotation, colour and position.

    A Gaussian's error is at most twice that of its removal: one copy too few, and one where there should be none. The
    Hessian alone overestimates the rotation of long, thin Gaussians, a few of which would then decide. The share of
    positions is bounded by that of as many other numbers: far from the origin, even 16 bits are coarse, at
    any lambda.
    """
    each = (costs.opacity, costs.scale, costs.rotation, costs.color, costs.position)
    squares = [float(np.sum(np.square(step, dtype=np.float64))) for step in steps]

    def bounded(rows: slice) -> float:
        errors = np.stack([cost[rows] * (square / 12) for cost, square in zip(each[:-1], squares[:-1], strict=True)])
        return float(np.minimum(errors.sum(axis=0), 2 * costs.removal[rows]).sum())

    total = sum(for_each_block(len(costs.color), bounded))
    total += min(float(costs.position.sum()) * squares[-1] / 12, total * 3 / (DIMENSIONS - 3))
    entries = max(len(costs.color) / ratio, 1)
    return total + PAPER_SH_GROWTH * sh_model.unweighted * (sh_model.entries / entries) ** SH_SHRINK


def error_at(
    rd_lambda: float,
    costs: Costs,
    sh_model: CodebookErrorModel,
    threshold_bits: float,
    ratio: float,
    view_uncertainty: float,
) -> float:
    """Estimate the mean squared error of a scene that is planned with ``rd_lambda``."""
    count = len(costs.color)
    pruned = costs.removal[costs.pruned_by_rd(rd_lambda, threshold_bits)]
    rounding = GROWTH * DIMENSIONS * (count - len(pruned)) * rd_lambda / (2 * np.log(2))
    other_views = 10 ** (OTHER_VIEWS_DB * view_uncertainty / 10)
    uncompensated = SH_UNCOMPENSATED + SH_UNCOMPENSATED_GROWTH * view_uncertainty
    sh_error = sh_model.error(max(sh_model.best_size(rd_lambda, count, ratio), 1))
    return float(other_views * (rounding + GROWTH * pruned.sum()) + uncompensated * sh_error)


def lambda_for(
    error: float,
    costs: Costs,
    sh_model: CodebookErrorModel,
    threshold_bits: float,
    ratio: float,
    view_uncertainty: float,
) -> float:
    """Return the lambda at which the mean squared error is about ``error``.

    The error aimed at is at least 1.1 times the smallest possible one: at any lambda, the error of the largest codebook
    remains.
    """
    low, high = np.log(1e-22), np.log(1e-2)
    error = max(error, MIN_ERROR_RATIO * error_at(1e-22, costs, sh_model, threshold_bits, ratio, view_uncertainty))
    for _ in range(60):
        middle = 0.5 * (low + high)
        small = error_at(float(np.exp(middle)), costs, sh_model, threshold_bits, ratio, view_uncertainty) < error
        low, high = (middle, high) if small else (low, middle)
    return float(np.exp(low))


def implied_lambda(error: float, count: int) -> float:
    """Return the lambda for which ``error`` is the expected mean squared error of rounding ``count`` Gaussians."""
    return 2 * float(np.log(2)) * error / (GROWTH * DIMENSIONS * max(count, 1))
