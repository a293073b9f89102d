"""Rotations as three components of a quaternion, a byte each; the fourth, not negative, follows from the length 1."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float64, Int, UInt8

TABLE = (np.arange(256) / 255 - 0.5) * np.sqrt(2)
"""Value of each level; 0 lies between the levels 127 and 128."""

STEP = float(TABLE[1] - TABLE[0])

KEPT = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The three stored components, by the index of the missing one in w, x, y, z."""


def omitted_components(quats: Float64[np.ndarray, "N 4"]) -> UInt8[np.ndarray, " N"]:
    """Return the component to leave out: w where it is at least 1/sqrt(2), as in canonical forms, else the largest."""
    largest = np.abs(quats).argmax(axis=1)
    return np.where(np.abs(quats[:, 0]) >= np.sqrt(0.5), 0, largest).astype(np.uint8)


def with_sign(quats: Float64[np.ndarray, "N 4"], omitted: UInt8[np.ndarray, " N"]) -> Float64[np.ndarray, "N 4"]:
    """Negate quaternions whose missing component is negative; the rotation is the same."""
    missing = np.take_along_axis(quats, omitted[:, None].astype(np.int64), axis=1)
    return np.where(missing < 0, -quats, quats)


def stored_components(
    quats: Float64[np.ndarray, "N 4"], omitted: UInt8[np.ndarray, " N"]
) -> Float64[np.ndarray, "N 3"]:
    """Return the three components that are stored."""
    return np.take_along_axis(quats, KEPT[omitted], axis=1)


def lattice_levels(small: Float64[np.ndarray, "N 3"], stride: int | Int[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Return the nearest of every ``stride``-th level around 127, such that the squares add up to at most 1."""
    every = np.reshape(np.asarray(stride, np.int64), (-1, 1))
    levels = np.clip(np.rint((small / STEP + 0.5) / every) * every + 127, 0, 255).astype(np.int64)
    exact = np.clip(np.rint(small / STEP + 127.5), 0, 255).astype(np.int64)
    levels = np.where(fits(levels)[:, None], levels, exact)
    while not (good := fits(levels)).all():  # towards 0, level by level
        levels = np.where(good[:, None], levels, levels + (levels < 127) - (levels > 128))
    return levels.astype(np.uint8)


def fits(levels: Int[np.ndarray, "N 3"]) -> np.ndarray:
    """Whether the squares of three components add up to at most 1, so that a fourth exists."""
    return np.asarray(np.square(TABLE[levels]).sum(axis=1) <= 1)


def whole(
    small: Float64[np.ndarray, "N 3"], omitted: Int[np.ndarray, " N"] | UInt8[np.ndarray, " N"]
) -> Float64[np.ndarray, "N 4"]:
    """Return the quaternions of length 1 with these components, and one that is not negative."""
    quats = np.empty((len(small), 4))
    np.put_along_axis(quats, KEPT[omitted], small, axis=1)
    missing = np.sqrt(np.maximum(0, 1 - np.square(small).sum(axis=1, keepdims=True)))
    np.put_along_axis(quats, omitted[:, None].astype(np.int64), missing, axis=1)
    return quats


def strides(step: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Return the multiple of the levels' distance nearest to each step, from 1 to 64."""
    return np.clip(np.rint(step / STEP), 1, 64).astype(np.int64)
