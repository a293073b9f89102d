"""Numba kernels of sensitivity: Hessians of the squared image error by stored parameters, from one backward pass.

The derivative of a pixel by the logarithm of a footprint's alpha is w = alpha T (colour - B), B being the colour behind
it. To first order, the change of that logarithm is a polynomial of degree 2 in the footprint's own coordinates u, v:
the opacity changes its constant term, the centre its linear terms, the covariance its quadratic terms. The squared
change of the image is then a quadratic form in these six coefficients, whose entries are moments, sums of |w|² uⁱ vʲ
over pixels with i + j up to 4. The chain rule gives J ᵀ J of the image by the stored parameters, without random probes.

The background that a scene will be shown with is unknown, so it is random: |w|² is the mean over backgrounds.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.blending import _FAST, _exp_minus, _footprint, _pixel_centres
from kissgs.rendering.cpu.projection import (
    _cholesky,
    _deviations,
    _dot,
    _frustum,
    _load,
    _mix,
    _pose,
    _rotation,
    _scaled,
    _times,
    _unit_quat,
    _whitened,
)
from kissgs.rendering.cpu.shading import _harmonics


@compiled(
    "void(float32[:, ::1], int32[::1], uint16[::1], int32[::1], int64[::1], int64, int64, int64,"
    " float32[::1], float32[::1], float64, float32[:, ::1], int32[:, ::1], float32[:, ::1])",
    fastmath=_FAST,
)
def moments(
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
    spread: float,
    transmittance: np.ndarray,
    stops: np.ndarray,
    sums: np.ndarray,
) -> None:
    """Compute moments of the members of tiles ``first`` to ``last`` (exclusive).

    The arguments are those of :func:`kissgs.rendering.cpu.blending.removal_errors`, and ``spread``, the standard
    deviation of each channel of the background. ``sums``: out, ``(slots, 16)``, sums over the tile's pixels of |w|²
    times 1, u, v, u², uv, v², u³, u²v, uv², v³, u⁴, u³v, u²v², uv³, v⁴; and of (alpha T)². Pixels at which alpha is
    clamped to ALPHA_MAX count in the first sum only, which is therefore the error of removing the Gaussian.
    """
    alpha_min, alpha_max = limits[0], limits[1]
    zero, one = np.float32(0), np.float32(1)
    max_color = np.float32(2)  # a display shows at most 1; brighter colours are limited to twice that
    height, width = transmittance.shape
    variance = np.float32(3 * spread * spread)
    # Per pixel: x, y, stop, T; R, G, B behind the Gaussian, and transmittance to the background behind it.
    s = np.empty(8 * 256, np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % columns) * 16, (tile // columns) * 16
        begin = starts[tile]
        last_stop = 0
        for p in range(256):
            last_stop = max(last_stop, stops[tile, p])
            s[512 + p] = np.float32(stops[tile, p])
            s[768 + p] = transmittance[min(y0 + (p >> 4), height - 1), min(x0 + (p & 15), width - 1)]
            s[1024 + p], s[1280 + p], s[1536 + p] = background[0], background[1], background[2]
            s[1792 + p] = one
        for i in range(begin + last_stop, starts[tile + 1]):
            sums[slots[i], :] = zero
        for i in range(begin + last_stop - 1, begin - 1, -1):
            (mx, my, l0, l1, l2), (opacity, red, green, blue) = _footprint(records, members[i], x0, y0)
            red, green, blue = min(red, max_color), min(green, max_color), min(blue, max_color)
            top, bottom = np.uint64(spans[i] >> 5), np.uint64(spans[i] & 31)
            index = np.float32(i - begin)
            m0, mu, mv, muu, muv, mvv = zero, zero, zero, zero, zero, zero
            m30, m21, m12, m03 = zero, zero, zero, zero
            m40, m31, m22, m13, m04, squared_weight = zero, zero, zero, zero, zero, zero
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
                guu, guv, gvv = g * uu, g * uv, g * vv
                mu += g * u
                mv += g * v
                muu += guu
                muv += guv
                mvv += gvv
                m30 += guu * u
                m21 += guu * v
                m12 += gvv * u
                m03 += gvv * v
                m40 += guu * uu
                m31 += guu * uv
                m22 += guu * vv
                m13 += guv * vv
                m04 += gvv * vv
            slot = slots[i]
            sums[slot, 0] = m0
            sums[slot, 1] = mu
            sums[slot, 2] = mv
            sums[slot, 3] = muu
            sums[slot, 4] = muv
            sums[slot, 5] = mvv
            sums[slot, 6] = m30
            sums[slot, 7] = m21
            sums[slot, 8] = m12
            sums[slot, 9] = m03
            sums[slot, 10] = m40
            sums[slot, 11] = m31
            sums[slot, 12] = m22
            sums[slot, 13] = m13
            sums[slot, 14] = m04
            sums[slot, 15] = squared_weight


@njit(nogil=True, error_model="numpy")
def _form(m: np.ndarray, form: np.ndarray) -> None:
    """Write the 6x6 matrix of moments of polynomials in 1, u, v, u², uv, v² into ``form``."""
    moment_index = np.array(
        [
            [0, 1, 2, 3, 4, 5],
            [1, 3, 4, 6, 7, 8],
            [2, 4, 5, 7, 8, 9],
            [3, 6, 7, 10, 11, 12],
            [4, 7, 8, 11, 12, 13],
            [5, 8, 9, 12, 13, 14],
        ]
    )
    for i in range(6):
        for j in range(6):
            form[i, j] = m[moment_index[i, j]]


@compiled(
    "void(float32[:, ::1], float32[:, ::1], float32[:, ::1], float32[::1],"
    " int32[::1], int64[::1], int64[::1], int64[::1], float32[:, ::1], int64, int64,"
    " float64[:, ::1], float64[::1], float64[:, ::1], int64, int64, float64[::1], float64,"
    " float32[:, ::1], float32[:, ::1], float32[::1], float32[:, ::1])"
)
def add_to_parameters(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    visible: np.ndarray,
    rows: np.ndarray,
    slots_from: np.ndarray,
    slot_counts: np.ndarray,
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
    shape_hessian: np.ndarray,
    color_weight: np.ndarray,
    sh_basis_sum: np.ndarray,
) -> None:
    """Add the Hessians of one image to those of the Gaussians whose footprints are ``rows[first:last]``.

    Args:
        means, quats, scales, opacities, visible, rows, slots_from, slot_counts, first, last, viewmat, K, width, height,
            constants: as for :func:`kissgs.rendering.cpu.projection.project_backward`.
        slots: output of :func:`moments`.
        eye: ``(3,)`` position of the camera, world units.
        weight: weight of the image.
        position_hessian: ``(N, 6)`` upper triangle of the Hessian by position: xx, xy, xz, yy, yz, zz.
        shape_hessian: ``(N, 28)`` upper triangle, row by row, of the Hessian by opacity logit, three log-scales, and a
            rotation vector in the Gaussian's own frame.
        color_weight: ``(N,)`` sum of (alpha T)².
        sh_basis_sum: ``(N, K)`` sum of (alpha T)² times the spherical harmonics without the constant one.
    """
    dilation = constants[2]
    fx, fy = K[0, 0], K[1, 1]
    rotation, translation = _pose(viewmat)
    left, right, top, bottom = _frustum(K, width, height, constants[3])
    m, form = np.empty(16, np.float64), np.empty((6, 6), np.float64)
    by_shape, product = np.zeros((7, 6), np.float64), np.zeros((7, 6), np.float64)
    by_position = np.zeros((3, 2), np.float64)
    basis = np.zeros(15, np.float64)
    for i in range(first, last):
        row = rows[i]
        n = visible[row]
        m[:] = 0.0
        for slot in range(slots_from[row], slots_from[row] + slot_counts[row]):
            for c in range(16):
                m[c] += slots[slot, c]
        if m[15] == 0.0:
            continue
        m *= weight
        _form(m, form)

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
        u_rows, v_rows = _whitened(w, v, dilation)

        # Derivative of ln alpha by position: 2 (u, v) L dc, c being the centre.
        across = _mix(fx / z, rotation[0], -fx / z * x, rotation[2])
        down = _mix(fy / z, rotation[1], -fy / z * y, rotation[2])
        for c in range(3):
            by_position[c, 0] = 2 * (l0 * across[c] + l1 * down[c])
            by_position[c, 1] = 2 * l2 * down[c]
        k = 0
        for c in range(3):
            for d in range(c, 3):
                position_hessian[n, k] += by_position[c, 0] * (
                    form[1, 1] * by_position[d, 0] + form[1, 2] * by_position[d, 1]
                ) + by_position[c, 1] * (form[2, 1] * by_position[d, 0] + form[2, 2] * by_position[d, 1])
                k += 1

        # By opacity; by the covariance S, 2 (u, v) L dS Lᵀ (u, v)ᵀ, and S by log-scales and by rotations about the
        # axes.
        by_shape[0, 0] = 1.0 / (1.0 + np.exp(np.float64(opacities[n])))
        for c in range(6):
            if c < 3:
                d, e, size = c, c, 2.0
            else:
                d, e = (c - 2) % 3, (c - 1) % 3  # the two axes that rotate about axis c - 3
                size = 2 * (s[d] / s[e] - s[e] / s[d])
            by_shape[1 + c, 3] = 2 * size * u_rows[d] * u_rows[e]
            by_shape[1 + c, 4] = 2 * size * (u_rows[d] * v_rows[e] + v_rows[d] * u_rows[e])
            by_shape[1 + c, 5] = 2 * size * v_rows[d] * v_rows[e]
        for c in range(7):
            for d in range(6):
                product[c, d] = by_shape[c, 0] * form[0, d]
                for e in range(3, 6):
                    product[c, d] += by_shape[c, e] * form[e, d]
        k = 0
        for c in range(7):
            for d in range(c, 7):
                total = product[c, 0] * by_shape[d, 0]
                for e in range(3, 6):
                    total += product[c, e] * by_shape[d, e]
                shape_hessian[n, k] += total
                k += 1

        color_weight[n] += m[15]
        if sh_basis_sum.shape[1] > 0:
            direction = (mean[0] - eye[0], mean[1] - eye[1], mean[2] - eye[2])
            inverse = 1.0 / np.sqrt(_dot(direction, direction))
            dx, dy, dz = direction[0] * inverse, direction[1] * inverse, direction[2] * inverse
            _harmonics(dx, dy, dz, sh_basis_sum.shape[1], basis)
            for c in range(sh_basis_sum.shape[1]):
                sh_basis_sum[n, c] += m[15] * basis[c]
