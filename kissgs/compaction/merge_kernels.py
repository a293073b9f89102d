"""Numba kernels of merging: moments, opacity and error of two Gaussians that become one.

An image of a Gaussian is taken as ``alpha exp(-x' C^-1 x / 2)``, C being its covariance along one of the three axes of
the world, plus the variance of a blur. Integrals of products of two such images have a closed form.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled


@njit(nogil=True, error_model="numpy")
def _image(covariance: np.ndarray, axis: int, blur: float) -> tuple[float, float, float, float]:
    """Return xx, xy, yy and the determinant of a covariance's image along an axis; the determinant is positive."""
    if axis == 0:
        xx, xy, yy = covariance[3], covariance[4], covariance[5]
    elif axis == 1:
        xx, xy, yy = covariance[0], covariance[2], covariance[5]
    else:
        xx, xy, yy = covariance[0], covariance[1], covariance[3]
    xx, yy = xx + blur, yy + blur
    return xx, xy, yy, max(xx * yy - xy * xy, 1e-12 * xx * yy)  # rounding leaves nothing of a needle's


@njit(nogil=True, error_model="numpy")
def _squared_distance(xx: float, xy: float, yy: float, determinant: float, dx: float, dy: float) -> float:
    """Return the squared Mahalanobis distance; rounding would make that of a needle negative."""
    return max((yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / determinant, 0.0)


@njit(nogil=True, error_model="numpy")
def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float], dx: float, dy: float) -> float:
    """Return the integral of the product of two images of peak 1 whose centres differ by (dx, dy), over 2 pi."""
    xx, xy, yy = a[0] + b[0], a[1] + b[1], a[2] + b[2]
    determinant = max(xx * yy - xy * xy, 1e-12 * xx * yy)
    distance = _squared_distance(xx, xy, yy, determinant, dx, dy)
    return math.sqrt(a[3]) * math.sqrt(b[3] / determinant) * math.exp(-0.5 * distance)


@njit(nogil=True, error_model="numpy")
def _overlaps(
    a: tuple[float, float, float, float],
    b: tuple[float, float, float, float],
    joint: tuple[float, float, float, float],
    bx: float,
    by: float,
    jx: float,
    jy: float,
) -> tuple[float, float]:
    """Return the integrals of the products of a and b, and of all three images, over 2 pi.

    Images have peak 1; ``a`` is at the origin, others at (x, y).
    """
    xx, xy, yy = a[0] + b[0], a[1] + b[1], a[2] + b[2]
    determinant = max(xx * yy - xy * xy, 1e-12 * xx * yy)
    height = math.exp(-0.5 * _squared_distance(xx, xy, yy, determinant, bx, by))
    if height == 0:
        return 0.0, 0.0
    # The product of a and b is a Gaussian: gain G = a (a + b)^-1, centre G b, covariance a - G a.
    g00, g01 = (a[0] * yy - a[1] * xy) / determinant, (a[1] * xx - a[0] * xy) / determinant
    g10, g11 = (a[1] * yy - a[2] * xy) / determinant, (a[2] * xx - a[1] * xy) / determinant
    pxx = max(a[0] - (g00 * a[0] + g01 * a[1]), 1e-12 * a[0])
    pyy = max(a[2] - (g10 * a[1] + g11 * a[2]), 1e-12 * a[2])
    pxy = a[1] - (g00 * a[1] + g01 * a[2])
    product = pxx, pxy, pyy, max(pxx * pyy - pxy * pxy, 1e-12 * pxx * pyy)
    two = math.sqrt(a[3]) * math.sqrt(b[3] / determinant) * height
    return two, height * _overlap(product, joint, g00 * bx + g01 * by - jx, g10 * bx + g11 * by - jy)


@njit(nogil=True, error_model="numpy")
def _join(
    i: int, j: int, means: np.ndarray, covariances: np.ndarray, weights: np.ndarray, mean: np.ndarray, out: np.ndarray
) -> float:
    """Compute mean and covariance of a mixture of two Gaussians; return the share of ``i`` in it."""
    share = weights[i] / (weights[i] + weights[j])
    at = 0
    for a in range(3):
        da = means[i, a] - means[j, a]
        mean[a] = means[j, a] + share * da
        for b in range(a, 3):
            between = share * (1 - share) * da * (means[i, b] - means[j, b])
            out[at] = share * covariances[i, at] + (1 - share) * covariances[j, at] + between
            at += 1
    return share


@njit(nogil=True, error_model="numpy")
def _fit(
    i: int,
    j: int,
    means: np.ndarray,
    covariances: np.ndarray,
    alphas: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    blur: float,
    color_ii: float,
    color_jj: float,
    color_ij: float,
    contrast: float,
) -> tuple[float, float]:
    """Return opacity and error of the joint Gaussian, sums over images along the three axes.

    With the opacity, 1e-6 to 1 - 1e-6, it is nearest, in least squares, to the alpha ``a + b - a b`` of both together.
    The error is the squared error, world units squared, of an image of it instead of both, whose alphas are
    ``a (1 - b / 2)`` and ``b (1 - a / 2)``: the mean of both orders of depth. ``color_ii``, ``color_jj`` and
    ``color_ij`` are squares and product of the colour differences of ``i`` and ``j`` from the joint colour, sums over
    RGB; ``contrast`` is the squared contrast to what is behind.
    """
    alpha_i, alpha_j = alphas[i], alphas[j]
    aa = bb = ab = aab = abb = aabb = joint_ab = square = 0.0
    for axis in range(3):
        x, y = (1, 2) if axis == 0 else (0, 2 if axis == 1 else 1)
        joint = _image(covariance, axis, blur)
        a, b = _image(covariances[i], axis, blur), _image(covariances[j], axis, blur)
        ax, ay = means[i, x] - mean[x], means[i, y] - mean[y]
        bx, by = means[j, x] - mean[x], means[j, y] - mean[y]
        dx, dy = bx - ax, by - ay
        a_squared, b_squared = (a[0] / 2, a[1] / 2, a[2] / 2, a[3] / 4), (b[0] / 2, b[1] / 2, b[2] / 2, b[3] / 4)
        aa, bb, square = aa + math.sqrt(a[3]) / 2, bb + math.sqrt(b[3]) / 2, square + math.sqrt(joint[3]) / 2
        aab, abb = aab + _overlap(a_squared, b, dx, dy), abb + _overlap(a, b_squared, dx, dy)
        aabb += _overlap(a_squared, b_squared, dx, dy)
        of_two, of_three = _overlaps(a, b, joint, dx, dy, -ax, -ay)
        ab += of_two
        joint_ab += alpha_i * _overlap(a, joint, ax, ay) + alpha_j * _overlap(b, joint, bx, by)
        joint_ab -= alpha_i * alpha_j * of_three
    # Names list the factors of an integral over 2 pi: aab is that of a a b. A square's image has half the covariance.
    aa, bb, ab = alpha_i**2 * aa, alpha_j**2 * bb, alpha_i * alpha_j * ab
    aab, abb, aabb = alpha_i**2 * alpha_j * aab, alpha_i * alpha_j**2 * abb, (alpha_i * alpha_j) ** 2 * aabb
    alpha = min(max(joint_ab / square, 1e-6), 1 - 1e-6)
    error = color_ii * (aa - aab + aabb / 4) + color_jj * (bb - abb + aabb / 4)
    error += 2 * color_ij * (ab - (aab + abb) / 2 + aabb / 4)
    error += contrast * (aa + bb + 2 * ab - 2 * (aab + abb) + aabb + alpha * (alpha * square - 2 * joint_ab))
    return alpha, max(2 * math.pi * error, 0.0)


@compiled("void(float64[:, ::1], float64[::1], float64[::1], float64, int64, int64, float64[::1])")
def opacity_areas(
    covariances: np.ndarray,
    alphas: np.ndarray,
    spacing: np.ndarray,
    blur: float,
    first: int,
    last: int,
    weights: np.ndarray,
) -> None:
    """Compute each Gaussian's opacity times its area, the mean over the three axes, into ``weights``, ``(N,)``.

    Args:
        covariances: ``(N, 6)``.
        alphas: ``(N,)`` opacities.
        spacing: ``(N,)`` squared distances to neighbours.
        blur: variance of the blur in units of ``spacing``.
        first: first row.
        last: end of the rows, exclusive.
        weights: out.
    """
    for n in range(first, last):
        area = 0.0
        for axis in range(3):
            area += math.sqrt(_image(covariances[n], axis, blur * spacing[n])[3])
        weights[n] = alphas[n] * area


@compiled(
    "void(float64[:, ::1], float64[:, ::1], float64[::1], float32[:, ::1], float64[::1], float64[::1], float64[::1], "
    "float64, float64, int32[:, ::1], int64, int64, float64[::1])"
)
def pair_errors(
    means: np.ndarray,
    covariances: np.ndarray,
    alphas: np.ndarray,
    colors: np.ndarray,
    weights: np.ndarray,
    spacing: np.ndarray,
    errors: np.ndarray,
    blur: float,
    contrast: float,
    pairs: np.ndarray,
    first: int,
    last: int,
    added: np.ndarray,
) -> None:
    """Compute the errors that merging each pair would cause, pairs ``first`` to ``last`` (exclusive).

    Args:
        means: ``(N, 3)``.
        covariances: ``(N, 6)``.
        alphas: ``(N,)`` opacities.
        colors: ``(N, F)`` SH coefficients. The mean over all directions of a squared colour difference is the sum of
            squared differences of the coefficients, divided by 4 pi.
        weights: ``(N,)``, see :func:`opacity_areas`.
        spacing: ``(N,)`` squared distances to neighbours.
        errors: ``(N,)`` errors that earlier merges have caused.
        blur: variance of the blur in units of ``spacing``.
        contrast: squared contrast to what is behind, a sum over RGB.
        pairs: ``(P, 2)`` indices.
        first: first pair.
        last: end of the pairs, exclusive.
        added: out, ``(P,)`` what the error grows by. Errors of repeated merges are alike: their amplitudes add.
    """
    mean, covariance = np.empty(3), np.empty(6)
    for at in range(first, last):
        i, j = pairs[at, 0], pairs[at, 1]
        width = blur * 0.5 * (spacing[i] + spacing[j])
        share = _join(i, j, means, covariances, weights, mean, covariance)
        difference = 0.0
        for c in range(colors.shape[1]):
            difference += (np.float64(colors[i, c]) - np.float64(colors[j, c])) ** 2
        difference /= 4 * math.pi
        color_ii, color_jj = (1 - share) ** 2 * difference, share**2 * difference
        color_ij = -share * (1 - share) * difference
        _, error = _fit(
            i, j, means, covariances, alphas, mean, covariance, width, color_ii, color_jj, color_ij, contrast
        )
        before = errors[i] + errors[j]
        added[at] = error + 2 * math.sqrt(error * before)


@compiled("int64(int64[::1], int32[:, ::1], int64, int64[::1])")
def choose(order: np.ndarray, pairs: np.ndarray, count: int, chosen: np.ndarray) -> int:
    """Choose pairs in this order of which no two share a Gaussian, until ``chosen`` is full; return their number.

    Args:
        order: ``(P,)`` indices of pairs.
        pairs: ``(P, 2)`` indices of Gaussians.
        count: number of Gaussians.
        chosen: out, indices of the pairs.
    """
    used, found = np.zeros(count, np.bool_), 0
    for at in order:
        i, j = pairs[at, 0], pairs[at, 1]
        if not (used[i] or used[j]):
            used[i] = used[j] = True
            chosen[found] = at
            found += 1
            if found == chosen.shape[0]:
                break
    return found


@compiled(
    "void(float64[:, ::1], float64[:, ::1], float64[::1], float32[:, ::1], float64[::1], float64[::1], float64, "
    "int32[:, ::1], int64, int64)"
)
def merge(
    means: np.ndarray,
    covariances: np.ndarray,
    alphas: np.ndarray,
    colors: np.ndarray,
    weights: np.ndarray,
    spacing: np.ndarray,
    blur: float,
    pairs: np.ndarray,
    first: int,
    last: int,
) -> None:
    """Merge pairs ``first`` to ``last`` (exclusive) into the row of the first of each; see :func:`pair_errors`."""
    mean, covariance = np.empty(3), np.empty(6)
    for at in range(first, last):
        i, j = pairs[at, 0], pairs[at, 1]
        share = _join(i, j, means, covariances, weights, mean, covariance)
        width = blur * 0.5 * (spacing[i] + spacing[j])
        alphas[i], _ = _fit(i, j, means, covariances, alphas, mean, covariance, width, 0.0, 0.0, 0.0, 0.0)
        means[i], covariances[i] = mean, covariance
        for c in range(colors.shape[1]):
            colors[i, c] = share * colors[i, c] + (1 - share) * colors[j, c]
