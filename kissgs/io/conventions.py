"""Conventions of other formats: activated values and 8-bit codes, axes, Morton order; and those of a ``.ply``."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int, Int64, Shaped, UInt8
from kissgs.core.errors import UnsupportedError
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN, SH_C0, Splats, blocks

# Values and 8-bit codes of other formats -> the stored (pre-activation) parameters of a scene.

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


OPACITY_OF_BYTE = opacity_logits(np.arange(256) / 255)  # opacity logit of each 8-bit opacity
SH0_OF_BYTE = ((np.arange(256) / 255 - 0.5) / SH_C0).astype(np.float32)  # constant SH coefficient of each 8-bit colour


def look_up(
    table: Float32[np.ndarray, " levels"], codes: Shaped[np.ndarray, "..."], out: Float32[np.ndarray, "..."]
) -> None:
    """Write the value of every code to ``out``; codes must be below the table's length."""
    for part in blocks(len(codes)):
        np.take(table, codes[part], out=out[part], mode="clip")


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


# Stored (pre-activation) parameters of a scene -> values and codes of other formats.

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # the other components of a quaternion, by the largest


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


def split_largest(quats: Float32[np.ndarray, "B 4"]) -> tuple[Int64[np.ndarray, " B"], Float64[np.ndarray, "B 3"]]:
    """Return the index of each quaternion's largest component, and the others once it is positive."""
    wide = quats.astype(np.float64)
    index = np.abs(wide).argmax(axis=1)[:, None]
    sign = np.where(np.take_along_axis(wide, index, axis=1) < 0, -1, 1)
    return index[:, 0], sign * np.take_along_axis(wide, _OTHERS[index[:, 0]], axis=1)


def refuse_empty(splats: Splats, ending: str) -> None:
    """Raise UnsupportedError for a scene without Gaussians, which the format with this ending cannot hold."""
    if not len(splats):
        raise UnsupportedError(f"a scene without Gaussians cannot be written as {ending}; write it as .ply")


def marks_left_out(splats: Splats) -> list[str]:
    """Return what is lost of an antialiased scene in a format without a place for its mark."""
    text = "the mark of antialiasing is left out, and viewers will draw small and thin Gaussians too opaque"
    return [text] * splats.antialiased


def clamped(what: str, values: np.ndarray, low: float, high: float, limits: str) -> list[str]:
    """Return a phrase about the number of Gaussians with a value below ``low`` or above ``high``, if there are any."""
    if values.size == 0 or (values.min() >= low and values.max() <= high):
        return []
    count = int(((values < low) | (values > high)).reshape(len(values), -1).any(axis=1).sum())
    return [f"{what} of {count:,} Gaussian{'s' * (count > 1)} are clamped to {limits}"]


# Axes of other formats, and those of a ``.ply``: x right, y down, z forward.

Signs = tuple[int, int, int]  # sign of each axis, 1 or -1


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
    for part in blocks(len(splats)):
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
    for part in blocks(len(splats)):
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


# Morton order: Gaussians that follow one another are close to one another.

_BITS = 21  # bits per axis: three axes fill 63 of 64 bits
_OUTSIDE = 1e-3  # share of Gaussians at either end of an axis that is not resolved, so that outliers coarsen nothing

_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the indices of the Gaussians in Morton order; equal places keep their order."""
    if len(means) == 0:
        return np.empty(0, np.int64)
    ends = np.quantile(means, [_OUTSIDE, 1 - _OUTSIDE], axis=0).astype(np.float64)
    extent = float((ends[1] - ends[0]).max()) or 1.0
    codes = np.zeros(len(means), np.uint64)
    for axis in range(3):
        cells = np.clip((means[:, axis].astype(np.float64) - ends[0, axis]) / extent, 0, 1) * (2**_BITS - 1)
        codes |= spread_bits(cells.astype(np.uint64)) << np.uint64(axis)
    return np.argsort(codes, kind="stable").astype(np.int64)


def spread_bits(cells: Shaped[np.ndarray, " N"]) -> Shaped[np.ndarray, " N"]:
    """Return uint64 numbers of at most 21 bits with two zeros before each bit."""
    for shift, mask in _SPREAD:
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    return cells
