"""The backward pass of one image on the CPU, independent of the number of threads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from kissgs.core.array_types import Bool, Float32, Int32, Shaped
from kissgs.core.numba_kernels import compiled
from kissgs.core.resources import Workers
from kissgs.core.splats import SH_C0
from kissgs.rendering.cpu import shading
from kissgs.rendering.cpu.blending import _FAST, _copy_records, _exp_minus, _footprint, _pixel_centres
from kissgs.rendering.cpu.frame import LIMITS, Frame
from kissgs.rendering.cpu.projection import (
    _applied,
    _by_quat,
    _cholesky,
    _cross,
    _deviations,
    _dot,
    _frustum,
    _load,
    _mix,
    _pose,
    _rotation,
    _scaled,
    _strain,
    _times,
    _unit,
    _unit_quat,
    _whitened,
)
from kissgs.rendering.cpu.tiles import Slots, each_part, even, even_tiles, number_slots, projection_constants

# Numba kernel of the backward pass of alpha blending, tile by tile; see :mod:`kissgs.rendering.cpu.blending`.


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], float32[::1], float32[:, ::1], int32[:, ::1],"
    " float32[:, :, ::1], float32[:, ::1], float32[:, ::1], boolean[::1])",
    fastmath=_FAST,
)
def blend_backward(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    slots: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    columns: int,
    limits: np.ndarray,
    background: np.ndarray,
    transmittance: np.ndarray,
    stops: np.ndarray,
    v_image: np.ndarray,
    v_alpha: np.ndarray,
    v_slots: np.ndarray,
    changed: np.ndarray,
) -> None:
    """Compute gradients of tiles ``first`` to ``last`` (exclusive), which were rendered.

    Args:
        records, members, spans, starts, first, last, columns, limits, background, transmittance, stops: as for
            :func:`kissgs.rendering.cpu.blending.blend`.
        slots: row of ``v_slots`` of each member.
        v_image: ``(H, W, 3)`` gradient of the loss by the image.
        v_alpha: ``(H, W)`` gradient of the loss by 1 - transmittance.
        v_slots: out, ``(slots, 9)``, 0 before: sums over the tile's pixels of the gradient by the exponent times 1, u,
            v, u², uv, v²; and the gradient by the colour's R, G, B.
        changed: out, ``(M,)``, False before: True for footprints whose gradient is not 0 in one of the tiles.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    height, width = transmittance.shape
    # Per pixel: x, y, stop, T; gradient by R, G, B and alpha; product of the colour behind and its gradient.
    s = np.empty(9 * 256, np.float32)
    # Slots lie anywhere in memory, as records do.
    copies, sums = np.empty((64, 9), np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin = starts[tile]
        last_stop = 0
        for p in range(256):
            x, y = x0 + (p & 15), y0 + (p >> 4)
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            inside = x < width and y < height
            x, y = min(x, width - 1), min(y, height - 1)
            s[768 + p] = transmittance[y, x] if inside else one
            s[1024 + p] = v_image[y, x, 0] if inside else zero
            s[1280 + p] = v_image[y, x, 1] if inside else zero
            s[1536 + p] = v_image[y, x, 2] if inside else zero
            s[1792 + p] = v_alpha[y, x] if inside else zero
            s[2048 + p] = background[0] * s[1024 + p] + background[1] * s[1280 + p] + background[2] * s[1536 + p]
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                j = i - start
                (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(copies, j, x0, y0)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                m, mu, mv, muu, muv, mvv, vr, vg, vb = zero, zero, zero, zero, zero, zero, zero, zero, zero
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    full = opacity * _exp_minus(u * u + v * v)
                    alpha = min(full, alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
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
                    g = g if full <= alpha_max else zero
                    m += g
                    mu += g * u
                    mv += g * v
                    muu += g * u * u
                    muv += g * u * v
                    mvv += g * v * v
                sums[j, 0], sums[j, 1], sums[j, 2], sums[j, 3], sums[j, 4], sums[j, 5] = m, mu, mv, muu, muv, mvv
                sums[j, 6], sums[j, 7], sums[j, 8] = vr, vg, vb
            for i in range(start, end):
                for c in range(9):
                    v_slots[slots[i], c] = sums[i - start, c]
                    if sums[i - start, c] != 0:
                        changed[members[i]] = True


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], int32[:, ::1], float32[:, :, ::1], float32[:, ::1])",
    fastmath=_FAST,
)
def blend_colors_backward(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    slots: np.ndarray,
    starts: np.ndarray,
    first: int,
    last: int,
    columns: int,
    limits: np.ndarray,
    stops: np.ndarray,
    v_image: np.ndarray,
    v_slots: np.ndarray,
) -> None:
    """Compute gradients by colours alone, of tiles ``first`` to ``last`` (exclusive).

    The arguments are those of :func:`blend_backward`. ``v_slots``: out, ``(slots, 3)``, sums over the tile's pixels of
    the gradient by the colour's R, G, B.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    height, width = v_image.shape[0], v_image.shape[1]
    # Per pixel: x, y, stop, T; gradient by R, G, B.
    s, copies = np.empty(7 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin, last_stop = starts[tile], 0
        for p in range(256):
            x, y = x0 + (p & 15), y0 + (p >> 4)
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            s[768 + p] = one
            inside = x < width and y < height
            x, y = min(x, width - 1), min(y, height - 1)
            s[1024 + p] = v_image[y, x, 0] if inside else zero
            s[1280 + p] = v_image[y, x, 1] if inside else zero
            s[1536 + p] = v_image[y, x, 2] if inside else zero
        for i in range(begin + last_stop, starts[tile + 1]):
            v_slots[slots[i], :] = zero
        for start in range(begin, begin + last_stop, 64):
            end = min(start + 64, begin + last_stop)
            _copy_records(records, members, start, end, copies)
            for i in range(start, end):
                (mx, my, l0, l1, l2), (opacity, _, _, _) = _footprint(copies, i - start, x0, y0)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                red, green, blue = zero, zero, zero
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    alpha = min(opacity * _exp_minus(u * u + v * v), alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
                    weight = alpha * s[p + np.uint64(768)]
                    s[p + np.uint64(768)] -= weight
                    red += weight * s[p + np.uint64(1024)]
                    green += weight * s[p + np.uint64(1280)]
                    blue += weight * s[p + np.uint64(1536)]
                v_slots[slots[i], 0], v_slots[slots[i], 1], v_slots[slots[i], 2] = red, green, blue


@compiled(
    "void(float32[:, ::1], float32[:, ::1], int32[::1], int32[::1], int32[::1], int64, int64, float32, float32[:, ::1])"
)
def add_colors(
    v_slots: np.ndarray,
    records: np.ndarray,
    rows: np.ndarray,
    slots_from: np.ndarray,
    visible: np.ndarray,
    first: int,
    last: int,
    factor: float,
    v_colors: np.ndarray,
) -> None:
    """Add ``factor`` times the sum of the slots of the footprints ``rows[first:last]`` to ``v_colors[visible]``.

    Colours that are clamped to 0 have no gradient.
    """
    for i in range(first, last):
        row = rows[i]
        for c in range(3):
            if records[row, 6 + c] > 0:
                total = np.float32(0)
                for slot in range(slots_from[row], slots_from[row + 1]):
                    total += v_slots[slot, c]
                v_colors[visible[row], c] += factor * total


# Numba kernel of the backward pass of projection: gradients by the parameters of Gaussians.
#
# Arithmetic is that of :mod:`kissgs.rendering.cpu.projection`.


@compiled(
    "void(float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[::1],"
    " int32[::1], int32[::1], int32[::1], float32[:, ::1], float32[:, ::1], int64, int64,"
    " float64[:, ::1], float64[:, ::1], int64, int64, float64[::1],"
    " int32[::1], float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[::1], float64[:, ::1])"
)
def project_backward(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    visible: np.ndarray,
    changed: np.ndarray,
    slots_from: np.ndarray,
    v_slots: np.ndarray,
    records: np.ndarray,
    first: int,
    last: int,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    constants: np.ndarray,
    gaussians: np.ndarray,
    v_means: np.ndarray,
    v_quats: np.ndarray,
    v_scales: np.ndarray,
    v_opacities: np.ndarray,
    v_colors: np.ndarray,
) -> None:
    """Compute gradients by the parameters of the Gaussians whose footprints are ``changed[first:last]``.

    Args:
        means, quats, scales, opacities, viewmat, K, width, height, constants, records: as for
            :func:`kissgs.rendering.cpu.projection.project`.
        visible: ``(N,)`` the Gaussian of each row that holds a footprint.
        changed: ``(R,)`` footprints.
        slots_from: first slot of each footprint; its slots end where the next footprint's begin.
        v_slots: output of :func:`kissgs.rendering.cpu.backward.blend_backward`.
        first: first index into ``changed``.
        last: end of the indices, exclusive.
        gaussians: out, ``(R,)``, the Gaussian of each of ``changed``.
        v_means, v_quats, v_scales, v_opacities: out, ``(R, ...)``, gradients by the parameters.
        v_colors: out, ``(R, 3)``, gradients by the colours before they are clamped.
    """
    dilation = constants[2]
    fx, fy = K[0, 0], K[1, 1]
    rotation, translation = _pose(viewmat)
    left, right, top, bottom = _frustum(K, width, height, constants[3])
    sums = np.empty(9, np.float64)
    for i in range(first, last):
        row = changed[i]
        n = visible[row]
        gaussians[i] = n
        sums[:] = 0.0
        for slot in range(slots_from[row], slots_from[row + 1]):
            for c in range(9):
                sums[c] += v_slots[slot, c]
        for c in range(3):
            v_colors[i, c] = sums[6 + c] if records[row, 6 + c] > 0 else 0.0
        v_opacities[i] = -sums[0] / (1.0 + np.exp(np.float64(opacities[n])))

        # Like project.
        mean = _load(means, n)
        z = _dot(rotation[2], mean) + translation[2]
        x, y = (_dot(rotation[0], mean) + translation[0]) / z, (_dot(rotation[1], mean) + translation[1]) / z
        jx, jxz = fx / z, -fx / z * min(right, max(left, x))
        jy, jyz = fy / z, -fy / z * min(bottom, max(top, y))
        p, q = _mix(jx, rotation[0], jxz, rotation[2]), _mix(jy, rotation[1], jyz, rotation[2])
        qw, qx, qy, qz, shrink = _unit_quat(quats, n)
        R, s = _rotation(qw, qx, qy, qz), _deviations(scales, n)
        w, v = _scaled(_times(p, R), s), _scaled(_times(q, R), s)
        l0, l1, l2 = _cholesky(w, v, dilation)

        # By the centre: -2 Lᵀ (Σ u, Σ v). By W: -4 Lᵀ S L W, S = (Σ uu, Σ uv; Σ uv, Σ vv); then by p and q (the
        # derivative of a scale by its logarithm is the scale).
        by_x, by_y = -2 * l0 * sums[1], -2 * (l1 * sums[1] + l2 * sums[2])
        u_rows, v_rows = _whitened(w, v, dilation)
        spread_u, spread_v = _mix(sums[3], u_rows, sums[4], v_rows), _mix(sums[4], u_rows, sums[5], v_rows)
        for c in range(3):
            v_scales[i, c] = -4 * (spread_u[c] * u_rows[c] + spread_v[c] * v_rows[c])
        by_w, by_v = _mix(-4 * l0, spread_u, 0.0, spread_v), _mix(-4 * l1, spread_u, -4 * l2, spread_v)
        if constants[5] != 0.0:
            # By the logarithm of the compensation, -Σ 1; by W it is ((W Wᵀ)⁻¹ - 2 Lᵀ L) W, and the first term has the
            # rows v × n and n × w over n², n being w × v.
            by_log, normal = -sums[0], _cross(w, v)
            axis, more = _unit(normal), by_log / _dot(normal, normal)
            for k in range(3):
                v_scales[i, k] += by_log * _strain(axis, u_rows, v_rows, k, k)
            by_w = _mix(1.0, by_w, -2 * by_log * l0, u_rows)
            by_v = _mix(1.0, _mix(1.0, by_v, -2 * by_log * l1, u_rows), -2 * by_log * l2, v_rows)
            by_w, by_v = _mix(1.0, by_w, more, _cross(v, normal)), _mix(1.0, by_v, more, _cross(normal, w))
        by_w, by_v = _scaled(by_w, s), _scaled(by_v, s)
        by_p, by_q = _applied(R, by_w), _applied(R, by_v)

        # By R, with rows e0, e1, e2; then by the quaternion before normalisation.
        e0, e1, e2 = _mix(p[0], by_w, q[0], by_v), _mix(p[1], by_w, q[1], by_v), _mix(p[2], by_w, q[2], by_v)
        by_quat = _by_quat((qw, qx, qy, qz), (e0, e1, e2))
        for c in range(4):
            v_quats[i, c] = by_quat[c] * shrink

        # By the position in the camera: through the centre, through J, and through the x/z and y/z of J if not clamped.
        by_jx, by_jxz = _dot(by_p, rotation[0]), _dot(by_p, rotation[2])
        by_jy, by_jyz = _dot(by_q, rotation[1]), _dot(by_q, rotation[2])
        by_ratio_x = by_x * fx - (by_jxz * jx if left < x < right else 0.0)
        by_ratio_y = by_y * fy - (by_jyz * jy if top < y < bottom else 0.0)
        by_z = -(by_jx * jx + by_jxz * jxz + by_jy * jy + by_jyz * jyz + by_ratio_x * x + by_ratio_y * y) / z
        v_mean = _times((by_ratio_x / z, by_ratio_y / z, by_z), rotation)
        v_means[i, 0], v_means[i, 1], v_means[i, 2] = v_mean


# The backward pass of one image on the CPU, independent of the number of threads.
#
# Only Gaussians that contribute to the image have gradients: of many Gaussians, most lie outside it, or behind others.


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a loss by the stored parameters of the R Gaussians that have any; those of all others are 0.

    Attributes:
        gaussians: ``(R,)`` indices of these Gaussians, ascending.
        means, quats, scales, opacities, sh0, shN: gradients by the parameters of each, see :class:`kissgs.Splats`.
    """

    gaussians: Int32[np.ndarray, " R"]
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
    """Return the gradients of a loss by the stored parameters.

    Args:
        frame: a rendered image.
        v_image: ``(H, W, 3)`` gradient of the loss by the image.
        v_alpha: ``(H, W)`` gradient of the loss by alpha.
        pool: threads; the result does not depend on their number.

    Raises:
        MemoryError: there is not enough memory.
    """
    splats, camera, footprints = frame.splats, frame.camera, frame.footprints
    v_slots, slots, any_gradient = differentiate_footprints(frame, v_image, v_alpha, pool)
    changed = slots.rows[any_gradient[slots.rows]]
    count = len(changed)
    found = Gradients(
        np.empty(count, np.int32),
        *(np.empty((count, *getattr(splats, field.name).shape[1:]), np.float32) for field in fields(Gradients)[1:]),
    )
    v_colors = np.empty((count, 3), np.float64)

    def project(first: int, last: int) -> None:
        project_backward(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            footprints.visible,
            changed,
            slots.first,
            v_slots,
            footprints.records,
            first,
            last,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            projection_constants(splats, camera),
            found.gaussians,
            found.means,
            found.quats,
            found.scales,
            found.opacities,
            v_colors,
        )
        shading.shade_backward(
            splats.means,
            splats.shN,
            camera.position,
            found.gaussians,
            first,
            last,
            v_colors,
            found.means,
            found.sh0,
            found.shN,
        )

    each_part(project, even(count, pool), pool)
    return found


def differentiate_footprints(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> tuple[Float32[np.ndarray, "slots 9"], Slots, Bool[np.ndarray, " N"]]:
    """Return the gradients of a loss by each footprint in each tile, their slots, and the rows that have any.

    Arguments are those of :func:`differentiate`; the gradients are described at
    :func:`kissgs.rendering.cpu.backward.blend_backward`.
    """
    lists, changed = frame.lists, np.zeros(len(frame.footprints.records), bool)
    slots = number_slots(frame.footprints, lists, 0, len(lists.starts) - 1)
    v_slots = np.empty((len(lists.members), 9), np.float32)
    v_slots.fill(0)  # members behind the end of all pixels get nothing

    def blend(first: int, last: int) -> None:
        blend_backward(
            frame.footprints.records,
            lists.members,
            lists.spans,
            slots.of,
            lists.starts,
            first,
            last,
            lists.columns,
            LIMITS,
            frame.background,
            frame.transmittance,
            frame.stops,
            v_image,
            v_alpha,
            v_slots,
            changed,
        )

    each_part(blend, even_tiles(lists, pool), pool)
    return v_slots, slots, changed


def add_color_gradients(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], into: Float32[np.ndarray, "N 3"], pool: Workers
) -> None:
    """Add the gradients of a loss by ``sh0`` alone, given its gradient by the image, ``v_image``, to ``into``."""
    lists, visible, records = frame.lists, frame.footprints.visible, frame.footprints.records
    slots = number_slots(frame.footprints, lists, 0, len(lists.starts) - 1)
    v_slots = np.empty((len(lists.members), 3), np.float32)

    def blend(first: int, last: int) -> None:
        blend_colors_backward(
            records,
            lists.members,
            lists.spans,
            slots.of,
            lists.starts,
            first,
            last,
            lists.columns,
            LIMITS,
            frame.stops,
            v_image,
            v_slots,
        )

    each_part(blend, even_tiles(lists, pool), pool)

    def add(first: int, last: int) -> None:
        add_colors(v_slots, records, slots.rows, slots.first, visible, first, last, SH_C0, into)

    each_part(add, even(len(slots.rows), pool), pool)
