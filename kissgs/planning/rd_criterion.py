"""Optimal quantisation steps by lambda, for each class of Gaussians.

lambda is squared image error per bit (:class:`kissgs.Sensitivity` measures the error). Rounding to a step d costs
H d²/12, and halving d costs one bit, so the optimum for any attribute is d² = 6 lambda / (ln 2 H). Each sensitivity
class has its own step, a multiple of the finest class's, so that the decoder needs no classes. WebP's entropy codes,
which vary over an image, spend no bits on a class's unused levels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float64, Int, Integer
from kissgs.planning.gaussian_costs import Costs

ROUNDED = ("opacity", "scale", "rotation", "color", "position")
"""Attributes of :class:`Costs` that are rounded to steps."""


def step(cost: float, rd_lambda: float) -> float:
    """Return the optimal quantisation step for a squared error of ``cost`` per squared unit."""
    return float(np.sqrt(6 * rd_lambda / (np.log(2) * cost)))


@dataclass(frozen=True, slots=True, eq=False)
class RdCriterion:
    """Costs, sensitivity classes and lambda, by which the levels of Gaussians are chosen.

    Attributes:
        costs: costs of the M Gaussians.
        classes: ``(M,)`` sensitivity class of each, from 0; no class is empty.
        rd_lambda: squared error per bit.
        steps: optimal step of each class for the attributes of ``costs``; None to compute them.
    """

    costs: Costs
    classes: Integer[np.ndarray, " M"]
    rd_lambda: float
    steps: Mapping[str, list[float]] | None = None

    def condensed(self) -> RdCriterion:
        """Return the steps and only the smallest costs, for what needs no more."""
        steps = {name: self.steps_of(name) for name in ROUNDED}
        least = {name: np.array([getattr(self.costs, name).min(initial=np.inf)]) for name in Costs.__slots__}
        return RdCriterion(Costs(**least), self.classes, self.rd_lambda, steps)

    def take(self, order: Int[np.ndarray, " M"]) -> RdCriterion:
        """Return the criterion with the Gaussians in another order."""
        costs = self.costs.take(order) if self.steps is None else self.costs
        return replace(self, costs=costs, classes=self.classes.take(order))

    def steps_of(self, name: str) -> list[float]:
        """Return the optimal step of each class for an attribute; a rotation has an error about each of three axes."""
        if self.steps is not None:
            return self.steps[name]
        return self.class_steps(getattr(self.costs, name), 3 if name == "rotation" else 1)

    def class_steps(self, cost: Float64[np.ndarray, " M"], channels: int = 1) -> list[float]:
        """Return the optimal step of each class for ``channels`` times the mean of ``cost``, error per squared unit."""
        number = int(self.classes.max()) + 1
        return [step(float((channels * cost[self.classes == c]).mean()), self.rd_lambda) for c in range(number)]
