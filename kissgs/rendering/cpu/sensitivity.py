"""Numba kernels of coverage and of sensitivity: Hessians of the squared image error, from one backward pass."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import float32, float64, int64, void

from kissgs.core.array_types import Float32
from kissgs.core.harmonics_kernel import write_harmonics
from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.projection import (
    Vector,
    _applied,
    _cholesky,
    _cross,
    _deviations,
    _dot,
    _frustum,
    _harmonics,
    _helper,
    _image_rows,
    _in_image,
    _jacobian,
    _load,
    _pose,
    _scaled,
    _strain,
    _unit,
    _whitened,
)
from kissgs.rendering.cpu.records import FRAME, SLOTS, Frame, Slots, named_tuple

# Numba kernel of coverage: how well an image shows each Gaussian, by visibility and resolution.


@compiled(void(FRAME, float32[::1], int64, int64, float32[::1], float64, float32[::1]))
def raise_coverage(
    frame: Frame,
    local_scale: np.ndarray,
    first: int,
    last: int,
    seen: np.ndarray,
    resolved_length: float,
    share: np.ndarray,
) -> None:
    """Raise the coverage, ``share``, of the Gaussians of footprints ``first`` to ``last`` (exclusive) by one image.
    ``seen`` is the sum of (alpha T)² over the pixels of each footprint; ``resolved_length`` the length in the image of
    the local scale from which a Gaussian counts as resolved, pixels. It counts as seen from 0.003 of its squared alpha
    on; with less than a twentieth of its opacity unobstructed, it is hidden."""
    gaussians, projection = frame.gaussians, frame.projection
    means, scales, K, eye = gaussians.means, gaussians.scales, projection.K, projection.eye
    dilated_area = projection.dilation / 0.3  # of a squared point, pixels
    focal, pixels = np.sqrt(K[0, 0] * K[1, 1]), np.float64(projection.width * projection.height)
    for row in range(first, last):
        n = frame.footprints.visible[row]
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        per_unit = focal / max(np.sqrt(x * x + y * y + z * z), projection.near)
        a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        across = a + b + c - min(a, b, c)  # of the two largest
        area = np.pi * np.exp(across) * per_unit * per_unit + dilated_area  # of a squared Gaussian
        opacity = 1.0 / (1.0 + np.exp(-np.float64(gaussians.opacities[n])))
        if projection.antialiased:
            opacity *= (area - dilated_area) / area
        shown = max(opacity * opacity * min(area, pixels), 1e-300)
        visibility = min(seen[row] / (0.003 * shown), 1.0)
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


@_helper
def _square(u: Vector, v: Vector, axis: int) -> Vector:
    """Return the coefficients of g², g being u times an entry of ``u`` plus v times one of ``v``, by u², uv and v²."""
    return u[axis] * u[axis], 2 * u[axis] * v[axis], v[axis] * v[axis]


@_helper
def _thickened(s: Vector) -> Vector:
    """Return the factors by which a Gaussian's axes are enlarged to at least 1/10,000 of the longest. Moments of a
    needle's thin axes would underflow, while their derivatives by rotations are large."""
    least = 1e-4 * max(s[0], s[1], s[2])
    return max(least / s[0], 1.0), max(least / s[1], 1.0), max(least / s[2], 1.0)


class Sums(NamedTuple):
    """Sums over images, by Gaussian, and of the present image alone."""

    position_hessian: Float32[np.ndarray, "N 3"]
    shape_moments: Float32[np.ndarray, "N 10"]
    """Sums over pixels of |w|² times 1; times g0², g1², g2²; times their squares; and times (g1 g2)², (g2 g0)²,
    (g0 g1)²; with constant terms in antialiased scenes."""
    color_weight: Float32[np.ndarray, " N"]  # sum of (alpha T)²
    harmonics: Float32[np.ndarray, "N K"]  # sum of (alpha T)² times the spherical harmonics without the constant one
    higher_harmonics: Float32[np.ndarray, "N H"]  # sum of (alpha T)² times those of higher degrees
    seen: Float32[np.ndarray, " N"]  # sum of (alpha T)² of this image alone, without its weight, by row


SUMS = named_tuple(
    (float32[:, ::1], float32[:, ::1], float32[::1], float32[:, ::1], float32[:, ::1], float32[::1]), Sums
)


@_helper
def _add_shape(
    m: np.ndarray, w: Vector, v: Vector, s: Vector, dilation: float, antialiased: bool, out: np.ndarray, n: int
) -> None:
    """Add the moments of one footprint as moments of g to the row ``n`` of ``shape_moments``. A footprint's coordinates
    (u, v) times L W are coordinates g in the Gaussian's own frame, in units of its axes, here :func:`_thickened`. The
    derivative of ln alpha by a strain of the Gaussian is quadratic in g whatever the camera, so images are added as
    moments of g, and the Hessian by log-scales and rotation follows once (:func:`moments_to_hessians`). In antialiased
    scenes that derivative has a constant term as well (:func:`_strain`): g g becomes g g + strain / 4. Pixels at which
    alpha is clamped have it too, where it is at most 2 %."""
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


@compiled(void(FRAME, SLOTS, int64, int64, float32[:, ::1], float64, SUMS))
def add_to_parameters(
    frame: Frame, slots: Slots, first: int, last: int, moments: np.ndarray, weight: float, out: Sums
) -> None:
    """Add the moments of some tiles of an image to those of the Gaussians of footprints ``slots.rows[first:last]``."""
    gaussians, projection, dilation = frame.gaussians, frame.projection, frame.projection.dilation
    pose, frustum = _pose(projection.viewmat), _frustum(projection)
    own, higher = out.harmonics.shape[1], out.higher_harmonics.shape[1]
    basis, m = np.zeros(own + higher, np.float64), np.empty(10, np.float64)
    for i in range(first, last):
        row = slots.rows[i]
        n = frame.footprints.visible[row]
        m[:] = 0.0
        for slot in range(slots.first[row], slots.first[row + 1]):
            for c in range(10):
                m[c] += moments[slot, c]
        if m[9] == 0.0:
            continue
        out.seen[row] += m[9]
        for c in range(10):
            m[c] *= weight

        (x, y, z), _, _, (_, _, _, s), (w, v) = _in_image(gaussians, projection, pose, frustum, n)
        _add_shape(m, w, v, s, dilation, projection.antialiased, out.shape_moments, n)

        # Derivative of ln alpha by position: 2 (u, v) L dc, c being the centre.
        l0, l1, l2 = _cholesky(w, v, dilation)
        across, down = _image_rows(_jacobian(projection.K, x, y, z), pose[0])
        for c in range(3):
            a, b = 2 * (l0 * across[c] + l1 * down[c]), 2 * l2 * down[c]
            out.position_hessian[n, c] += m[1] * a * a + 2 * m[2] * a * b + m[3] * b * b

        out.color_weight[n] += m[9]
        if own > 0:
            _write_basis(_load(gaussians.means, n), projection.eye, own, basis)
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
