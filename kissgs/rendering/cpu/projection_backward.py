"""Numba kernel of the backward pass of projection: gradients by the parameters of Gaussians.

Arithmetic is that of :mod:`kissgs.rendering.cpu.projection`.
"""

from __future__ import annotations

import numpy as np

from kissgs.core.numba_kernels import compiled
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
        v_slots: output of :func:`kissgs.rendering.cpu.blending_backward.blend_backward`.
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
