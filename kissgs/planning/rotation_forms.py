"""Choice among the 48 equivalent (rotation, scales) forms of a Gaussian, and rotations as three bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Bool, Float32, Float64, Int, UInt8
from kissgs.core.context import Workers
from kissgs.core.splats import Splats
from kissgs.planning.layout import box_blur
from kissgs.planning.quantize import Computed, Planning, for_each_block, selected

# Rotations as three components of a quaternion, a byte each; the fourth, not negative, follows from the length 1.

TABLE = (np.arange(256) / 255 - 0.5) * np.sqrt(2)  # value of each level; 0 lies between the levels 127 and 128

STEP = float(TABLE[1] - TABLE[0])

KEPT = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])  # by the index of the missing one in w, x, y, z


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


# Choice among the 48 equivalent (rotation, scales) forms of a Gaussian, which all have the same covariance.
#
# The axes of an ellipsoid can be ordered in 6 and directed in 4 right-handed ways, and q and -q are one rotation:
# 6 × 4 × 2 = 48. The paper (section 3.4) chooses among them by Parallel Representative Assignment Smoothing, PRAS.

# Quaternion g of each form, w x y z, the rotations of the cube: the new rotation is the Hamilton product q g.
_A, _H = 0.5**0.5, 0.5
ROTATIONS: Float64[np.ndarray, "24 4"] = np.array(
    [
        *((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)),
        *((_A, _A, 0, 0), (_A, -_A, 0, 0), (0, 0, _A, _A), (0, 0, _A, -_A)),
        *((0, _A, _A, 0), (_A, 0, 0, _A), (_A, 0, 0, -_A), (0, _A, -_A, 0)),
        *((_H, _H, _H, _H), (_H, -_H, -_H, _H), (_H, _H, -_H, -_H), (_H, -_H, _H, -_H)),
        *((_H, -_H, -_H, -_H), (_H, _H, -_H, _H), (_H, _H, _H, -_H), (_H, -_H, _H, _H)),
        *((_A, 0, -_A, 0), (0, _A, 0, _A), (_A, 0, _A, 0), (0, _A, 0, -_A)),
    ],
    dtype=np.float64,
)
# Scale order of each form, (24, 3): the new scales are the old ones at these indices.
PERMUTATIONS = np.repeat([(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)], 4, axis=0).astype(np.int64)
CHUNK = 1 << 16

SHAPE_COLUMNS = {"opacities": slice(0, 1), "scales": slice(1, 4), "quaternions": slice(4, 8)}  # by field


@dataclass(frozen=True, slots=True, eq=False)
class StoredShapes:
    """Opacity logits, log-scales and rotations of Gaussians in their stored form, computed a block at a time."""

    splats: Splats
    index: Int[np.ndarray, " M"]
    forms: UInt8[np.ndarray, " M"]
    w_is_one: bool = False  # whether quaternions are scaled such that w, not 0, is 1; else they have length 1

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, rows: slice) -> Float64[np.ndarray, "n 8"]:
        """Return opacity logit, log-scales and quaternion of some rows."""
        index = self.index[rows]
        quats, scales = apply_forms(
            unit_quats(self.splats, index), self.splats.scales.take(index, axis=0), self.forms[rows]
        )
        opacities = self.splats.opacities.take(index)[:, None]
        return np.concatenate([opacities, scales, quats / quats[:, :1] if self.w_is_one else quats], axis=1)

    def take(self, chosen: Int[np.ndarray, " K"] | Bool[np.ndarray, " M"]) -> StoredShapes:
        """Return the rows ``chosen``."""
        return StoredShapes(self.splats, self.index[chosen], self.forms[chosen], self.w_is_one)

    def field(self, name: str) -> Computed:
        """Return the columns of one of :data:`SHAPE_COLUMNS`."""
        if name == "opacities":  # needs no rotations
            return selected(self.splats.opacities[:, None], self.index)
        return Computed(len(self), lambda rows: self[rows][:, SHAPE_COLUMNS[name]])


def choose_forms(
    splats: Splats, cells: Int[np.ndarray, " cells"], side: int, planning: Planning
) -> tuple[StoredShapes, float]:
    """Choose the form of rotation and log-scales of the Gaussian in each of ``cells``, as the settings say. Where the
    container stores whole quaternions, which decoders normalise, those of canonical forms have w = 1: x, y and z hold
    the whole rotation, and w takes no bits."""
    settings, pool, report = planning.settings, planning.pool, planning.report("forms")
    if settings.rotation_form == "canonical":
        forms = np.empty(len(cells), np.uint8)

        def choose(rows: slice) -> None:
            forms[rows] = canonical_forms(unit_quats(splats, cells[rows]))

        for_each_block(len(cells), choose, pool)
    else:
        quats, scales = unit_quats(splats, cells), splats.scales.take(cells, axis=0)
        forms = pras_forms(quats, scales, side, pool, decay=settings.plas_radius_decay, report=report)
        _, first, index = np.unique(cells, return_index=True, return_inverse=True)
        forms = forms[first][index]  # all padding is equal: one Gaussian in one form
    w_is_one = planning.container.tables is None and settings.rotation_form == "canonical"
    shapes = StoredShapes(splats, cells, forms, w_is_one)

    def error(rows: slice) -> float:
        quats, scales = unit_quats(splats, cells[rows]), splats.scales.take(cells[rows], axis=0)
        return covariance_error(quats, scales, *apply_forms(quats, scales, forms[rows]))

    return shapes, max(for_each_block(len(cells), error, pool), default=0.0)


def unit_quats(splats: Splats, index: Int[np.ndarray, " M"]) -> Float64[np.ndarray, "M 4"]:
    """Return the rotations of some Gaussians; float32 lengths are exact to 1e-7 only."""
    quats = splats.quats.take(index, axis=0).astype(np.float64)
    w, x, y, z = quats.T
    return np.asarray(quats / np.sqrt(w * w + x * x + y * y + z * z)[:, None])


def apply_forms(
    quats: Float64[np.ndarray, "N 4"], scales: Float32[np.ndarray, "N 3"], forms: UInt8[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "N 4"], Float32[np.ndarray, "N 3"]]:
    """Rewrite each Gaussian in its form: 0 to 23, a row of the table; plus 24 if the quaternion is negated."""
    from kissgs.planning import kernels

    quats, scales, forms = (np.ascontiguousarray(array) for array in (quats, scales, forms))
    turned, permuted = np.empty_like(quats), np.empty_like(scales)
    kernels.apply_forms(quats, scales, forms, ROTATIONS, PERMUTATIONS, turned, permuted)
    return turned, permuted


def canonical_forms(quats: Float64[np.ndarray, "N 4"]) -> UInt8[np.ndarray, " N"]:
    """Return the form of largest w, which has the smallest rotation angle; among equals, the first of the table. All
    rotations are then within 63° of the identity: w is at least 0.85 and x, y, z use 40 % of their range."""
    from kissgs.planning import kernels

    forms = np.empty(len(quats), np.uint8)
    kernels.largest_w(np.ascontiguousarray(quats), ROTATIONS, forms)
    return forms


def pras_forms(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    side: int,
    pool: Workers,
    *,
    decay: float,
    report: Callable[[float], None] = lambda fraction: None,
) -> UInt8[np.ndarray, " N"]:
    """Choose forms that make neighbours on the grid similar: the closest to 8-bit proxies, blurred less and less. One
    proxy range serves the scales of all three axes, so that permuting them changes no proxy. All forms are those of the
    input, not of an intermediate form, so that rounding errors do not add up."""
    from kissgs.planning import kernels

    count = len(quats)
    forms = np.zeros(count, dtype=np.uint8)
    low, high = float(scales.min(initial=0)), float(scales.max(initial=0))
    quat_proxy = (quats * 127.5).astype(np.float32)
    scale_proxy = ((scales - low) * (255 / max(high - low, 1e-30))).astype(np.float32)
    rotations = ROTATIONS.astype(np.float32)
    radius = side / 2 - 1
    while radius >= 1:
        report(1 - np.log(radius) / np.log(side / 2))
        current = np.concatenate(apply_forms(quat_proxy.astype(np.float64), scale_proxy, forms), axis=1)
        proxy = np.rint(current).astype(np.float32)
        target = box_blur(proxy.reshape(side, side, 7), int(radius), pool).reshape(-1, 7)

        def choose(rows: slice, target: np.ndarray = target) -> None:
            kernels.nearest_forms(
                quat_proxy[rows], scale_proxy[rows], target[rows], rotations, PERMUTATIONS, forms[rows]
            )

        for_each_block(count, choose, pool, block=CHUNK)
        radius *= decay
    return forms


def covariance_error(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    new_quats: Float64[np.ndarray, "N 4"],
    new_scales: Float32[np.ndarray, "N 3"],
) -> float:
    """Return the largest relative difference of the covariances, Frobenius norm, over all Gaussians."""
    from kissgs.planning import kernels

    return float(kernels.covariance_error(*map(np.ascontiguousarray, (quats, scales, new_quats, new_scales))))
