"""Axes of other formats, and those of a ``.ply``: x right, y down, z forward."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import Splats

Signs = tuple[int, int, int]
"""Sign of each axis, 1 or -1."""


def axis_signs(frame: str) -> Signs:
    """Return the signs from a frame to that of a ``.ply``; ``RUB`` is x right, y up, z back."""
    return (1 if frame[0] == "R" else -1), (1 if frame[1] == "D" else -1), (1 if frame[2] == "F" else -1)


@np.errstate(all="ignore")  # values may be any floats; they are not cleaned here
def mirror(splats: Splats, signs: Signs) -> None:
    """Mirror a scene in place: multiply the axes by ``signs``. Any number of them may be negative."""
    for array, factors in ((splats.means, signs), (splats.quats, quat_signs(signs))):
        # Not numpy.negative of columns in place: with four columns, NumPy 2.4 gives wrong numbers.
        np.multiply(array, np.array(factors, np.float32), out=array)
    np.multiply(splats.shN, sh_signs(signs, splats.shN.shape[1])[:, None], out=splats.shN)


def quat_signs(signs: Signs) -> tuple[int, int, int, int]:
    """Return the signs of w, x, y, z when axes get ``signs``: an axis of rotation turns over with the two others."""
    x, y, z = signs
    return 1, y * z, x * z, x * y


def sh_signs(signs: Signs, coefficients: int) -> Float32[np.ndarray, " K"]:
    """Return the signs of the first SH coefficients in ``shN`` when axes get ``signs``: the parity of each harmonic."""
    x, y, z = signs
    bands = (y, z, x), (x * y, y * z, 1, x * z, 1), (y, x * y * z, y, z, x, z, x)
    return np.array([sign for band in bands for sign in band][:coefficients], np.float32)


@np.errstate(all="ignore")
def move(splats: Splats, rotation: Float64[np.ndarray, "3 3"], scale: float, shift: Float64[np.ndarray, " 3"]) -> None:
    """Scale a scene about the origin, rotate and then shift it, in place."""
    for start in range(0, len(splats), 1 << 16):
        part = slice(start, start + (1 << 16))
        splats.means[part] = scale * splats.means[part].astype(np.float64) @ rotation.T + shift
        splats.quats[part] = _product(_quaternion(rotation), splats.quats[part].astype(np.float64))
    np.add(splats.scales, np.float32(np.log(scale)), out=splats.scales)
    if splats.shN.shape[1] and not np.array_equal(rotation, np.eye(3)):
        _rotate_sh(splats, rotation)


def _rotate_sh(splats: Splats, rotation: Float64[np.ndarray, "3 3"]) -> None:
    """Rotate the view-dependent colour: in direction d it is that of the unrotated scene in direction R^T d."""
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = (sh_basis(d, splats.sh_degree)[:, 1:] for d in (directions @ rotation, directions))
    turn = np.linalg.lstsq(after, before, rcond=None)[0]
    for start in range(0, len(splats), 1 << 14):
        part = slice(start, start + (1 << 14))
        splats.shN[part] = np.einsum("kj,njc->nkc", turn, splats.shN[part].astype(np.float64))


def _product(a: Float64[np.ndarray, " 4"], b: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Multiply quaternions (w, x, y, z)."""
    w, x, y, z = a
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return b @ matrix.T


def _quaternion(rotation: Float64[np.ndarray, "3 3"]) -> Float64[np.ndarray, " 4"]:
    """Return the quaternion (w, x, y, z) of a rotation matrix: the eigenvector of a symmetric matrix made of it."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation
    symmetric = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    vector: Float64[np.ndarray, " 4"] = np.linalg.eigh(symmetric)[1][:, -1]
    return vector if vector[0] >= 0 else -vector
