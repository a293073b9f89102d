"""``ContainerModel``: the values that a container can hold; ``Planning``: inputs that all steps of planning share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.progress import Progress
from kissgs.core.resources import Workers
from kissgs.settings import EncodeSettings


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ByteTables:
    """Eight-bit levels that stand for the values of tables, as SOG has them.

    Scales, base colours and SH coefficients have one free table of 256 values each, for all their channels. Rotations
    are three of the quaternion's components, 255 steps from -1/sqrt(2) to 1/sqrt(2), and which one is left out.
    Positions have 65,536 levels over a range of their own per axis.
    """

    opacity_logits: Float64[np.ndarray, " 256"]  # opacity logit of each level, ascending
    first_drawn: int  # smallest level of opacity that renderers draw
    last_drawn: int  # largest level of opacity to use


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ContainerModel:
    """Description of the values that a container can hold."""

    tables: ByteTables | None = None  # None for even levels over a range per channel, and whole quaternions
    padding_last: bool = False  # whether cells without a Gaussian must follow all others
    entry_bits: float = 112  # typical size of an entry of the SH codebook, bits, at 45 dimensions


EVEN_LEVELS = ContainerModel()
"""Evenly spaced levels, and a mask that says which cells hold a Gaussian: the default."""


@dataclass(frozen=True, slots=True, eq=False)
class Planning:
    """Inputs that all steps of one planning share."""

    settings: EncodeSettings
    container: ContainerModel
    pool: Workers
    progress: Progress

    def report(self, stage: str) -> Callable[[float], None]:
        """Report that a stage begins, and return what reports the fraction of it that is done."""
        self.progress(stage, 0.0)
        return lambda fraction: self.progress(stage, fraction)
