"""Numba kernels of shading: from spherical harmonics to colours in a camera, and gradients back."""

from __future__ import annotations

import numpy as np
from numba import float64, int32, int64, njit, void

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.records import FOOTPRINTS, GAUSSIANS, PROJECTION, Footprints, Gaussians, Projection


@njit(nogil=True, error_model="numpy")
def _harmonics(x: float, y: float, z: float, count: int, basis: np.ndarray) -> None:
    """Write the real spherical harmonics 1 to ``count``, without the constant one, at a unit vector into ``basis``.

    Unrolled, unlike :func:`kissgs.core.harmonics_kernel.write_harmonics`, because every footprint needs it.
    """
    if count >= 3:
        basis[0] = -0.4886025119029199 * y
        basis[1] = 0.4886025119029199 * z
        basis[2] = -0.4886025119029199 * x
    if count >= 8:
        basis[3] = 1.0925484305920792 * x * y
        basis[4] = -1.0925484305920792 * y * z
        basis[5] = 0.31539156525252005 * (3 * z * z - 1)
        basis[6] = -1.0925484305920792 * x * z
        basis[7] = 0.5462742152960396 * (x * x - y * y)
    if count >= 15:
        basis[8] = -0.5900435899266435 * y * (3 * x * x - y * y)
        basis[9] = 2.890611442640554 * x * y * z
        basis[10] = -0.4570457994644658 * y * (5 * z * z - 1)
        basis[11] = 0.3731763325901154 * z * (5 * z * z - 3)
        basis[12] = -0.4570457994644658 * x * (5 * z * z - 1)
        basis[13] = 1.445305721320277 * z * (x * x - y * y)
        basis[14] = -0.5900435899266435 * x * (x * x - 3 * y * y)


@njit(nogil=True, error_model="numpy")
def _harmonics_gradient(x: float, y: float, z: float, count: int, v: np.ndarray) -> tuple[float, float, float]:
    """Return the sum over harmonics of ``v`` times their gradients by x, y, z, not projected on the sphere."""
    gx = gy = gz = 0.0
    if count >= 3:
        gy -= 0.4886025119029199 * v[0]
        gz += 0.4886025119029199 * v[1]
        gx -= 0.4886025119029199 * v[2]
    if count >= 8:
        c = 1.0925484305920792
        gx += c * (y * v[3] - z * v[6] + x * v[7])
        gy += c * (x * v[3] - z * v[4] - y * v[7])
        gz += c * (-y * v[4] - x * v[6]) + 1.8923493915151202 * z * v[5]
    if count >= 15:
        c0, c1, c2 = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
        c3, c4 = 0.3731763325901154, 1.445305721320277
        gx += -6 * c0 * x * y * v[8] + c1 * y * z * v[9] - c2 * (5 * z * z - 1) * v[12]
        gx += 2 * c4 * x * z * v[13] - 3 * c0 * (x * x - y * y) * v[14]
        gy += -3 * c0 * (x * x - y * y) * v[8] + c1 * x * z * v[9] - c2 * (5 * z * z - 1) * v[10]
        gy += -2 * c4 * y * z * v[13] + 6 * c0 * x * y * v[14]
        gz += c1 * x * y * v[9] - 10 * c2 * z * (y * v[10] + x * v[12])
        gz += 3 * c3 * (5 * z * z - 1) * v[11] + c4 * (x * x - y * y) * v[13]
    return gx, gy, gz


@compiled(void(GAUSSIANS, PROJECTION, int64, int64, FOOTPRINTS))
def shade(gaussians: Gaussians, projection: Projection, first: int, last: int, footprints: Footprints) -> None:
    """Write the colours of footprints ``first`` to ``last`` (exclusive), clamped to at least 0."""
    means, sh0, shN, records = gaussians.means, gaussians.sh0, gaussians.shN, footprints.records
    eye, rest = projection.eye, shN.shape[1]
    basis = np.empty(15, np.float64)
    for row in range(first, last):
        n = footprints.visible[row]
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        inverse = 1.0 / np.sqrt(x * x + y * y + z * z)
        _harmonics(x * inverse, y * inverse, z * inverse, rest, basis)
        red = 0.5 + 0.28209479177387814 * sh0[n, 0]
        green = 0.5 + 0.28209479177387814 * sh0[n, 1]
        blue = 0.5 + 0.28209479177387814 * sh0[n, 2]
        for k in range(rest):
            red += basis[k] * shN[n, k, 0]
            green += basis[k] * shN[n, k, 1]
            blue += basis[k] * shN[n, k, 2]
        records[row, 6] = max(red, 0.0)
        records[row, 7] = max(green, 0.0)
        records[row, 8] = max(blue, 0.0)


@compiled(void(GAUSSIANS, PROJECTION, int32[::1], int64, int64, float64[:, ::1], GAUSSIANS))
def shade_backward(
    gaussians: Gaussians,
    projection: Projection,
    indices: np.ndarray,
    first: int,
    last: int,
    v_colors: np.ndarray,
    gradients: Gaussians,
) -> None:
    """Compute gradients by SH coefficients, and add those by means, of the Gaussians ``indices[first:last]``."""
    means, shN, eye, rest = gaussians.means, gaussians.shN, projection.eye, gaussians.shN.shape[1]
    v_means, v_sh0, v_shN = gradients.means, gradients.sh0, gradients.shN
    basis, v_basis = np.empty(15, np.float64), np.empty(15, np.float64)
    for i in range(first, last):
        n = indices[i]
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        inverse = 1.0 / np.sqrt(x * x + y * y + z * z)
        x, y, z = x * inverse, y * inverse, z * inverse
        _harmonics(x, y, z, rest, basis)
        red, green, blue = v_colors[i, 0], v_colors[i, 1], v_colors[i, 2]
        v_sh0[i, 0] = 0.28209479177387814 * red
        v_sh0[i, 1] = 0.28209479177387814 * green
        v_sh0[i, 2] = 0.28209479177387814 * blue
        for k in range(rest):
            v_shN[i, k, 0] = basis[k] * red
            v_shN[i, k, 1] = basis[k] * green
            v_shN[i, k, 2] = basis[k] * blue
            v_basis[k] = shN[n, k, 0] * red + shN[n, k, 1] * green + shN[n, k, 2] * blue
        gx, gy, gz = _harmonics_gradient(x, y, z, rest, v_basis)
        along = gx * x + gy * y + gz * z  # the component along the direction changes only its length
        v_means[i, 0] += (gx - along * x) * inverse
        v_means[i, 1] += (gy - along * y) * inverse
        v_means[i, 2] += (gz - along * z) * inverse
