"""Values of the ``.spz`` format: from the bytes of each stream to arrays."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, UInt8
from kissgs.io.activations import insert_largest, steps

_BYTE = np.arange(256)

SCALE_OF_BYTE = (_BYTE / 16 - 10).astype(np.float32)
"""Natural logarithm of a standard deviation, in steps of 1/16."""

COLOR_OF_BYTE = ((_BYTE / 255 - 0.5) / 0.15).astype(np.float32)
"""Constant SH coefficient; 0.15, not the harmonic's value, is the format's factor."""

SH_OF_BYTE = ((_BYTE - 128) / 128).astype(np.float32)
"""Other SH coefficients."""


def decode_half_positions(codes: UInt8[np.ndarray, "N 6"], out: Float32[np.ndarray, "N 3"]) -> None:
    """Decode positions of version 1: half floats."""
    with np.errstate(all="ignore"):  # values may be any floats; they are not cleaned here
        out[:] = codes.view("<f2")


def decode_positions(codes: UInt8[np.ndarray, "N 9"], fractional_bits: int, out: Float32[np.ndarray, "N 3"]) -> None:
    """Decode positions of versions 2 and later: 24-bit integers, little-endian, of steps of 2^-fractional_bits."""
    for part in steps(len(codes)):
        low, middle, high = (codes[part, i::3].astype(np.int32) for i in range(3))
        signed = (low << 8 | middle << 16 | high << 24) >> 8
        out[part] = np.ldexp(signed.astype(np.float64), -fractional_bits)


def decode_three_bytes(codes: UInt8[np.ndarray, "N 3"], out: Float32[np.ndarray, "N 4"]) -> None:
    """Decode rotations of versions 1 and 2 to w, x, y, z: x, y, z in a byte each, w the rest of the unit length."""
    for part in steps(len(codes)):
        small = codes[part] / 127.5 - 1
        out[part] = insert_largest(small, np.zeros(len(small), np.int64))


def decode_smallest_three(codes: UInt8[np.ndarray, "N 4"], out: Float32[np.ndarray, "N 4"]) -> None:
    """Decode rotations of versions 3 and later to w, x, y, z.

    Of a word's 32 bits the highest two name the largest of x, y, z, w; the others follow, the last in the lowest ten
    bits: nine of magnitude, one of sign.
    """
    words = codes.view("<u4")[:, 0]
    for part in steps(len(codes)):
        word = words[part]
        fields = np.stack([word >> shift & 1023 for shift in (20, 10, 0)], axis=1)
        magnitude = (fields & 511) / 511 * np.sqrt(0.5)
        xyzw = insert_largest(np.where(fields & 512, -magnitude, magnitude), (word >> 30).astype(np.int64))
        out[part] = np.roll(xyzw, 1, axis=1)
