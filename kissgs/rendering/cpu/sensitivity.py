"""Numba kernels of sensitivity: Hessians of the squared image error by stored parameters, from one backward pass.

The derivative of a pixel by the logarithm of a footprint's alpha is w = alpha T (colour - B), B being the colour behind
it. To first order, the change of that logarithm is a polynomial of degree 2 in the footprint's own coordinates u, v:
the opacity changes its constant term, the centre its linear terms, the covariance its quadratic terms. The squared
change of the image is then a quadratic form in these six coefficients, whose entries are moments, sums of |w|² uⁱ vʲ
over pixels with i + j of 0, 2 and 4. The chain rule gives J ᵀ J of the image by the stored parameters, without random
probes.

The background that a scene will be shown with is unknown, so it is random: |w|² is the mean over backgrounds.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.harmonics_kernel import write_harmonics
from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.blending import _FAST, _copy_records, _exp_minus, _footprint, _pixel_centres
from kissgs.rendering.cpu.projection import (
    Vector,
    _applied,
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
from kissgs.rendering.cpu.shading import _harmonics

MOMENTS = 10
"""Number of moments of each footprint in each tile."""


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64, int64,"
    " float32[::1], float32[::1], float64, float32[:, ::1], int32[:, ::1], float32[:, ::1])",
    fastmath=_FAST,
)
def moments(
    records: np.ndarray,
    members: np.ndarray,
    spans: np.ndarray,
    slots: np.ndarray,
    starts: np.ndarray,
    slots_begin: int,
    first: int,
    last: int,
    columns: int,
    limits: np.ndarray,
    background: np.ndarray,
    spread: float,
    transmittance: np.ndarray,
    stops: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Compute moments of the members of tiles ``first`` to ``last`` (exclusive).

    The arguments are those of :func:`kissgs.rendering.cpu.blending.removal_errors`, and ``slots_begin``, the member to
    which the first entry of ``slots`` belongs, and ``spread``, the standard deviation of each channel of the
    background. ``sums``: out, ``(slots, 10)``, sums over the tile's pixels of |w|² times 1, u², uv, v², u⁴, u³v, u²v²,
    uv³, v⁴; and of (alpha T)². Pixels at which alpha is clamped to ALPHA_MAX count in the first sum only, which is
    therefore the error of removing the Gaussian.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    max_color = np.float32(2)  # a display shows at most 1; brighter colours are limited to twice that
    height, width = transmittance.shape
    variance = np.float32(3 * spread * spread)
    # Per pixel: x, y, stop, T; R, G, B behind the Gaussian, and transmittance to the background behind it.
    s, copies = np.empty(8 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin = starts[tile]
        last_stop = 0
        for p in range(256):
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            s[768 + p] = transmittance[min(y0 + (p >> 4), height - 1), min(x0 + (p & 15), width - 1)]
            s[1024 + p], s[1280 + p], s[1536 + p], s[1792 + p] = background[0], background[1], background[2], one
            if begin + stops[tile, p] < starts[tile + 1]:  # what is behind the end has about the colour of the next
                n = members[begin + stops[tile, p]]
                s[1024 + p] = min(records[n, 6], max_color)
                s[1280 + p] = min(records[n, 7], max_color)
                s[1536 + p] = min(records[n, 8], max_color)
                s[1792 + p] = zero
        for i in range(begin + last_stop, starts[tile + 1]):
            sums[slots[i - slots_begin], :] = zero
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(copies, i - start, x0, y0)
                red, green, blue = min(red, max_color), min(green, max_color), min(blue, max_color)
                top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
                index = np.float32(i - begin)
                m0, m20, m11, m02, m40, m31, m22, m13, m04 = zero, zero, zero, zero, zero, zero, zero, zero, zero
                squared_weight = zero
                for p in range(top * np.uint64(16), bottom * np.uint64(16)):
                    dx, dy = s[p] - mx, s[p + np.uint64(256)] - my
                    u, v = l0 * dx + l1 * dy, l2 * dy
                    full = opacity * _exp_minus(u * u + v * v)
                    alpha = min(full, alpha_max)
                    alpha = alpha if alpha >= alpha_min else zero
                    alpha = alpha if index < s[p + np.uint64(512)] else zero
                    t = s[p + np.uint64(768)] / (one - alpha)
                    s[p + np.uint64(768)] = t
                    dr = alpha * (red - s[p + np.uint64(1024)])
                    dg = alpha * (green - s[p + np.uint64(1280)])
                    db = alpha * (blue - s[p + np.uint64(1536)])
                    s[p + np.uint64(1024)] += dr
                    s[p + np.uint64(1280)] += dg
                    s[p + np.uint64(1536)] += db
                    weight = alpha * t
                    squared_weight += weight * weight
                    background_change = alpha * s[p + np.uint64(1792)]
                    s[p + np.uint64(1792)] -= background_change
                    g = t * t * (dr * dr + dg * dg + db * db + variance * (background_change * background_change))
                    m0 += g
                    g = g if full <= alpha_max else zero
                    uu, uv, vv = u * u, u * v, v * v
                    guu, gvv = g * uu, g * vv
                    m20 += guu
                    m11 += g * uv
                    m02 += gvv
                    m40 += guu * uu
                    m31 += guu * uv
                    m22 += guu * vv
                    m13 += gvv * uv
                    m04 += gvv * vv
                slot = slots[i - slots_begin]
                sums[slot, 0], sums[slot, 1], sums[slot, 2], sums[slot, 3] = m0, m20, m11, m02
                sums[slot, 4], sums[slot, 5], sums[slot, 6], sums[slot, 7], sums[slot, 8] = m40, m31, m22, m13, m04
                sums[slot, 9] = squared_weight


@njit(nogil=True, error_model="numpy")
def _square(u: Vector, v: Vector, axis: int) -> Vector:
    """Return the coefficients of g², g being u times an entry of ``u`` plus v times one of ``v``, by u², uv and v²."""
    return u[axis] * u[axis], 2 * u[axis] * v[axis], v[axis] * v[axis]


@njit(nogil=True, error_model="numpy")
def _thickened(s: Vector) -> Vector:
    """Return the factors by which a Gaussian's axes are enlarged to at least 1/10,000 of the longest.

    Moments of a needle's thin axes would underflow, while their derivatives by rotations are large.
    """
    least = 1e-4 * max(s[0], s[1], s[2])
    return max(least / s[0], 1.0), max(least / s[1], 1.0), max(least / s[2], 1.0)


@compiled(
    "void(float32[:, ::1], float32[:, ::1], float32[:, ::1],"
    " int32[::1], int32[::1], int32[::1], float32[:, ::1], int64, int64,"
    " float64[:, ::1], float64[::1], float64[:, ::1], int64, int64, float64[::1], float64,"
    " float32[:, ::1], float32[:, ::1], float32[::1], float32[:, ::1], float32[:, ::1], float32[::1])"
)
def add_to_parameters(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    visible: np.ndarray,
    rows: np.ndarray,
    slots_from: np.ndarray,
    slots: np.ndarray,
    first: int,
    last: int,
    viewmat: np.ndarray,
    eye: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    constants: np.ndarray,
    weight: float,
    position_hessian: np.ndarray,
    shape_moments: np.ndarray,
    color_weight: np.ndarray,
    harmonics_sum: np.ndarray,
    higher_sum: np.ndarray,
    seen: np.ndarray,
) -> None:
    """Add the moments of some tiles of an image to those of the Gaussians of the footprints ``rows[first:last]``.

    A footprint's coordinates (u, v) times L W are coordinates g in the Gaussian's own frame, in units of its axes, here
    :func:`_thickened`. The derivative of ln alpha by a strain of the Gaussian is quadratic in g whatever the camera, so
    images are added as moments of g, and the Hessian by log-scales and rotation follows once
    (:func:`moments_to_hessians`).
    In antialiased scenes the derivative by a strain has a constant term as well (:func:`_strain`): g g becomes
    g g + strain / 4. Pixels at which alpha is clamped have it too, where it is at most 2 %.

    Args:
        means, quats, scales, visible, rows, slots_from, first, last, viewmat, K, width, height, constants: as for
            :func:`kissgs.rendering.cpu.backward.project_backward`.
        slots: output of :func:`moments`.
        eye: ``(3,)`` position of the camera, world units.
        weight: weight of the image.
        position_hessian: ``(N, 3)`` diagonal of the Hessian by position.
        shape_moments: ``(N, 10)`` sums over pixels of |w|² times 1; times g0², g1², g2²; times their squares; and times
            (g1 g2)², (g2 g0)², (g0 g1)²; with constant terms in antialiased scenes.
        color_weight: ``(N,)`` sum of (alpha T)².
        harmonics_sum: ``(N, K)`` sum of (alpha T)² times the spherical harmonics without the constant one.
        higher_sum: ``(N, H)`` the same of higher degrees.
        seen: by row, sum of (alpha T)² of this image alone, without its weight; added.
    """
    dilation = constants[2]
    fx, fy = K[0, 0], K[1, 1]
    rotation, translation = _pose(viewmat)
    left, right, top, bottom = _frustum(K, width, height, constants[3])
    own, higher = harmonics_sum.shape[1], higher_sum.shape[1]
    degree = int(np.sqrt(own + higher + 1.0) + 0.5) - 1
    basis = np.zeros(own + higher, np.float64)
    for i in range(first, last):
        row = rows[i]
        n = visible[row]
        m0 = m20 = m11 = m02 = m40 = m31 = m22 = m13 = m04 = squared_weight = 0.0
        for slot in range(slots_from[row], slots_from[row + 1]):
            m0 += slots[slot, 0]
            m20 += slots[slot, 1]
            m11 += slots[slot, 2]
            m02 += slots[slot, 3]
            m40 += slots[slot, 4]
            m31 += slots[slot, 5]
            m22 += slots[slot, 6]
            m13 += slots[slot, 7]
            m04 += slots[slot, 8]
            squared_weight += slots[slot, 9]
        if squared_weight == 0.0:
            continue
        seen[row] += squared_weight
        m0, m20, m11, m02 = weight * m0, weight * m20, weight * m11, weight * m02
        m40, m31, m22, m13, m04 = weight * m40, weight * m31, weight * m22, weight * m13, weight * m04
        squared_weight *= weight

        # As in project.
        mean = _load(means, n)
        z = _dot(rotation[2], mean) + translation[2]
        x, y = (_dot(rotation[0], mean) + translation[0]) / z, (_dot(rotation[1], mean) + translation[1]) / z
        p = _mix(fx / z, rotation[0], -fx / z * min(right, max(left, x)), rotation[2])
        q = _mix(fy / z, rotation[1], -fy / z * min(bottom, max(top, y)), rotation[2])
        qw, qx, qy, qz, _ = _unit_quat(quats, n)
        R, s = _rotation(qw, qx, qy, qz), _deviations(scales, n)
        w, v = _scaled(_times(p, R), s), _scaled(_times(q, R), s)
        l0, l1, l2 = _cholesky(w, v, dilation)
        u_row, v_row = _whitened(w, v, dilation)
        thickened = _thickened(s)
        axis = _unit(_cross(w, v)) if constants[5] != 0.0 else w
        plain_u, plain_v = u_row, v_row
        u_row, v_row = _scaled(u_row, thickened), _scaled(v_row, thickened)

        # Derivative of ln alpha by position: 2 (u, v) L dc, c being the centre.
        across = _mix(fx / z, rotation[0], -fx / z * x, rotation[2])
        down = _mix(fy / z, rotation[1], -fy / z * y, rotation[2])
        for c in range(3):
            a, b = 2 * (l0 * across[c] + l1 * down[c]), 2 * l2 * down[c]
            position_hessian[n, c] += m20 * a * a + 2 * m11 * a * b + m02 * b * b

        g0, g1, g2 = _square(u_row, v_row, 0), _square(u_row, v_row, 1), _square(u_row, v_row, 2)
        second, fourth = (m20, m11, m02), ((m40, m31, m22), (m31, m22, m13), (m22, m13, m04))
        by_0, by_1, by_2 = _applied(fourth, g0), _applied(fourth, g1), _applied(fourth, g2)
        out = shape_moments[n]
        out[0] += m0
        out[1] += _dot(second, g0)
        out[2] += _dot(second, g1)
        out[3] += _dot(second, g2)
        out[4] += _dot(by_0, g0)
        out[5] += _dot(by_1, g1)
        out[6] += _dot(by_2, g2)
        out[7] += _dot(by_1, g2)
        out[8] += _dot(by_2, g0)
        out[9] += _dot(by_0, g1)
        if constants[5] != 0.0:
            for c in range(3):
                d, e = (c + 1) % 3, (c + 2) % 3
                square = 0.25 * thickened[c] * thickened[c] * _strain(axis, plain_u, plain_v, c, c)
                product = 0.25 * thickened[d] * thickened[e] * _strain(axis, plain_u, plain_v, d, e)
                of_square = _dot(second, _square(u_row, v_row, c))
                crossed = u_row[d] * v_row[e] + u_row[e] * v_row[d]
                of_product = m20 * u_row[d] * u_row[e] + m11 * crossed + m02 * v_row[d] * v_row[e]
                out[1 + c] += square * m0
                out[4 + c] += square * (2 * of_square + square * m0)
                out[7 + c] += product * (2 * of_product + product * m0)

        color_weight[n] += squared_weight
        if own > 0:
            direction = (mean[0] - eye[0], mean[1] - eye[1], mean[2] - eye[2])
            inverse = 1.0 / np.sqrt(_dot(direction, direction))
            dx, dy, dz = direction[0] * inverse, direction[1] * inverse, direction[2] * inverse
            if higher > 0:
                write_harmonics(dx, dy, dz, degree, basis)
            else:
                _harmonics(dx, dy, dz, own, basis)
            for c in range(own):
                harmonics_sum[n, c] += squared_weight * basis[c]
            for c in range(higher):
                higher_sum[n, c] += squared_weight * basis[own + c]


@compiled("void(float32[:, ::1], float32[::1], int64, int64, float32[:, ::1])")
def moments_to_hessians(
    scales: np.ndarray, opacities: np.ndarray, first: int, last: int, shape_hessian: np.ndarray
) -> None:
    """Replace the moments of Gaussians ``first`` to ``last`` (exclusive) by Hessians.

    With g as in :func:`add_to_parameters`, the derivative of ln alpha by the opacity logit is 1 - opacity, by a
    log-scale 4 g[c]², and by a rotation about axis c 4 (s[d] / s[e] - s[e] / s[d]) g[d] g[e], with the constant terms
    of antialiased scenes.

    Args:
        scales, opacities: stored parameters, see :class:`kissgs.Splats`.
        first: first Gaussian.
        last: end of the Gaussians, exclusive.
        shape_hessian: ``(N, 10)`` the moments; on return, Hessians as :class:`kissgs.Sensitivity` describes them.
    """
    for n in range(first, last):
        out, s = shape_hessian[n], _deviations(scales, n)
        k = _thickened(s)
        transparency = 1.0 / (1.0 + np.exp(np.float64(opacities[n])))
        out[0] *= transparency * transparency
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3  # the two axes that rotate about axis c
            by_scale = 4 / (k[c] * k[c])
            by_rotation = 4 * (s[d] / s[e] - s[e] / s[d]) / (k[d] * k[e])
            out[1 + c] *= transparency * by_scale
            out[4 + c] *= by_scale * by_scale
            out[7 + c] *= by_rotation * by_rotation
