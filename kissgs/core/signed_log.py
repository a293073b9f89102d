"""Signed logarithm, in which positions are stored, and its inverse."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float64


def signed_log(x: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return sign(x) ln(1 + |x|), in float64."""
    wide = x.astype(np.float64)
    return np.copysign(np.log1p(np.abs(wide)), wide)


def signed_exp(y: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return sign(y) (e^|y| - 1), in float64: the inverse of :func:`signed_log`."""
    wide = y.astype(np.float64)
    return np.copysign(np.expm1(np.abs(wide)), wide)
