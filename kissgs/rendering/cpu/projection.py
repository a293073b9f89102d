"""Numba kernels of projection and shading: from Gaussians to footprints and colours in a camera, and gradients back."""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int32, int64, njit, void

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.records import (
    FOOTPRINTS,
    FRAME,
    GAUSSIANS,
    PROJECTION,
    SLOTS,
    Footprints,
    Frame,
    Gaussians,
    Projection,
    Slots,
)

# Shading: from spherical harmonics to colours in a camera, and gradients back.


@njit(nogil=True, error_model="numpy")
def _harmonics(x: float, y: float, z: float, count: int, basis: np.ndarray) -> None:
    """Write the real spherical harmonics 1 to ``count``, without the constant one, at a unit vector into ``basis``.
    Unrolled, unlike :func:`kissgs.core.harmonics_kernel.write_harmonics`, because every footprint needs it."""
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


@compiled(void(FRAME, int32[::1], int64, int64, float64[:, ::1], GAUSSIANS))
def shade_backward(
    frame: Frame, indices: np.ndarray, first: int, last: int, v_colors: np.ndarray, gradients: Gaussians
) -> None:
    """Compute gradients by SH coefficients, and add those by means, of the Gaussians ``indices[first:last]``."""
    means, shN, eye = frame.gaussians.means, frame.gaussians.shN, frame.projection.eye
    rest = shN.shape[1]
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


# Projection: from Gaussians to footprints in the image, and gradients back.
#
# The 2x2 covariance is W Wᵀ + dilation, where W = J Rc R diag(s) is 2x3: J the derivative of the projection, Rc and R
# the rotations of camera and Gaussian. Its determinant is computed from W as a sum of positive terms (Cauchy-Binet), so
# that a needle of length 1e13 loses no digits. Arithmetic is float64, which avoids overflow; memory bandwidth is the
# limit anyway.
#
# Vectors are tuples and matrices tuples of rows, so that they stay in registers.

Vector = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Bounds = tuple[float, float, float, float]
Jacobian = tuple[float, float, float, float]
Ellipsoid = tuple[Quat, float, Matrix, Vector]

_helper = njit(nogil=True, error_model="numpy")


@_helper
def _load(rows: np.ndarray, n: int) -> Vector:
    return np.float64(rows[n, 0]), np.float64(rows[n, 1]), np.float64(rows[n, 2])


@_helper
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@_helper
def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@_helper
def _mix(x: float, a: Vector, y: float, b: Vector) -> Vector:
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]


@_helper
def _scaled(a: Vector, s: Vector) -> Vector:
    return a[0] * s[0], a[1] * s[1], a[2] * s[2]


@_helper
def _times(a: Vector, m: Matrix) -> Vector:
    """Return row vector times matrix."""
    return (
        a[0] * m[0][0] + a[1] * m[1][0] + a[2] * m[2][0],
        a[0] * m[0][1] + a[1] * m[1][1] + a[2] * m[2][1],
        a[0] * m[0][2] + a[1] * m[1][2] + a[2] * m[2][2],
    )


@_helper
def _applied(m: Matrix, a: Vector) -> Vector:
    """Return matrix times column vector."""
    return _dot(m[0], a), _dot(m[1], a), _dot(m[2], a)


@_helper
def _pose(viewmat: np.ndarray) -> tuple[Matrix, Vector]:
    return ((_load(viewmat, 0), _load(viewmat, 1), _load(viewmat, 2)), (viewmat[0, 3], viewmat[1, 3], viewmat[2, 3]))


@_helper
def _frustum(projection: Projection) -> Bounds:
    """Return the left, right, top and bottom bound of x/z and y/z, to which the projection's derivative is clamped."""
    K, width, height, margin = projection.K, projection.width, projection.height, projection.margin
    margin_x, margin_y = margin * 0.5 * width / K[0, 0], margin * 0.5 * height / K[1, 1]
    return (
        -K[0, 2] / K[0, 0] - margin_x,
        (width - K[0, 2]) / K[0, 0] + margin_x,
        -K[1, 2] / K[1, 1] - margin_y,
        (height - K[1, 2]) / K[1, 1] + margin_y,
    )


@_helper
def _unit_quat(quats: np.ndarray, n: int) -> tuple[float, float, float, float, float]:
    """Return the normalised w, x, y, z and 1 / length; the identity and 0 for a length below 1e-12."""
    w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
    norm2 = w * w + x * x + y * y + z * z
    if norm2 < 1e-24:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    shrink = 1.0 / np.sqrt(norm2)
    return w * shrink, x * shrink, y * shrink, z * shrink, shrink


@_helper
def _rotation(w: float, x: float, y: float, z: float) -> Matrix:
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@_helper
def _by_quat(q: Quat, e: Matrix) -> Quat:
    """Return the gradient by a unit quaternion, given that by its rotation matrix, ``e``; tangential to the sphere."""
    w, x, y, z = q
    curl = (e[2][1] - e[1][2], e[0][2] - e[2][0], e[1][0] - e[0][1])
    both = (e[1][2] + e[2][1], e[0][2] + e[2][0], e[0][1] + e[1][0])
    by_w = 2 * (x * curl[0] + y * curl[1] + z * curl[2])
    by_x = 2 * (w * curl[0] + y * both[2] + z * both[1] - 2 * x * (e[1][1] + e[2][2]))
    by_y = 2 * (w * curl[1] + x * both[2] + z * both[0] - 2 * y * (e[0][0] + e[2][2]))
    by_z = 2 * (w * curl[2] + x * both[1] + y * both[0] - 2 * z * (e[0][0] + e[1][1]))
    along = by_w * w + by_x * x + by_y * y + by_z * z
    return by_w - along * w, by_x - along * x, by_y - along * y, by_z - along * z


@_helper
def _deviations(scales: np.ndarray, n: int) -> Vector:
    s = _load(scales, n)
    return np.exp(s[0]), np.exp(s[1]), np.exp(s[2])


@_helper
def _cholesky(w: Vector, v: Vector, dilation: float) -> tuple[float, float, float]:
    """Return l0, l1, l2: (l0 dx + l1 dy)² + (l2 dy)² is half the squared Mahalanobis distance; w, v: rows of W."""
    c, ww, vv = _cross(w, v), _dot(w, w), _dot(v, v)
    det = _dot(c, c) + dilation * (ww + vv + dilation)
    l0 = np.sqrt((vv + dilation) / (2 * det))
    return l0, -_dot(w, v) / (vv + dilation) * l0, 1.0 / np.sqrt(2 * (vv + dilation))


@_helper
def _compensation(w: Vector, v: Vector, dilation: float) -> float:
    """Return the factor on the opacity of an antialiased scene: the root of det W Wᵀ / det (W Wᵀ + dilation)."""
    c = _cross(w, v)
    det = _dot(c, c)
    return np.sqrt(det / (det + dilation * (_dot(w, w) + _dot(v, v) + dilation)))


@_helper
def _strain(axis: Vector, u: Vector, v: Vector, i: int, j: int) -> float:
    """Return entry i, j of the derivative of the logarithm of :func:`_compensation` by a strain E of W, to W (1 + E).
    It is Wᵀ ((W Wᵀ)⁻¹ - (W Wᵀ + dilation)⁻¹) W: the projection onto the rows of W, whose cross product has the
    direction ``axis``, minus twice that of the rows u, v of L W."""
    return (1.0 if i == j else 0.0) - axis[i] * axis[j] - 2 * (u[i] * u[j] + v[i] * v[j])


@_helper
def _unit(a: Vector) -> Vector:
    """Return a vector over its length."""
    inverse = 1.0 / np.sqrt(_dot(a, a))
    return a[0] * inverse, a[1] * inverse, a[2] * inverse


@_helper
def _whitened(w: Vector, v: Vector, dilation: float) -> tuple[Vector, Vector]:
    """Return the rows of L W, whose entries are at most 1/√2: l0 w + l1 v, and l2 v. The terms of l0 w + l1 v are as
    large as a needle is long and cancel; w (v v) - v (w v) = v × (w × v) avoids that."""
    l0, _, l2 = _cholesky(w, v, dilation)
    scale = l0 / (_dot(v, v) + dilation)
    return _mix(scale * dilation, w, scale, _cross(v, _cross(w, v))), _scaled(v, (l2, l2, l2))


@_helper
def _is_far_outside(centre: float, side: int, deviation: float, clamped: float, most: float, dilation: float) -> bool:
    """Return whether a Gaussian is so far outside the image along an axis that it cannot reach it at any opacity.
    ``side`` is that of the image, ``deviation`` the largest standard deviation in pixels, ``clamped`` x/z or y/z, and
    ``most`` the largest 2 tau."""
    beyond = max(-centre, centre - side)
    return beyond > 0 and beyond * beyond > most * (deviation * deviation * (1 + clamped * clamped) + dilation)


@_helper
def _in_camera(pose: tuple[Matrix, Vector], mean: Vector) -> Vector:
    """Return x/z, y/z and z of a point in the camera."""
    rotation, translation = pose
    z = _dot(rotation[2], mean) + translation[2]
    return (_dot(rotation[0], mean) + translation[0]) / z, (_dot(rotation[1], mean) + translation[1]) / z, z


@_helper
def _clamped(x: float, y: float, frustum: Bounds) -> tuple[float, float]:
    """Return x/z and y/z within :func:`_frustum`."""
    left, right, top, bottom = frustum
    return min(right, max(left, x)), min(bottom, max(top, y))


@_helper
def _jacobian(K: np.ndarray, x: float, y: float, z: float) -> Jacobian:
    """Return the derivatives of the image's x by x and z, and of its y by y and z, given x/z, y/z and z."""
    return K[0, 0] / z, -K[0, 0] / z * x, K[1, 1] / z, -K[1, 1] / z * y


@_helper
def _image_rows(J: Jacobian, rotation: Matrix) -> tuple[Vector, Vector]:
    """Return the rows of J Rc."""
    return _mix(J[0], rotation[0], J[1], rotation[2]), _mix(J[2], rotation[1], J[3], rotation[2])


@_helper
def _ellipsoid(gaussians: Gaussians, n: int) -> Ellipsoid:
    """Return the unit quaternion, 1 / length of the stored one, the rotation and the standard deviations."""
    w, x, y, z, shrink = _unit_quat(gaussians.quats, n)
    return (w, x, y, z), shrink, _rotation(w, x, y, z), _deviations(gaussians.scales, n)


@_helper
def _image_axes(p: Vector, q: Vector, R: Matrix, s: Vector) -> tuple[Vector, Vector]:
    """Return the rows of W, given those of J Rc."""
    return _scaled(_times(p, R), s), _scaled(_times(q, R), s)


@_helper
def _in_image(
    gaussians: Gaussians, projection: Projection, pose: tuple[Matrix, Vector], frustum: Bounds, n: int
) -> tuple[Vector, Jacobian, tuple[Vector, Vector], Ellipsoid, tuple[Vector, Vector]]:
    """Return a Gaussian's position, J, the rows of J Rc, the ellipsoid, and the rows of W."""
    position = _in_camera(pose, _load(gaussians.means, n))
    clamped_x, clamped_y = _clamped(position[0], position[1], frustum)
    J = _jacobian(projection.K, clamped_x, clamped_y, position[2])
    p, q = _image_rows(J, pose[0])
    ellipsoid = _ellipsoid(gaussians, n)
    return position, J, (p, q), ellipsoid, _image_axes(p, q, ellipsoid[2], ellipsoid[3])


@_helper
def _overlaps(centre: float, half: float, side: int) -> bool:
    """Return whether the interval of half length ``half`` around ``centre`` overlaps that from 0 to ``side``."""
    return centre + half > 0 and centre - half < side


@compiled(int64(GAUSSIANS, PROJECTION, int64, int64, FOOTPRINTS))
def project(gaussians: Gaussians, projection: Projection, first: int, last: int, found: Footprints) -> int:
    """Find the footprints of the Gaussians ``first`` to ``last`` (exclusive) that touch the image. They are written
    from row ``first`` on, without colours; their number is returned."""
    K, width, height, dilation = projection.K, projection.width, projection.height, projection.dilation
    alpha_min, records = projection.alpha_min, found.records
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    pose, frustum = _pose(projection.viewmat), _frustum(projection)
    most = -2.001 * np.log(alpha_min)  # of 2 tau, for an opacity of 1
    row = first
    for n in range(first, last):
        x, y, z = _in_camera(pose, _load(gaussians.means, n))
        if not (z >= projection.near and z <= projection.far):
            continue
        centre_x, centre_y = fx * x + cx, fy * y + cy
        clamped_x, clamped_y = _clamped(x, y, frustum)
        if not (0 <= centre_x <= width and 0 <= centre_y <= height):
            # Most Gaussians outside the image are far from it: a bound on the footprint's size needs less arithmetic.
            scales = gaussians.scales
            angle = np.exp(np.float64(max(scales[n, 0], scales[n, 1], scales[n, 2]))) / z
            far_x = _is_far_outside(centre_x, width, fx * angle, clamped_x, most, dilation)
            if far_x or _is_far_outside(centre_y, height, fy * angle, clamped_y, most, dilation):
                continue
        opacity = 1.0 / (1.0 + np.exp(-np.float64(gaussians.opacities[n])))
        if not opacity >= alpha_min:
            continue
        p, q = _image_rows(_jacobian(K, clamped_x, clamped_y, z), pose[0])
        _, _, R, s = _ellipsoid(gaussians, n)
        w, v = _image_axes(p, q, R, s)
        if projection.antialiased:
            opacity *= _compensation(w, v, dilation)
            if not opacity >= alpha_min:
                continue
        tau = np.log(opacity / alpha_min)
        half_width, half_height = np.sqrt(2 * tau * (_dot(w, w) + dilation)), np.sqrt(2 * tau * (_dot(v, v) + dilation))
        if not (_overlaps(centre_x, half_width, width) and _overlaps(centre_y, half_height, height)):
            continue
        found.visible[row], found.depths[row] = n, z
        records[row, 0], records[row, 1] = centre_x, centre_y
        records[row, 2], records[row, 3], records[row, 4] = _cholesky(w, v, dilation)
        records[row, 5], records[row, 9], records[row, 10] = opacity, tau, half_height
        row += 1
    return row - first


# Gradients by the parameters of Gaussians.


@_helper
def _by_axes(
    sums: np.ndarray, w: Vector, v: Vector, dilation: float, antialiased: bool, v_scales: np.ndarray, i: int
) -> tuple[Vector, Vector]:
    """Return the gradients by the rows of W; write those by the log-scales of row ``i``. By W: -4 Lᵀ S L W, S = (Σ uu,
    Σ uv; Σ uv, Σ vv); the derivative of a scale by its logarithm is the scale."""
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
def _by_position(
    K: np.ndarray,
    rotation: Matrix,
    frustum: Bounds,
    position: Vector,
    J: Jacobian,
    by_centre: tuple[float, float],
    by_rows: tuple[Vector, Vector],
) -> Vector:
    """Return the gradient by the mean: through the centre, through J, and through the x/z and y/z of J if not clamped.
    ``position``: x/z, y/z and z; ``by_rows``: gradients by the rows of J Rc."""
    (left, right, top, bottom), (x, y, z), (jx, jxz, jy, jyz) = frustum, position, J
    by_p, by_q = by_rows
    by_jx, by_jxz = _dot(by_p, rotation[0]), _dot(by_p, rotation[2])
    by_jy, by_jyz = _dot(by_q, rotation[1]), _dot(by_q, rotation[2])
    by_ratio_x = by_centre[0] * K[0, 0] - (by_jxz * jx if left < x < right else 0.0)
    by_ratio_y = by_centre[1] * K[1, 1] - (by_jyz * jy if top < y < bottom else 0.0)
    by_z = -(by_jx * jx + by_jxz * jxz + by_jy * jy + by_jyz * jyz + by_ratio_x * x + by_ratio_y * y) / z
    return _times((by_ratio_x / z, by_ratio_y / z, by_z), rotation)


@compiled(void(FRAME, SLOTS, float32[:, ::1], int32[::1], int64, int64, int32[::1], GAUSSIANS, float64[:, ::1]))
def project_backward(
    frame: Frame,
    slots: Slots,
    v_slots: np.ndarray,
    changed: np.ndarray,
    first: int,
    last: int,
    indices: np.ndarray,
    gradients: Gaussians,
    v_colors: np.ndarray,
) -> None:
    """Compute the gradients of the footprints ``changed[first:last]`` from those of ``blending.blend_backward``. Writes
    their Gaussians, ``indices``; the gradients by these, all but those by SH; and, ``(R, 3)``, those by the colours
    before they are clamped."""
    gaussians, projection, footprints = frame.gaussians, frame.projection, frame.footprints
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

        position, J, (p, q), (quat, shrink, R, s), (w, v) = _in_image(gaussians, projection, pose, frustum, n)
        by_w, by_v = _by_axes(sums, w, v, projection.dilation, projection.antialiased, gradients.scales, i)
        by_w, by_v = _scaled(by_w, s), _scaled(by_v, s)
        by_rotation = _mix(p[0], by_w, q[0], by_v), _mix(p[1], by_w, q[1], by_v), _mix(p[2], by_w, q[2], by_v)
        by_quat = _by_quat(quat, by_rotation)
        for c in range(4):
            gradients.quats[i, c] = by_quat[c] * shrink
        l0, l1, l2 = _cholesky(w, v, projection.dilation)
        by_centre = -2 * l0 * sums[1], -2 * (l1 * sums[1] + l2 * sums[2])  # -2 Lᵀ (Σ u, Σ v)
        by_rows = _applied(R, by_w), _applied(R, by_v)
        by_mean = _by_position(projection.K, pose[0], frustum, position, J, by_centre, by_rows)
        gradients.means[i, 0], gradients.means[i, 1], gradients.means[i, 2] = by_mean


@compiled(void(FRAME, SLOTS, int64, int64, float32[:, ::1], float32[:, ::1]))
def add_colors(frame: Frame, slots: Slots, first: int, last: int, v_slots: np.ndarray, v_colors: np.ndarray) -> None:
    """Add the gradients by ``sh0``, given those of ``blending.blend_colors_backward``, of ``slots.rows[first:last]``.
    Colours that are clamped to 0 have no gradient."""
    for i in range(first, last):
        row = slots.rows[i]
        for c in range(3):
            if frame.footprints.records[row, 6 + c] > 0:
                total = np.float32(0)
                for slot in range(slots.first[row], slots.first[row + 1]):
                    total += v_slots[slot, c]
                v_colors[frame.footprints.visible[row], c] += np.float32(0.28209479177387814) * total
