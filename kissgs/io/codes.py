"""Stored (pre-activation) parameters of a scene -> values and codes of other formats; activations.py goes back."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int64, UInt8
from kissgs.core.splats import SH_C0

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the three other components of a quaternion, by the index of the largest."""


def opacities_of(logits: Float32[np.ndarray, " B"]) -> Float64[np.ndarray, " B"]:
    """Return the opacities, 0 to 1, of finite logits."""
    return 1 / (1 + np.exp(-logits.astype(np.float64)))


def colors_of(sh0: Float32[np.ndarray, "B 3"]) -> Float64[np.ndarray, "B 3"]:
    """Return the colours of the constant SH coefficients; 0 to 1 is visible, others are beyond."""
    return 0.5 + SH_C0 * sh0.astype(np.float64)


def to_codes(values: Float[np.ndarray, "..."], largest: int = 255) -> Int64[np.ndarray, "..."]:
    """Return the nearest whole numbers, half rounded up, clamped to 0 to ``largest``."""
    return np.clip(np.floor(values + 0.5), 0, largest).astype(np.int64)


def to_bytes(values: Float[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    """Return the nearest bytes, half rounded up, clamped to 0 to 255."""
    return to_codes(values).astype(np.uint8)


def split_largest(
    quats: Float32[np.ndarray, "B 4"],
) -> tuple[Int64[np.ndarray, " B"], Float64[np.ndarray, "B 3"]]:
    """Return the index of each quaternion's largest component, and the others once it is positive."""
    wide = quats.astype(np.float64)
    index = np.abs(wide).argmax(axis=1)[:, None]
    sign = np.where(np.take_along_axis(wide, index, axis=1) < 0, -1, 1)
    return index[:, 0], sign * np.take_along_axis(wide, _OTHERS[index[:, 0]], axis=1)


def note_mark(notes: list[str], antialiased: bool) -> None:
    """Append to ``notes`` that a format without a place for the mark of an antialiased scene leaves it out."""
    if antialiased:
        notes.append("the mark of antialiasing is left out, and viewers will draw small and thin Gaussians too opaque")


def note_clamped(notes: list[str], what: str, values: np.ndarray, low: float, high: float, limits: str) -> None:
    """Append to ``notes`` how many Gaussians have a value below ``low`` or above ``high``, if there are any."""
    if values.size == 0 or (values.min() >= low and values.max() <= high):
        return
    rows = ((values < low) | (values > high)).reshape(len(values), -1).any(axis=1)
    count = int(rows.sum())
    notes.append(f"{what} of {count:,} Gaussian{'s' if count > 1 else ''} are clamped to {limits}")
