"""One price for every bit: how fine each step, how large the codebook, and what is not worth its bytes.

lambda is squared image error per bit (:class:`kissgs.Sensitivity` says what error costs are). Rounding to a step d
costs H d²/12, and halving d costs a bit: so d² = 6 lambda / (ln 2 H) where the two are in balance, whatever the
attribute. Gaussians are ordered in classes of like sensitivity, and each class has its own steps: multiples of the
finest class', so that the decoder need not know of them. WebP's entropy codes, which vary over an image, do the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, Int
from kissgs.core.sensitivity import OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.signed_log import signed_log
from kissgs.core.splats import Splats
from kissgs.planning.quantize import means_bits
from kissgs.settings import EncodeSettings

FLOOR = 1e-3
"""Least sensitivity, in units of the median: what no camera saw must still not be ruined."""

SH_SHRINK = 0.42
"""A codebook's error falls as its size to the power of minus this: measured on real scenes, 1,000 to 10,000 entries."""

ENTRY_BITS = 112
"""What an entry takes in the codebook's image: measured at 45 dimensions."""

LABEL_SHARE = 0.5
"""Bits of a label for one more bit of a codebook's size: entropy coding makes popular entries cheap."""

QUICK = 1 << 13
"""Entries of a codebook that is found in a few seconds."""

DIMENSIONS = 14
"""Numbers per Gaussian that are rounded: opacity, scales, rotation, base colour, position."""

GROWTH = 2.2
"""How much larger than H d²/12 the error of rounding comes out: cheap levels are preferred, and errors meet in pixels.
Measured."""

GLOSS = 0.0796
"""Mean square of a spherical harmonic over all directions, 1 / 4 pi."""

PAPER_RATIO = 8
PAPER_GLOSS = 2.0
"""Errors of gloss that nothing makes up for meet in pixels as if there were twice as many. Measured."""


@dataclass(frozen=True, slots=True, eq=False)
class Costs:
    """Costs of one unit in each attribute, for the Gaussians ``(M,)`` in question; means over channels.

    Attributes:
        opacity: logit.
        scale: log-scale.
        rotation: radian about one of the own axes.
        color: of ``sh0``.
        position: of the signed logarithm of a coordinate.
        removal: of leaving it out.
        coverage: from 0, unseen, to 1, looked at from nearby.
    """

    opacity: Float64[np.ndarray, " M"]
    scale: Float64[np.ndarray, " M"]
    rotation: Float64[np.ndarray, " M"]
    color: Float64[np.ndarray, " M"]
    position: Float64[np.ndarray, " M"]
    removal: Float64[np.ndarray, " M"]
    coverage: Float64[np.ndarray, " M"]

    @classmethod
    def of(cls, sensitivity: Sensitivity, splats: Splats) -> Costs:
        """With the floor under each."""
        reach = (1 + np.abs(splats.means).astype(np.float64)) ** 2
        return cls(
            opacity=_floored(sensitivity.diagonal(OPACITY)[:, 0]),
            scale=_floored(sensitivity.diagonal(SCALES).mean(axis=1)),
            rotation=_floored(sensitivity.diagonal(ROTATION).mean(axis=1)),
            color=_floored(sensitivity.base_colors()),
            position=_floored((sensitivity.position_hessian[:, [0, 3, 5]] * reach).mean(axis=1)),
            removal=sensitivity.removal(splats),
            coverage=sensitivity.coverage.astype(np.float64),
        )

    def take(self, chosen: Int[np.ndarray, " k"]) -> Costs:
        """Those of the Gaussians ``chosen`` alone."""
        return Costs(**{name: getattr(self, name)[chosen] for name in Costs.__slots__})

    def classes(self, number: int, means: Float32[np.ndarray, "M 3"]) -> Int[np.ndarray, " M"]:
        """Class of each, from 0, the most important; of about the same size, and none between them empty.

        Gaussians in one place, by ``means``, are of one class: renderers blend them in the order in which they are
        stored, and that is by class.
        """
        worth = np.log(self.scale) + np.log(self.rotation) + np.log(self.color)
        rank = np.empty(len(worth), np.int64)
        rank[np.argsort(-worth, kind="stable")] = np.arange(len(worth))
        classes = rank * min(number, len(worth)) // max(len(worth), 1)
        key = np.zeros(len(means), np.uint64)
        for axis in (means + np.float32(0)).view(np.uint32).T:
            key = (key ^ axis) * MIX
        _, place = np.unique(key, return_inverse=True)
        first = np.full(len(means), number)
        np.minimum.at(first, place, classes)
        return np.unique(first[place], return_inverse=True)[1]

    def pruned_by_rd(self, rd_lambda: float, drop: float, usual: float | None = None) -> Bool[np.ndarray, " M"]:
        """Whose removal costs less than ``drop`` bits; never more than :data:`MOST_DROPPED` of all.

        Args:
            rd_lambda: squared error per bit.
            drop: bits.
            usual: price at which the scene keeps its default quality. Up to that, nothing goes that no camera has seen
                from nearby, and little of it beyond; None counts the seen and the unseen alike.
        """
        unseen = 0.0 if usual is None else min(usual, rd_lambda) * (self.coverage < SEEN)
        worthless = self.removal < drop * (rd_lambda - unseen)
        most = int(MOST_DROPPED * len(worthless))
        if int(worthless.sum()) > most:
            worthless[np.argsort(np.where(worthless, self.removal, np.inf), kind="stable")[most:]] = False
        return worthless


MIX = np.uint64(0x9E3779B97F4A7C15)
"""Odd, with bits at random: spreads a hash of places."""

SEEN = 0.1
"""Coverage below which a Gaussian was not seen, or from far away only."""

MOST_DROPPED = 0.5
"""Share of the Gaussians. What is removed is no longer there to hide what else is: scores hold for few of them."""


def step(cost: float, rd_lambda: float) -> float:
    """The step in balance with ``rd_lambda`` where a unit costs ``cost``."""
    return float(np.sqrt(6 * rd_lambda / (np.log(2) * cost)))


@dataclass(frozen=True, slots=True)
class CodebookErrorModel:
    """What a scene's SH rest costs: from a codebook made for a trial.

    Attributes:
        entries: of that codebook.
        weighed: squared error it leaves, weighed by sensitivity.
        plain: what a codebook of as many entries leaves that treats all Gaussians alike.
    """

    entries: int = 1
    weighed: float = 0.0
    plain: float = 0.0

    def error(self, entries: float) -> float:
        """Of a codebook of so many entries."""
        return self.weighed * (self.entries / entries) ** SH_SHRINK

    def best_size(self, rd_lambda: float, count: int, ratio: float) -> int:
        """Entries in balance with ``rd_lambda``, for ``count`` Gaussians.

        Beyond :data:`QUICK`, where more would take long to find, not more than one for ``ratio`` of them.
        """
        low, high = 0.0, np.log(max(count / ratio, min(count / 2, QUICK), 2))
        for _ in range(50):
            middle = 0.5 * (low + high)
            size = np.exp(middle)
            worth = SH_SHRINK * self.error(size) > rd_lambda * (ENTRY_BITS * size + LABEL_SHARE * count / np.log(2))
            low, high = (middle, high) if worth else (low, middle)
        return round(float(np.exp(low)))


def default_error(costs: Costs, splats: Splats, kept: Int[np.ndarray, " M"], gloss: CodebookErrorModel) -> float:
    """Mean squared error to aim at: about that of the paper's own settings, or of ``fast`` where that is less.

    The paper's 100 levels for rotations, 256 for the rest and 65,536 for positions are spread from each channel's least
    to its largest value, so that a single outlier spoils them; the steps of ``fast`` are absolute.

    Args:
        costs: of all Gaussians of ``kept``, ``(M,)``.
        splats: the scene.
        kept: the ``M`` Gaussians that a renderer draws.
        gloss: error of the view-dependent colour, by codebook size.
    """
    spans = [np.ptp(getattr(splats, name)[kept].astype(np.float64), axis=0) for name in ("opacities", "scales", "sh0")]
    opacity, scale, color = (span / 255 for span in spans)
    log_extent = np.ptp(signed_log(splats.means[kept]), axis=0)
    turns = np.full(3, 2.0)  # a quaternion's change of 1 turns by 2
    paper = (opacity, scale, turns * 2 / 99, color, log_extent / 65535)
    defaults = {name: field.default for name, field in EncodeSettings.model_fields.items()}
    levels = 2 ** means_bits(splats, kept, defaults["means_tolerance"]) - 1
    fast = (
        np.float64(defaults["opacity_step"]),
        np.full(3, defaults["scale_step"]),
        turns * defaults["quat_step"],
        np.full(3, defaults["sh0_step"]),
        log_extent / levels,
    )
    return min(
        _error(paper, PAPER_RATIO, costs, gloss), _error(fast, defaults["gaussians_per_codebook_entry"], costs, gloss)
    )


def _error(steps: Sequence[np.ndarray | np.float64], ratio: float, costs: Costs, gloss: CodebookErrorModel) -> float:
    """About the mean squared error of rounding to such steps of opacity, scale, turn, colour and position.

    Positions far from the origin may be as coarse as 16 bits let them be, whatever is spent: their error counts no more
    than that of as many other numbers.
    """
    each = (costs.opacity, costs.scale, costs.rotation, costs.color, costs.position)
    squares = [float(np.sum(np.square(step, dtype=np.float64))) for step in steps]
    terms = [float(cost.sum()) * square / 12 for cost, square in zip(each, squares, strict=True)]
    total = sum(terms[:-1])
    total += min(terms[-1], total * 3 / (DIMENSIONS - 3))
    entries = max(len(costs.color) / ratio, 1)
    return total + PAPER_GLOSS * gloss.plain * (gloss.entries / entries) ** SH_SHRINK


UNKNOWN = 9.5
"""Decibels by which errors that were put where these pictures do not show them exceed, in other pictures, what they are
in these; per unit of view uncertainty. Codebooks hardly follow the images once they are shrunk towards the prior, so
SH rest is not among them."""


NEARLY = 1.1
"""Times the least error that a scene can be left at: the last 0.4 dB would take the last bit of everything."""

KNOWN_GLOSS, UNKNOWN_GLOSS = 0.2, 2.7
"""Share of the SH rest's errors that base colours cannot make up for, and how much more per unit of view uncertainty.
Measured."""


def error_at(
    rd_lambda: float, costs: Costs, gloss: CodebookErrorModel, drop: float, ratio: float, view_uncertainty: float
) -> float:
    """About the mean squared error at which everything in balance with ``rd_lambda`` leaves a scene."""
    count = len(costs.color)
    dropped = costs.removal[costs.pruned_by_rd(rd_lambda, drop)]
    rounding = GROWTH * DIMENSIONS * (count - len(dropped)) * rd_lambda / (2 * np.log(2))
    elsewhere = 10 ** (UNKNOWN * view_uncertainty / 10)
    made_up = KNOWN_GLOSS + UNKNOWN_GLOSS * view_uncertainty
    missing = gloss.error(max(gloss.best_size(rd_lambda, count, ratio), 1))
    return float(elsewhere * (rounding + GROWTH * dropped.sum()) + made_up * missing)


def lambda_for(
    error: float, costs: Costs, gloss: CodebookErrorModel, drop: float, ratio: float, view_uncertainty: float
) -> float:
    """The price at which a scene is left at about this mean squared error, or a little more than the least there is.

    The codebook has a largest size, so no price leaves less than its error.
    """
    low, high = np.log(1e-22), np.log(1e-2)
    error = max(error, NEARLY * error_at(1e-22, costs, gloss, drop, ratio, view_uncertainty))
    for _ in range(60):
        middle = 0.5 * (low + high)
        small = error_at(float(np.exp(middle)), costs, gloss, drop, ratio, view_uncertainty) < error
        low, high = (middle, high) if small else (low, middle)
    return float(np.exp(low))


def implied_lambda(error: float, count: int) -> float:
    """The price in balance with the mean squared error at which rounding has left ``count`` Gaussians."""
    return 2 * float(np.log(2)) * error / (GROWTH * DIMENSIONS * max(count, 1))


def _floored(cost: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, " M"]:
    seen = cost[cost > 0]
    return np.maximum(cost, max(FLOOR * float(np.median(seen)), 1e-30) if len(seen) else 1e-30)
