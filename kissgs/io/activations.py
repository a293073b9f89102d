"""Values and 8-bit codes of other formats -> the stored (pre-activation) parameters of a scene."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int, Shaped, UInt8
from kissgs.core.splats import OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN, SH_C0

_ROWS = 1 << 14
"""Gaussians per step, so that temporaries stay in the processor's cache."""

_SLOTS = np.array([[0, 1, 2, 3], [1, 0, 2, 3], [1, 2, 0, 3], [1, 2, 3, 0]])
"""Indices of the four components in (largest, first, second, third of the others), by the index of the largest."""


def opacity_logits(opacities: Float[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """Return the logits of opacities, which are first clamped to 1e-6 and 1 - 1e-6."""
    with np.errstate(all="ignore"):  # 0, 1, NaN and numbers beyond 0 to 1 have no logit
        wide = np.clip(opacities.astype(np.float64), 0, 1)
        logits = np.log(wide) - np.log1p(-wide)
    return np.clip(logits, OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX).astype(np.float32)


def log_scales(scales: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
    """Return logarithms of standard deviations: -inf of 0, NaN of a negative one."""
    with np.errstate(all="ignore"):
        logs: Float32[np.ndarray, "N 3"] = np.log(scales.astype(np.float64)).astype(np.float32)
    return logs


OPACITY_OF_BYTE = opacity_logits(np.arange(256) / 255)
"""Opacity logit of each 8-bit opacity."""

SH0_OF_BYTE = ((np.arange(256) / 255 - 0.5) / SH_C0).astype(np.float32)
"""Constant SH coefficient of each 8-bit colour."""


def look_up(
    table: Float32[np.ndarray, " levels"], codes: Shaped[np.ndarray, "..."], out: Float32[np.ndarray, "..."]
) -> None:
    """Write the value of every code to ``out``; codes must be below the table's length."""
    for start in range(0, len(codes), _ROWS):
        np.take(table, codes[start : start + _ROWS], out=out[start : start + _ROWS], mode="clip")


def insert_largest(small: Float64[np.ndarray, "B 3"], index: Int[np.ndarray, " B"]) -> Float64[np.ndarray, "B 4"]:
    """Return unit quaternions of which the component at ``index``, not negative, is given by the three others."""
    largest = np.sqrt(np.maximum(0, 1 - (small * small).sum(axis=1, keepdims=True)))
    parts = np.concatenate([largest, small], axis=1)
    quats: Float64[np.ndarray, "B 4"] = np.take_along_axis(parts, _SLOTS[index], axis=1)
    return quats


def byte_quats(codes: UInt8[np.ndarray, "B 4"]) -> Float64[np.ndarray, "B 4"]:
    """Return the rotations of four bytes, (byte - 128) / 128 each, with unit length; 128 four times is a zero."""
    quats = (codes.astype(np.float64) - 128) / 128
    norms = np.sqrt((quats * quats).sum(axis=1, keepdims=True))
    return quats / np.where(norms == 0, 1, norms)


def steps(count: int) -> list[slice]:
    """Return slices of some thousand rows that cover ``count`` rows."""
    return [slice(start, min(start + _ROWS, count)) for start in range(0, count, _ROWS)]
