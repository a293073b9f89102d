"""Numba kernels of coverage and of sensitivity: Hessians of the squared image error, from one backward pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float32, float64, int32, int64, njit, void

from kissgs.core.array_types import Float32
from kissgs.core.harmonics_kernel import write_harmonics
from kissgs.core.numba_kernels import compiled
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
from kissgs.rendering.cpu.projection import (
    Vector,
    _applied,
    _cholesky,
    _clamped,
    _cross,
    _deviations,
    _dot,
    _ellipsoid,
    _frustum,
    _harmonics,
    _helper,
    _image_axes,
    _image_rows,
    _in_camera,
    _jacobian,
    _load,
    _pose,
    _scaled,
    _strain,
    _unit,
    _whitened,
)
from kissgs.rendering.cpu.records import (
    BLENDED,
    GAUSSIANS,
    PROJECTION,
    SLOTS,
    TILE_LISTS,
    Blended,
    Gaussians,
    Projection,
    Slots,
    TileLists,
    named_tuple,
)

# Numba kernel of coverage: how well an image shows each Gaussian, by visibility and resolution.


@compiled(void(GAUSSIANS, PROJECTION, float32[::1], int32[::1], int64, int64, float32[::1], float64[::1], float32[::1]))
def raise_coverage(
    gaussians: Gaussians,
    projection: Projection,
    local_scale: np.ndarray,
    visible: np.ndarray,
    first: int,
    last: int,
    seen: np.ndarray,
    limits: np.ndarray,
    share: np.ndarray,
) -> None:
    """Raise the coverage, ``share``, of the Gaussians of footprints ``first`` to ``last`` (exclusive) by one image.

    ``seen`` is the sum of (alpha T)² over the pixels of each footprint. ``limits``: share of the squared alpha from
    which a Gaussian counts as seen; length in the image of the local scale from which it counts as resolved, pixels;
    area of a squared Gaussian that is a dilated point, pixels.
    """
    means, scales, K, eye = gaussians.means, gaussians.scales, projection.K, projection.eye
    seen_share, resolved_length, dilated_area = limits[0], limits[1], limits[2]
    focal, pixels = np.sqrt(K[0, 0] * K[1, 1]), np.float64(projection.width * projection.height)
    for row in range(first, last):
        n = visible[row]
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        per_unit = focal / max(np.sqrt(x * x + y * y + z * z), projection.near)
        a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        across = a + b + c - min(a, b, c)  # of the two largest
        area = np.pi * np.exp(across) * per_unit * per_unit + dilated_area  # of a squared Gaussian
        opacity = 1.0 / (1.0 + np.exp(-np.float64(gaussians.opacities[n])))
        if projection.antialiased:
            opacity *= (area - dilated_area) / area
        shown = max(opacity * opacity * min(area, pixels), 1e-300)
        visibility = min(seen[row] / (seen_share * shown), 1.0)
        resolution = min(np.float64(local_scale[n]) * per_unit / resolved_length, 1.0)
        share[n] = max(share[n], np.float32(visibility * resolution * resolution))


# Numba kernels of sensitivity: Hessians of the squared image error by stored parameters, from one backward pass.
#
# The derivative of a pixel by the logarithm of a footprint's alpha is w = alpha T (colour - B), B being the colour
# behind it. To first order, the change of that logarithm is a polynomial of degree 2 in the footprint's own coordinates
# u, v: the opacity changes its constant term, the centre its linear terms, the covariance its quadratic terms. The
# squared change of the image is then a quadratic form in these six coefficients, whose entries are moments, sums of
# |w|² uⁱ vʲ over pixels with i + j of 0, 2 and 4. The chain rule gives J ᵀ J of the image by the stored parameters,
# without random probes.
#
# The background that a scene will be shown with is unknown, so it is random: |w|² is the mean over backgrounds.

MOMENTS = 10
"""Number of moments of each footprint in each tile."""


@njit(nogil=True, error_model="numpy")
def _begin_tile(records: np.ndarray, lists: TileLists, tile: int, frame: Blended, s: np.ndarray) -> None:
    """Write T, the colour behind all Gaussians, and the transmittance to the background behind, of a tile's pixels.

    What is behind the end of a pixel's list has about the colour of the next Gaussian, and hides the background.
    """
    x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
    height, width = frame.transmittance.shape
    background, begin, max_color = frame.background, lists.starts[tile], np.float32(2)
    for p in range(256):
        s[768 + p] = frame.transmittance[min(y0 + (p >> 4), height - 1), min(x0 + (p & 15), width - 1)]
        s[1024 + p], s[1280 + p], s[1536 + p], s[1792 + p] = background[0], background[1], background[2], 1
        if begin + frame.stops[tile, p] < lists.starts[tile + 1]:
            n = lists.members[begin + frame.stops[tile, p]]
            s[1024 + p] = min(records[n, 6], max_color)
            s[1280 + p] = min(records[n, 7], max_color)
            s[1536 + p] = min(records[n, 8], max_color)
            s[1792 + p] = 0


@njit(nogil=True, error_model="numpy", fastmath=_FAST, inline="always")
def _moments(
    s: np.ndarray,
    span: np.uint16,
    index: np.float32,
    footprint: tuple[Place, tuple[np.float32, ...]],
    limits: tuple[np.float32, np.float32],
    variance: np.float32,
    sums: np.ndarray,
) -> None:
    """Compute the moments of one footprint over a tile's pixels, and step in front of it."""
    place, (opacity, red, green, blue) = footprint
    zero, one = np.float32(0), np.float32(1)
    max_color = np.float32(2)  # a display shows at most 1; brighter colours are limited to twice that
    red, green, blue = min(red, max_color), min(green, max_color), min(blue, max_color)
    top, bottom = _rows(span)
    m0, m20, m11, m02, m40, m31, m22, m13, m04 = zero, zero, zero, zero, zero, zero, zero, zero, zero
    squared_weight = zero
    for p in range(top, bottom):
        drawn = index < s[p + np.uint64(512)]
        u, v, full, alpha = _alpha(s[p], s[p + np.uint64(256)], drawn, place, opacity, limits)
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
        g = g if full <= limits[1] else zero
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
    sums[0], sums[1], sums[2], sums[3] = m0, m20, m11, m02
    sums[4], sums[5], sums[6], sums[7], sums[8] = m40, m31, m22, m13, m04
    sums[9] = squared_weight


@compiled(
    void(float32[:, ::1], TILE_LISTS, SLOTS, int64, int64, BLENDED, float64, float32[:, ::1]),
    fastmath=_FAST,
)
def moments(
    records: np.ndarray,
    lists: TileLists,
    slots: Slots,
    first: int,
    last: int,
    frame: Blended,
    spread: float,
    sums: np.ndarray,
) -> None:
    """Compute moments of the members of tiles ``first`` to ``last`` (exclusive), ``(slots, 10)``.

    These are sums over the tile's pixels of |w|² times 1, u², uv, v², u⁴, u³v, u²v², uv³, v⁴; and of (alpha T)².
    ``spread`` is the standard deviation of each channel of the background. Pixels at which alpha is clamped to
    ALPHA_MAX count in the first sum only, which is therefore the error of removing the Gaussian.
    """
    limits, variance = (frame.limits[0], frame.limits[1]), np.float32(3 * spread * spread)
    # Per pixel: x, y, stop, T; R, G, B behind the Gaussian, and transmittance to the background behind it.
    s, copies = np.empty(8 * 256, np.float32), np.empty((64, 9), np.float32)
    _pixel_centres(s)
    for tile in range(first, last):
        x0, y0 = (tile % lists.columns) * 16, (tile // lists.columns) * 16
        begin, last_stop = lists.starts[tile], _copy_stops(frame.stops, tile, s)
        _begin_tile(records, lists, tile, frame, s)
        for i in range(begin + last_stop, lists.starts[tile + 1]):
            sums[slots.of[i - slots.begin], :] = np.float32(0)
        for end in range(begin + last_stop, begin, -64):
            start = max(begin, end - 64)
            _copy_records(records, lists.members, start, end, copies)
            for i in range(end - 1, start - 1, -1):
                footprint, index = _footprint(copies, i - start, x0, y0), np.float32(i - begin)
                _moments(s, lists.spans[i], index, footprint, limits, variance, sums[slots.of[i - slots.begin]])


@_helper
def _square(u: Vector, v: Vector, axis: int) -> Vector:
    """Return the coefficients of g², g being u times an entry of ``u`` plus v times one of ``v``, by u², uv and v²."""
    return u[axis] * u[axis], 2 * u[axis] * v[axis], v[axis] * v[axis]


@_helper
def _thickened(s: Vector) -> Vector:
    """Return the factors by which a Gaussian's axes are enlarged to at least 1/10,000 of the longest.

    Moments of a needle's thin axes would underflow, while their derivatives by rotations are large.
    """
    least = 1e-4 * max(s[0], s[1], s[2])
    return max(least / s[0], 1.0), max(least / s[1], 1.0), max(least / s[2], 1.0)


class Sums(NamedTuple):
    """Sums over images, by Gaussian, and of the present image alone."""

    position_hessian: Float32[np.ndarray, "N 3"]
    shape_moments: Float32[np.ndarray, "N 10"]
    """Sums over pixels of |w|² times 1; times g0², g1², g2²; times their squares; and times (g1 g2)², (g2 g0)²,
    (g0 g1)²; with constant terms in antialiased scenes."""
    color_weight: Float32[np.ndarray, " N"]
    """Sum of (alpha T)²."""
    harmonics: Float32[np.ndarray, "N K"]
    """Sum of (alpha T)² times the spherical harmonics without the constant one."""
    higher_harmonics: Float32[np.ndarray, "N H"]
    """Sum of (alpha T)² times those of higher degrees."""
    seen: Float32[np.ndarray, " N"]
    """Sum of (alpha T)² of this image alone, without its weight, by row."""


SUMS = named_tuple(
    (float32[:, ::1], float32[:, ::1], float32[::1], float32[:, ::1], float32[:, ::1], float32[::1]), Sums
)


@_helper
def _add_shape(
    m: np.ndarray, w: Vector, v: Vector, s: Vector, dilation: float, antialiased: bool, out: np.ndarray, n: int
) -> None:
    """Add the moments of one footprint as moments of g to the row ``n`` of ``shape_moments``.

    A footprint's coordinates (u, v) times L W are coordinates g in the Gaussian's own frame, in units of its axes, here
    :func:`_thickened`. The derivative of ln alpha by a strain of the Gaussian is quadratic in g whatever the camera, so
    images are added as moments of g, and the Hessian by log-scales and rotation follows once
    (:func:`moments_to_hessians`). In antialiased scenes that derivative has a constant term as well (:func:`_strain`):
    g g becomes g g + strain / 4. Pixels at which alpha is clamped have it too, where it is at most 2 %.
    """
    m0, m20, m11, m02, m40, m31, m22, m13, m04 = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
    plain_u, plain_v = _whitened(w, v, dilation)
    thickened = _thickened(s)
    u_row, v_row = _scaled(plain_u, thickened), _scaled(plain_v, thickened)
    g0, g1, g2 = _square(u_row, v_row, 0), _square(u_row, v_row, 1), _square(u_row, v_row, 2)
    second, fourth = (m20, m11, m02), ((m40, m31, m22), (m31, m22, m13), (m22, m13, m04))
    by_0, by_1, by_2 = _applied(fourth, g0), _applied(fourth, g1), _applied(fourth, g2)
    out[n, 0] += m0
    out[n, 1] += _dot(second, g0)
    out[n, 2] += _dot(second, g1)
    out[n, 3] += _dot(second, g2)
    out[n, 4] += _dot(by_0, g0)
    out[n, 5] += _dot(by_1, g1)
    out[n, 6] += _dot(by_2, g2)
    out[n, 7] += _dot(by_1, g2)
    out[n, 8] += _dot(by_2, g0)
    out[n, 9] += _dot(by_0, g1)
    if antialiased:
        axis = _unit(_cross(w, v))
        for c in range(3):
            d, e = (c + 1) % 3, (c + 2) % 3
            square = 0.25 * thickened[c] * thickened[c] * _strain(axis, plain_u, plain_v, c, c)
            product = 0.25 * thickened[d] * thickened[e] * _strain(axis, plain_u, plain_v, d, e)
            of_square = _dot(second, _square(u_row, v_row, c))
            crossed = u_row[d] * v_row[e] + u_row[e] * v_row[d]
            of_product = m20 * u_row[d] * u_row[e] + m11 * crossed + m02 * v_row[d] * v_row[e]
            out[n, 1 + c] += square * m0
            out[n, 4 + c] += square * (2 * of_square + square * m0)
            out[n, 7 + c] += product * (2 * of_product + product * m0)


@_helper
def _write_basis(mean: Vector, eye: np.ndarray, own: int, basis: np.ndarray) -> None:
    """Write the spherical harmonics in the direction from the camera; ``own`` are those of the scene's degree."""
    direction = (mean[0] - eye[0], mean[1] - eye[1], mean[2] - eye[2])
    inverse = 1.0 / np.sqrt(_dot(direction, direction))
    dx, dy, dz = direction[0] * inverse, direction[1] * inverse, direction[2] * inverse
    if basis.shape[0] > own:
        write_harmonics(dx, dy, dz, int(np.sqrt(basis.shape[0] + 1.0) + 0.5) - 1, basis)
    else:
        _harmonics(dx, dy, dz, own, basis)


@compiled(void(GAUSSIANS, PROJECTION, int32[::1], SLOTS, float32[:, ::1], int64, int64, float64, SUMS))
def add_to_parameters(
    gaussians: Gaussians,
    projection: Projection,
    visible: np.ndarray,
    slots: Slots,
    moments: np.ndarray,
    first: int,
    last: int,
    weight: float,
    out: Sums,
) -> None:
    """Add the moments of some tiles of an image to those of the Gaussians of footprints ``slots.rows[first:last]``."""
    dilation = projection.dilation
    pose, frustum = _pose(projection.viewmat), _frustum(projection)
    own, higher = out.harmonics.shape[1], out.higher_harmonics.shape[1]
    basis, m = np.zeros(own + higher, np.float64), np.empty(10, np.float64)
    for i in range(first, last):
        row = slots.rows[i]
        n = visible[row]
        m[:] = 0.0
        for slot in range(slots.first[row], slots.first[row + 1]):
            for c in range(10):
                m[c] += moments[slot, c]
        if m[9] == 0.0:
            continue
        out.seen[row] += m[9]
        for c in range(10):
            m[c] *= weight

        mean = _load(gaussians.means, n)
        x, y, z = _in_camera(pose, mean)
        clamped_x, clamped_y = _clamped(x, y, frustum)
        p, q = _image_rows(_jacobian(projection.K, clamped_x, clamped_y, z), pose[0])
        _, _, R, s = _ellipsoid(gaussians, n)
        w, v = _image_axes(p, q, R, s)
        _add_shape(m, w, v, s, dilation, projection.antialiased, out.shape_moments, n)

        # Derivative of ln alpha by position: 2 (u, v) L dc, c being the centre.
        l0, l1, l2 = _cholesky(w, v, dilation)
        across, down = _image_rows(_jacobian(projection.K, x, y, z), pose[0])
        for c in range(3):
            a, b = 2 * (l0 * across[c] + l1 * down[c]), 2 * l2 * down[c]
            out.position_hessian[n, c] += m[1] * a * a + 2 * m[2] * a * b + m[3] * b * b

        out.color_weight[n] += m[9]
        if own > 0:
            _write_basis(mean, projection.eye, own, basis)
            for c in range(own):
                out.harmonics[n, c] += m[9] * basis[c]
            for c in range(higher):
                out.higher_harmonics[n, c] += m[9] * basis[own + c]


@compiled("void(float32[:, ::1], float32[::1], int64, int64, float32[:, ::1])")
def moments_to_hessians(
    scales: np.ndarray, opacities: np.ndarray, first: int, last: int, shape_hessian: np.ndarray
) -> None:
    """Replace the moments of Gaussians ``first`` to ``last`` (exclusive) by Hessians as :class:`kissgs.Sensitivity` has
    them.

    With g as in :func:`_add_shape`, the derivative of ln alpha by the opacity logit is 1 - opacity, by a
    log-scale 4 g[c]², and by a rotation about axis c 4 (s[d] / s[e] - s[e] / s[d]) g[d] g[e], with the constant terms
    of antialiased scenes.
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
