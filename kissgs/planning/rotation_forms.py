"""Choice among the 48 equivalent (rotation, scales) forms of a Gaussian, which all have the same covariance.

The axes of an ellipsoid can be ordered in 6 and directed in 4 right-handed ways, and q and -q are one rotation:
6 × 4 × 2 = 48. The 24 quaternions below are the rotations of the cube, which are closed under multiplication. PRAS is
the paper's name (section on permutation-rotation sorting) for choosing among them.

* :func:`canonical_forms`, of kissgs: the form nearest to the identity. All quaternions then lie within 63° of it, w is
  nearly constant and x, y, z use 40 % of their range.
* :func:`pras_forms`, of the paper: the form most similar to its neighbours on the grid.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, UInt8
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.planning.plas import box_blur
from kissgs.settings import EncodeSettings

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
"""Quaternion g of each form, w x y z: the new rotation is the Hamilton product q g."""

PERMUTATIONS = np.repeat([(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)], 4, axis=0).astype(np.int64)
"""Scale order of each form, ``(24, 3)``: the new scales are the old ones at these indices."""

CHUNK = 1 << 16


def canonicalize(
    splats: Splats,
    cells: Int[np.ndarray, " cells"],
    side: int,
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
) -> tuple[Float64[np.ndarray, "cells 4"], Float32[np.ndarray, "cells 3"], float, UInt8[np.ndarray, " cells"]]:
    """Rewrite rotations and log-scales of the Gaussians in ``cells`` in the form that the settings choose.

    Returns:
        Quaternions, log-scales, the largest relative change of a covariance (by rounding only), and the forms.
    """
    quats, scales = splats.quats[cells].astype(np.float64), splats.scales[cells]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)  # float32 lengths are exact to 1e-7 only
    if settings.rotation_form == "canonical":
        forms = canonical_forms(quats)
    else:
        forms = pras_forms(quats, scales, side, pool, decay=settings.plas_radius_decay, report=report)
    new_quats, new_scales = apply_forms(quats, scales, forms)
    return new_quats, new_scales, covariance_error(quats, scales, new_quats, new_scales), forms


def apply_forms(
    quats: Float64[np.ndarray, "N 4"], scales: Float32[np.ndarray, "N 3"], forms: UInt8[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "N 4"], Float32[np.ndarray, "N 3"]]:
    """Rewrite each Gaussian in its form: 0 to 23, a row of the table; plus 24 if the quaternion is negated."""
    row = forms % 24
    turned = _multiply(quats, ROTATIONS[row])
    turned[forms >= 24] *= -1
    return turned, np.take_along_axis(scales, PERMUTATIONS[row], axis=1)


def canonical_forms(quats: Float64[np.ndarray, "N 4"]) -> UInt8[np.ndarray, " N"]:
    """Return the form of largest w, which has the smallest rotation angle; among equals, the first of the table."""
    forms = np.empty(len(quats), dtype=np.uint8)
    # w of q g is the scalar product of q with the conjugate of g; without rounding, equal forms would differ.
    conjugates = ROTATIONS * (1, -1, -1, -1)
    for first in range(0, len(quats), CHUNK):
        rows = slice(first, first + CHUNK)
        w = np.round(quats[rows] @ conjugates.T, 9)
        forms[rows] = np.concatenate([w, -w], axis=1).argmax(axis=1)
    return forms


def pras_forms(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    side: int,
    pool: Workers,
    *,
    decay: float = 0.95,
    report: Callable[[float], None] = lambda fraction: None,
) -> UInt8[np.ndarray, " N"]:
    """Choose forms that make neighbours on the grid similar: the closest to 8-bit proxies, blurred less and less.

    Args:
        quats: unit quaternions, row-major on the grid of ``side`` × ``side`` cells.
        scales: log-scales. One proxy range serves all three axes, so that permuting them changes no proxy.
        side: cells per axis.
        pool: threads for the rows; the result does not depend on their number.
        decay: factor from one blur radius to the next.
        report: receives the fraction done, 0 to 1.

    Returns:
        The chosen forms of the input, not of an intermediate form, so that rounding errors do not add up.
    """
    from kissgs.planning import kernels

    count = len(quats)
    forms = np.zeros(count, dtype=np.uint8)
    low, high = float(scales.min(initial=0)), float(scales.max(initial=0))
    quat_proxy = (quats * 127.5).astype(np.float32)
    scale_proxy = ((scales - low) * (255 / max(high - low, 1e-30))).astype(np.float32)
    rotations = ROTATIONS.astype(np.float32)
    edges = range(0, count, CHUNK)
    radius = side / 2 - 1
    while radius >= 1:
        report(1 - np.log(radius) / np.log(side / 2))
        current = np.concatenate(apply_forms(quat_proxy.astype(np.float64), scale_proxy, forms), axis=1)
        proxy = np.rint(current).astype(np.float32)
        target = box_blur(proxy.reshape(side, side, 7), int(radius), pool).reshape(-1, 7)

        def choose(first: int, target: np.ndarray = target) -> None:
            rows = slice(first, min(first + CHUNK, count))
            kernels.nearest_forms(
                quat_proxy[rows], scale_proxy[rows], target[rows], rotations, PERMUTATIONS, forms[rows]
            )

        pool.map(choose, edges)
        radius *= decay
    return forms


def covariance_error(
    quats: Float64[np.ndarray, "N 4"],
    scales: Float32[np.ndarray, "N 3"],
    new_quats: Float64[np.ndarray, "N 4"],
    new_scales: Float32[np.ndarray, "N 3"],
) -> float:
    """Return the largest relative difference of the covariances, Frobenius norm, over all Gaussians."""
    worst = 0.0
    for first in range(0, len(quats), CHUNK):
        rows = slice(first, first + CHUNK)
        largest = scales[rows].max(axis=1, keepdims=True).astype(np.float64)  # avoids squares of e^±60
        before = _covariance(quats[rows], scales[rows] - largest)
        after = _covariance(new_quats[rows], new_scales[rows] - largest)
        error = np.linalg.norm(after - before, axis=(1, 2)) / np.linalg.norm(before, axis=(1, 2))
        worst = max(worst, float(error.max(initial=0.0)))
    return worst


def _covariance(quats: Float64[np.ndarray, "N 4"], scales: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3 3"]:
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = np.array(rows).transpose(2, 0, 1)
    axes = rotation * np.exp(scales)[:, None, :]
    return np.asarray(axes @ axes.transpose(0, 2, 1))


def _multiply(p: Float64[np.ndarray, "N 4"], q: Float64[np.ndarray, "N 4"]) -> Float64[np.ndarray, "N 4"]:
    """Return the Hamilton product, row by row."""
    w1, x1, y1, z1 = p.T
    w2, x2, y2, z2 = q.T
    return np.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        axis=1,
    )
