"""The backward pass of one image on the CPU, independent of the number of threads.

Only Gaussians that contribute to the image have gradients: of many Gaussians, most lie outside it, or behind others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numba import boolean, float32, float64, int32, int64, njit, void

from kissgs.core.array_types import Bool, Float32, Int32, Shaped
from kissgs.core.numba_kernels import compiled
from kissgs.core.resources import Workers
from kissgs.core.splats import SH_C0
from kissgs.rendering.cpu.blending import (
    _FAST,
    Place,
    _alpha,
    _copy_records,
    _copy_stops,
    _footprint,
    _pixel_centres,
    _rows,
)
from kissgs.rendering.cpu.frame import Frame
from kissgs.rendering.cpu.projection import (
    Bounds,
    Matrix,
    Quat,
    Vector,
    _applied,
    _by_quat,
    _cholesky,
    _clamped,
    _cross,
    _dot,
    _ellipsoid,
    _frustum,
    _helper,
    _image_axes,
    _image_rows,
    _in_camera,
    _jacobian,
    _load,
    _mix,
    _pose,
    _scaled,
    _strain,
    _times,
    _unit,
    _whitened,
    shade_backward,
)
from kissgs.rendering.cpu.records import (
    BLENDED,
    FOOTPRINTS,
    GAUSSIANS,
    PROJECTION,
    SLOTS,
    TILE_LISTS,
    Blended,
    Footprints,
    Gaussians,
    Projection,
    Slots,
    TileLists,
)
from kissgs.rendering.cpu.tiles import each_part, even, even_tiles, number_slots

# Blending, tile by tile; see :mod:`kissgs.rendering.cpu.blending`.


@njit(nogil=True, error_model="numpy")
def _copy_gradient(v_image: np.ndarray, x0: int, y0: int, s: np.ndarray) -> None:
    """Write the gradient of a tile's pixels by R, G, B from the fifth 256 values of ``s`` on; 0 beyond the image."""
    height, width, _ = v_image.shape
    for p in range(256):
        x, y = x0 + (p & 15), y0 + (p >> 4)
        inside = x < width and y < height
        x, y = min(x, width - 1), min(y, height - 1)
        s[1024 + p] = v_image[y, x, 0] if inside else np.float32(0)
        s[1280 + p] = v_image[y, x, 1] if inside else np.float32(0)
        s[1536 + p] = v_image[y, x, 2] if inside else np.float32(0)


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _begin_tile(frame: Blended, v_alpha: np.ndarray, x0: int, y0: int, s: np.ndarray) -> None:
    """Write T, the gradient by alpha, and the product of the background and its gradient of a tile's pixels."""
    height, width = v_alpha.shape
    background = frame.background
    for p in range(256):
        x, y = x0 + (p & 15), y0 + (p >> 4)
        inside = x < width and y < height
        x, y = min(x, width - 1), min(y, height - 1)
        s[768 + p] = frame.transmittance[y, x] if inside else np.float32(1)
        s[1792 + p] = v_alpha[y, x] if inside else np.float32(0)
        s[2048 + p] = background[0] * s[1024 + p] + background[1] * s[1280 + p] + background[2] * s[1536 + p]


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _backward(
    s: np.ndarray,
    span: np.uint16,
    index: np.float32,
    footprint: tuple[Place, tuple[np.float32, ...]],
    limits: tuple[np.float32, np.float32],
    sums: np.ndarray,
) -> None:
    """Compute the nine sums of one footprint over a tile's pixels, and step in front of it."""
    place, (opacity, red, green, blue) = footprint
    zero, one = np.float32(0), np.float32(1)
    top, bottom = _rows(span)
    m, mu, mv, muu, muv, mvv, vr, vg, vb = zero, zero, zero, zero, zero, zero, zero, zero, zero
    for p in range(top, bottom):
        drawn = index < s[p + np.uint64(512)]
        u, v, full, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
        t = s[p + np.uint64(768)] / (one - alpha)
        s[p + np.uint64(768)] = t
        gr, gg, gb = s[p + np.uint64(1024)], s[p + np.uint64(1280)], s[p + np.uint64(1536)]
        weight = alpha * t
        vr += weight * gr
        vg += weight * gg
        vb += weight * gb
        change = red * gr + green * gg + blue * gb + s[p + np.uint64(1792)] - s[p + np.uint64(2048)]
        s[p + np.uint64(2048)] += alpha * change
        g = -weight * change
        g = g if full <= limits[1] else zero
        m += g
        mu += g * u
        mv += g * v
        muu += g * u * u
        muv += g * u * v
        mvv += g * v * v
    sums[0], sums[1], sums[2], sums[3], sums[4], sums[5] = m, mu, mv, muu, muv, mvv
    sums[6], sums[7], sums[8] = vr, vg, vb


@compiled(
    void(
        float32[:, ::1],
        TILE_LISTS,
        SLOTS,
        int64,
        int64,
        BLENDED,
        float32[:, :, ::1],
        float32[:, ::1],
        float32[:, ::1],
        boolean[::1],
    ),
    fastmath=_FAST,
)
def blend_backward(
    records: np.ndarray,
    lists: TileLists,
    slots: Slots,
    first: int,
    last: int,
    frame: Blended,
    v_image: np.ndarray,
    v_alpha: np.ndarray,
    v_slots: np.ndarray,
    changed: np.ndarray,
) -> None:
    """Compute the gradients of tiles ``first`` to ``last`` (exclusive), given those by the image and by its alpha.

    ``v_slots``, ``(slots, 9)``, 0 before, receives the sums over the tile's pixels of the gradient by the exponent
    times 1, u, v, u², uv, v², and of the gradient by the colour's R, G, B. ``changed`` becomes True for footprints with
    any.
    """
    limits = frame.limits[0], frame.limits[1]
    # Per pixel: x, y, stop, T; gradient by R, G, B and alpha; product of the colour behind and its gradient.
    s = np.empty(9 * 256, np.float32)
    # Slots lie anywhere in memory, as records do.
    copies, sums = np.empty((64, 9), np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(frame.stops, tile, s)
        _copy_gradient(v_image, x0, y0, s)
        _begin_tile(frame, v_alpha, x0, y0, s)
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                footprint = _footprint(copies, i - start, x0, y0)
                _backward(s, lists.spans[i], np.float32(i - begin), footprint, limits, sums[i - start])
            for i in range(start, end):
                for c in range(9):
                    v_slots[slots.of[i - slots.begin], c] = sums[i - start, c]
                    if sums[i - start, c] != 0:
                        changed[lists.members[i]] = True


@compiled(
    void(float32[:, ::1], TILE_LISTS, SLOTS, int64, int64, BLENDED, float32[:, :, ::1], float32[:, ::1]),
    fastmath=_FAST,
)
def blend_colors_backward(
    records: np.ndarray,
    lists: TileLists,
    slots: Slots,
    first: int,
    last: int,
    frame: Blended,
    v_image: np.ndarray,
    v_slots: np.ndarray,
) -> None:
    """Compute the last three sums of :func:`blend_backward` alone, ``(slots, 3)``, front to back."""
    limits = frame.limits[0], frame.limits[1]
    zero = np.float32(0)
    # Per pixel: x, y, stop, T; gradient by R, G, B.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(frame.stops, tile, s)
        _copy_gradient(v_image, x0, y0, s)
        s[768:1024] = np.float32(1)
        for i in range(begin + last_stop, lists.starts[tile + 1]):
            v_slots[slots.of[i - slots.begin], :] = zero
        for start in range(begin, begin + last_stop, 64):
            end = min(start + 64, begin + last_stop)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(start, end):
                place, (opacity, _, _, _) = _footprint(copies, i - start, x0, y0)
                top, bottom = _rows(lists.spans[i])
                index, slot = np.float32(i - begin), slots.of[i - slots.begin]
                red, green, blue = zero, zero, zero
                for p in range(top, bottom):
                    drawn = index < s[p + np.uint64(512)]
                    _, _, _, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
                    weight = alpha * s[p + np.uint64(768)]
                    s[p + np.uint64(768)] -= weight
                    red += weight * s[p + np.uint64(1024)]
                    green += weight * s[p + np.uint64(1280)]
                    blue += weight * s[p + np.uint64(1536)]
                v_slots[slot, 0], v_slots[slot, 1], v_slots[slot, 2] = red, green, blue


@compiled(void(float32[:, ::1], SLOTS, FOOTPRINTS, int64, int64, float32, float32[:, ::1]))
def add_colors(
    v_slots: np.ndarray,
    slots: Slots,
    footprints: Footprints,
    first: int,
    last: int,
    factor: float,
    v_colors: np.ndarray,
) -> None:
    """Add ``factor`` times the sum of the slots of footprints ``slots.rows[first:last]`` to their Gaussians' colours.

    Colours that are clamped to 0 have no gradient.
    """
    for i in range(first, last):
        row = slots.rows[i]
        for c in range(3):
            if footprints.records[row, 6 + c] > 0:
                total = np.float32(0)
                for slot in range(slots.first[row], slots.first[row + 1]):
                    total += v_slots[slot, c]
                v_colors[footprints.visible[row], c] += factor * total


# Projection: gradients by the parameters of Gaussians, with the arithmetic of :mod:`kissgs.rendering.cpu.projection`.


@_helper
def _by_axes(
    sums: np.ndarray, w: Vector, v: Vector, dilation: float, antialiased: bool, v_scales: np.ndarray, i: int
) -> tuple[Vector, Vector]:
    """Return the gradients by the rows of W; write those by the log-scales of row ``i``.

    By W: -4 Lᵀ S L W, S = (Σ uu, Σ uv; Σ uv, Σ vv); the derivative of a scale by its logarithm is the scale.
    """
    l0, l1, l2 = _cholesky(w, v, dilation)
    u_rows, v_rows = _whitened(w, v, dilation)
    spread_u, spread_v = _mix(sums[3], u_rows, sums[4], v_rows), _mix(sums[4], u_rows, sums[5], v_rows)
    for c in range(3):
        v_scales[i, c] = -4 * (spread_u[c] * u_rows[c] + spread_v[c] * v_rows[c])
    by_w, by_v = _mix(-4 * l0, spread_u, 0.0, spread_v), _mix(-4 * l1, spread_u, -4 * l2, spread_v)
    if antialiased:
        # By the logarithm of the compensation, -Σ 1; by W it is ((W Wᵀ)⁻¹ - 2 Lᵀ L) W, and the first term has the
        # rows v × n and n × w over n², n being w × v.
        by_log, normal = -sums[0], _cross(w, v)
        axis, more = _unit(normal), by_log / _dot(normal, normal)
        for k in range(3):
            v_scales[i, k] += by_log * _strain(axis, u_rows, v_rows, k, k)
        by_w = _mix(1.0, by_w, -2 * by_log * l0, u_rows)
        by_v = _mix(1.0, _mix(1.0, by_v, -2 * by_log * l1, u_rows), -2 * by_log * l2, v_rows)
        by_w, by_v = _mix(1.0, by_w, more, _cross(v, normal)), _mix(1.0, by_v, more, _cross(normal, w))
    return by_w, by_v


@_helper
def _by_rotation(p: Vector, q: Vector, by_w: Vector, by_v: Vector, quat: Quat) -> Quat:
    """Return the gradient by the unit quaternion, given those by the rows of W over the scales."""
    e0, e1, e2 = _mix(p[0], by_w, q[0], by_v), _mix(p[1], by_w, q[1], by_v), _mix(p[2], by_w, q[2], by_v)
    return _by_quat(quat, (e0, e1, e2))


@_helper
def _by_position(
    K: np.ndarray,
    rotation: Matrix,
    frustum: Bounds,
    position: Vector,
    J: tuple[float, float, float, float],
    by_centre: tuple[float, float],
    by_rows: tuple[Vector, Vector],
) -> Vector:
    """Return the gradient by the mean: through the centre, through J, and through the x/z and y/z of J if not clamped.

    ``position``: x/z, y/z and z; ``by_rows``: gradients by the rows of J Rc.
    """
    (left, right, top, bottom), (x, y, z), (jx, jxz, jy, jyz) = frustum, position, J
    by_p, by_q = by_rows
    by_jx, by_jxz = _dot(by_p, rotation[0]), _dot(by_p, rotation[2])
    by_jy, by_jyz = _dot(by_q, rotation[1]), _dot(by_q, rotation[2])
    by_ratio_x = by_centre[0] * K[0, 0] - (by_jxz * jx if left < x < right else 0.0)
    by_ratio_y = by_centre[1] * K[1, 1] - (by_jyz * jy if top < y < bottom else 0.0)
    by_z = -(by_jx * jx + by_jxz * jxz + by_jy * jy + by_jyz * jyz + by_ratio_x * x + by_ratio_y * y) / z
    return _times((by_ratio_x / z, by_ratio_y / z, by_z), rotation)


@compiled(
    void(
        GAUSSIANS,
        PROJECTION,
        FOOTPRINTS,
        SLOTS,
        float32[:, ::1],
        int32[::1],
        int64,
        int64,
        int32[::1],
        GAUSSIANS,
        float64[:, ::1],
    )
)
def project_backward(
    gaussians: Gaussians,
    projection: Projection,
    footprints: Footprints,
    slots: Slots,
    v_slots: np.ndarray,
    changed: np.ndarray,
    first: int,
    last: int,
    indices: np.ndarray,
    gradients: Gaussians,
    v_colors: np.ndarray,
) -> None:
    """Compute the gradients of the footprints ``changed[first:last]`` from those of :func:`blend_backward`.

    Writes their Gaussians, ``indices``; the gradients by these, all but those by SH; and, ``(R, 3)``, those by the
    colours before they are clamped.
    """
    pose, frustum = _pose(projection.viewmat), _frustum(projection)
    sums = np.empty(9, np.float64)
    for i in range(first, last):
        row = changed[i]
        n = footprints.visible[row]
        indices[i] = n
        sums[:] = 0.0
        for slot in range(slots.first[row], slots.first[row + 1]):
            for c in range(9):
                sums[c] += v_slots[slot, c]
        for c in range(3):
            v_colors[i, c] = sums[6 + c] if footprints.records[row, 6 + c] > 0 else 0.0
        gradients.opacities[i] = -sums[0] / (1.0 + np.exp(np.float64(gaussians.opacities[n])))

        x, y, z = _in_camera(pose, _load(gaussians.means, n))
        clamped_x, clamped_y = _clamped(x, y, frustum)
        J = _jacobian(projection.K, clamped_x, clamped_y, z)
        p, q = _image_rows(J, pose[0])
        quat, shrink, R, s = _ellipsoid(gaussians, n)
        w, v = _image_axes(p, q, R, s)
        by_w, by_v = _by_axes(sums, w, v, projection.dilation, projection.antialiased, gradients.scales, i)
        by_w, by_v = _scaled(by_w, s), _scaled(by_v, s)
        by_quat = _by_rotation(p, q, by_w, by_v, quat)
        for c in range(4):
            gradients.quats[i, c] = by_quat[c] * shrink
        l0, l1, l2 = _cholesky(w, v, projection.dilation)
        by_centre = -2 * l0 * sums[1], -2 * (l1 * sums[1] + l2 * sums[2])  # -2 Lᵀ (Σ u, Σ v)
        by_rows = _applied(R, by_w), _applied(R, by_v)
        by_mean = _by_position(projection.K, pose[0], frustum, (x, y, z), J, by_centre, by_rows)
        gradients.means[i, 0], gradients.means[i, 1], gradients.means[i, 2] = by_mean


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a loss by the stored parameters of the R Gaussians that have any; those of all others are 0."""

    gaussians: Int32[np.ndarray, " R"]
    """Indices of these Gaussians, ascending."""
    means: Float32[np.ndarray, "R 3"]
    quats: Float32[np.ndarray, "R 4"]
    scales: Float32[np.ndarray, "R 3"]
    opacities: Float32[np.ndarray, " R"]
    sh0: Float32[np.ndarray, "R 3"]
    shN: Float32[np.ndarray, "R K 3"]

    def add_to(self, name: str, total: Shaped[np.ndarray, "N ..."]) -> None:
        """Add the gradients by the attribute ``name`` to those of all Gaussians."""
        total[self.gaussians] += getattr(self, name)

    @classmethod
    def sum(cls, parts: Sequence[Gradients]) -> Gradients:
        """Return the sum of one or more gradients, added in order."""
        if len(parts) == 1:
            return parts[0]
        gaussians = np.unique(np.concatenate([part.gaussians for part in parts]))
        totals = []
        for field in fields(cls)[1:]:
            total = np.zeros((len(gaussians), *getattr(parts[0], field.name).shape[1:]), np.float32)
            for part in parts:
                total[np.searchsorted(gaussians, part.gaussians)] += getattr(part, field.name)
            totals.append(total)
        return cls(gaussians, *totals)


def differentiate(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> Gradients:
    """Return the gradients of a loss by the stored parameters, given those by the image and by its alpha."""
    v_slots, slots, any_gradient = differentiate_footprints(frame, v_image, v_alpha, pool)
    changed = slots.rows[any_gradient[slots.rows]]
    count = len(changed)
    gradients = Gaussians(*(np.empty((count, *array.shape[1:]), np.float32) for array in frame.gaussians))
    indices, v_colors = np.empty(count, np.int32), np.empty((count, 3), np.float64)

    def part(first: int, last: int) -> None:
        scene = frame.gaussians, frame.projection
        project_backward(*scene, frame.footprints, slots, v_slots, changed, first, last, indices, gradients, v_colors)
        shade_backward(*scene, indices, first, last, v_colors, gradients)

    each_part(part, even(count, pool), pool)
    return Gradients(indices, *gradients)


def differentiate_footprints(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> tuple[Float32[np.ndarray, "slots 9"], Slots, Bool[np.ndarray, " N"]]:
    """Return what :func:`blend_backward` finds: sums by slot, the slots, and which rows have any gradient."""
    lists, records = frame.lists, frame.footprints.records
    slots, changed = number_slots(lists, len(records)), np.zeros(len(records), bool)
    v_slots = np.empty((len(lists.members), 9), np.float32)
    v_slots.fill(0)  # members behind the end of all pixels get nothing
    each_part(
        lambda a, b: blend_backward(records, lists, slots, a, b, frame.blended, v_image, v_alpha, v_slots, changed),
        even_tiles(lists, pool),
        pool,
    )
    return v_slots, slots, changed


def add_color_gradients(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], into: Float32[np.ndarray, "N 3"], pool: Workers
) -> None:
    """Add the gradients of a loss by ``sh0`` alone, given its gradient by the image, ``v_image``, to ``into``."""
    lists, footprints = frame.lists, frame.footprints
    slots = number_slots(lists, len(footprints.records))
    v_slots = np.empty((len(lists.members), 3), np.float32)
    each_part(
        lambda a, b: blend_colors_backward(footprints.records, lists, slots, a, b, frame.blended, v_image, v_slots),
        even_tiles(lists, pool),
        pool,
    )
    each_part(lambda a, b: add_colors(v_slots, slots, footprints, a, b, SH_C0, into), even(len(slots.rows), pool), pool)
