"""Values of the ``.spz`` format: from the bytes of each stream to arrays, and back."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float32, UInt8
from kissgs.io.activations import insert_largest, steps
from kissgs.io.codes import split_largest, to_bytes, to_codes

_BYTE = np.arange(256)

SCALE_OF_BYTE = (_BYTE / 16 - 10).astype(np.float32)
"""Natural logarithm of a standard deviation, in steps of 1/16."""

COLOR_OF_BYTE = ((_BYTE / 255 - 0.5) / 0.15).astype(np.float32)
"""Constant SH coefficient; 0.15, not the harmonic's value, is the format's factor."""

SH_OF_BYTE = ((_BYTE - 128) / 128).astype(np.float32)
"""Other SH coefficients."""

SH_STEPS = (4, 8)
"""Steps of the codes that are written, in the first band and above: 6 and 5 bits. Readers need not know them.

The format's own library writes 5 and 4 bits by default, which lose two decibels of fox to its photographs; the figures
are in docs/reference/formats.md.
"""


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


def fractional_bits_for(reach: float) -> int:
    """Return the bits after the binary point of positions up to ``reach`` from the origin along an axis.

    They are 12, as the format's own library writes; fewer where a scene reaches beyond ±2048, and more where it is
    smaller than ±4, so that it has at least 2^14 steps; 23 are the most.
    """
    exponent = int(np.frexp(reach)[1])
    return max(0, min(23 - exponent, max(12, 15 - exponent), 23))


def encode_positions(means: Float[np.ndarray, "B 3"], fractional_bits: int) -> UInt8[np.ndarray, "B 9"]:
    """Encode positions as the nearest steps, clamped to 24 bits."""
    steps_of = np.floor(np.ldexp(means.astype(np.float64), fractional_bits) + 0.5)
    codes = np.clip(steps_of, -(1 << 23), (1 << 23) - 1).astype("<i4")
    return codes.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3].reshape(len(means), 9)


def encode_scales(scales: Float32[np.ndarray, "B 3"]) -> UInt8[np.ndarray, "B 3"]:
    """Encode logarithms of standard deviations, clamped to -10 to 5.9375."""
    return to_bytes((scales.astype(np.float64) + 10) * 16)


def encode_colors(sh0: Float32[np.ndarray, "B 3"]) -> UInt8[np.ndarray, "B 3"]:
    """Encode constant SH coefficients, clamped to ±3.3333."""
    return to_bytes(255 * (0.15 * sh0.astype(np.float64) + 0.5))


def encode_sh(shN: Float[np.ndarray, "B K 3"]) -> UInt8[np.ndarray, "B bytes"]:
    """Encode other SH coefficients, each band in its own steps."""
    step = np.where(np.arange(shN.shape[1]) < 3, *SH_STEPS)[:, None]
    codes = np.floor(np.clip(shN.astype(np.float64), -2, 2) * 128 + 128.5).astype(np.int64)
    return np.clip((codes + step // 2) // step * step, 0, 255).astype(np.uint8).reshape(len(shN), 3 * shN.shape[1])


def encode_smallest_three(quats: Float32[np.ndarray, "B 4"]) -> UInt8[np.ndarray, "B 4"]:
    """Encode rotations w, x, y, z in the 32 bits of :func:`decode_smallest_three`."""
    index, small = split_largest(np.roll(quats, -1, axis=1))
    fields = to_codes(511 * np.sqrt(2) * np.abs(small), 511) | (small < 0).astype(np.int64) << 9
    words = index << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return words.astype("<u4").view(np.uint8).reshape(len(quats), 4)
