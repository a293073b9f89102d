"""Merging: two neighbouring Gaussians become one with their mean, covariance, colour and opacity, again and again."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numba import njit

from kissgs.core.array_types import Bool, Float32, Float64, Int32, Int64
from kissgs.core.context import DEFAULT_CONTEXT, Context, Workers
from kissgs.core.numba_kernels import compiled
from kissgs.core.splats import LOG_SCALE_LIMIT, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN, Splats, blocks
from kissgs.rendering.cpu.neighbours import SEARCH_LEAF, leaves_of, nearest_neighbours, unique_pairs
from kissgs.rendering.cpu.tiles import each_part, even


@compiled("void(float32[:, ::1], float32[:, ::1], int64, int64, float64[:, ::1])")
def covariances_of(quats: np.ndarray, scales: np.ndarray, first: int, last: int, out: np.ndarray) -> None:
    """Compute the covariances (xx, xy, xz, yy, yz, zz) of rows ``first`` to ``last`` (exclusive). Quaternions are w, x,
    y, z of unit length; scales are natural logarithms of standard deviations."""
    turn = np.empty((3, 3))
    for n in range(first, last):
        w, x, y, z = np.float64(quats[n, 0]), np.float64(quats[n, 1]), np.float64(quats[n, 2]), np.float64(quats[n, 3])
        turn[0, 0], turn[0, 1], turn[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        turn[1, 0], turn[1, 1], turn[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        turn[2, 0], turn[2, 1], turn[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        at = 0
        for a in range(3):
            for b in range(a, 3):
                total = 0.0
                for c in range(3):
                    total += turn[a, c] * turn[b, c] * math.exp(2 * np.float64(scales[n, c]))
                out[n, at] = total
                at += 1


@njit(nogil=True, error_model="numpy")
def _rotate(matrix: np.ndarray, turn: np.ndarray, a: int, b: int) -> None:
    """Make an off-diagonal element of a symmetric matrix zero by a rotation, which ``turn`` takes part in."""
    off = matrix[a, b]
    if abs(off) <= 1e-17 * math.sqrt(abs(matrix[a, a])) * math.sqrt(abs(matrix[b, b])):
        return
    ratio = (matrix[b, b] - matrix[a, a]) / (2 * off)
    tangent = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + math.sqrt(ratio * ratio + 1))
    cosine = 1 / math.sqrt(tangent * tangent + 1)
    sine = tangent * cosine
    for c in range(3):
        u, v = matrix[c, a], matrix[c, b]
        matrix[c, a], matrix[c, b] = cosine * u - sine * v, sine * u + cosine * v
    for c in range(3):
        u, v = matrix[a, c], matrix[b, c]
        matrix[a, c], matrix[b, c] = cosine * u - sine * v, sine * u + cosine * v
        u, v = turn[c, a], turn[c, b]
        turn[c, a], turn[c, b] = cosine * u - sine * v, sine * u + cosine * v


@njit(nogil=True, error_model="numpy")
def _quaternion(turn: np.ndarray, out: np.ndarray) -> None:
    """Convert a rotation matrix to a unit quaternion, by its largest component."""
    xx, yy, zz = turn[0, 0], turn[1, 1], turn[2, 2]
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    largest = 0
    for c in range(1, 4):
        if squares[c] > squares[largest]:
            largest = c
    double = 2 * math.sqrt(squares[largest])
    w = (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    xy, xz, yz = turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1]
    if largest == 0:
        parts = (double * double / 4, w[0], w[1], w[2])
    elif largest == 1:
        parts = (w[0], double * double / 4, xy, xz)
    elif largest == 2:
        parts = (w[1], xy, double * double / 4, yz)
    else:
        parts = (w[2], xz, yz, double * double / 4)
    for c in range(4):
        out[c] = parts[c] / double


@compiled("void(float64[:, ::1], int64[::1], int64, int64, float32[:, ::1], float32[:, ::1])")
def decompose(
    covariances: np.ndarray, rows: np.ndarray, first: int, last: int, quats: np.ndarray, scales: np.ndarray
) -> None:
    """Compute rotation and log-scales of covariances by Jacobi's method, ``rows[first:last]``. Scales of less than 1e-7
    of the largest one are lost in rounding."""
    matrix, turn = np.empty((3, 3)), np.empty((3, 3))
    for at in range(first, last):
        n, from_ = rows[at], 0
        for a in range(3):
            for b in range(a, 3):
                matrix[a, b] = matrix[b, a] = covariances[n, from_]
                turn[a, b] = turn[b, a] = 1.0 if a == b else 0.0
                from_ += 1
        for _ in range(12):
            for a in range(2):
                for b in range(a + 1, 3):
                    _rotate(matrix, turn, a, b)
        largest = max(matrix[0, 0], matrix[1, 1], matrix[2, 2])
        for c in range(3):
            scales[n, c] = 0.5 * math.log(max(matrix[c, c], 1e-14 * largest))
        _quaternion(turn, quats[n])


# Numba kernels of merging: moments, opacity and error of two Gaussians that become one.
#
# An image of a Gaussian is taken as ``alpha exp(-x' C^-1 x / 2)``, C being its covariance along one of the three axes
# of the world, plus the variance of a blur. Integrals of products of two such images have a closed form.


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
    """Return the integrals of the products of a and b, and of all three images, over 2 pi. Images have peak 1; ``a`` is
    at the origin, others at (x, y)."""
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
    """Return opacity and error of the joint Gaussian, sums over images along the three axes. With the opacity, 1e-6 to
    1 - 1e-6, it is nearest, in least squares, to the alpha ``a + b - a b`` of both together. The error is the squared
    error, world units squared, of an image of it instead of both, whose alphas are ``a (1 - b / 2)`` and ``b (1 - a /
    2)``: the mean of both orders of depth. ``color_ii``, ``color_jj`` and ``color_ij`` are squares and product of the
    colour differences of ``i`` and ``j`` from the joint colour, sums over RGB; ``contrast`` is the squared contrast to
    what is behind."""
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
    """Compute each Gaussian's opacity times its area, the mean over the three axes, into ``weights``, ``(N,)``."""
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
    """Compute what the error grows by if each pair merges, pairs ``first`` to ``last`` (exclusive), into ``added``.
    Errors of repeated merges are alike: their amplitudes add. The mean over all directions of a squared colour
    difference is the sum of squared differences of the SH coefficients, divided by 4 pi. ``blur`` is in units of
    ``spacing``, the squared distances to neighbours; ``contrast`` is the squared one to what is behind, over RGB."""
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
    """Choose pairs in this order of which no two share a Gaussian, until ``chosen`` is full; return their number."""
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


# No image is rendered. What a merge costs is the squared error of its image, in closed form;
# the cheapest pairs merge first.

NEIGHBOURS = 8  # number of nearest neighbours that a Gaussian may merge with
SPACING_RANK = 3  # neighbour, from 0, whose distance is the spacing of the Gaussians
BLUR = 0.01  # variance of the blur of compared images, squared spacings: viewers do not stand nearer
CONTRAST = 0.09  # squared contrast of Gaussians to what is behind them, a sum over RGB in [0, 1]
LARGEST_STEP = 0.3  # largest share of the Gaussians that disappears before neighbours and errors are computed anew


def merge_gaussians(
    splats: Splats, count: int, context: Context = DEFAULT_CONTEXT
) -> tuple[Splats, Int64[np.ndarray, " M"]]:
    """Reduce a scene to ``count`` Gaussians by merging. Merged Gaussians keep mean, covariance and mean colour of the
    mixture, weighted by opacity times area, and get the opacity that is nearest to the alpha of both together.
    Gaussians that are not merged stay exactly as they are. Returns the scene, and of each of its Gaussians the index of
    the heaviest among those it stands for, ascending."""
    with Workers(context.threads) as pool:
        clusters = _Clusters(splats, pool)
        for left in clusters.reduce(count):
            context.progress("merge", 1 - np.log(left / count) / np.log(len(splats) / count))
        context.progress("merge", 1.0)
        return clusters.splats()


def merged_levels(splats: Splats, counts: Sequence[int], *, threads: int = 0) -> list[Splats]:
    """Reduce a scene to each of ``counts``, which descend, each result by merging the one before further. Arguments and
    results are those of :func:`merge_gaussians`."""
    with Workers(threads) as pool:
        clusters, levels = _Clusters(splats, pool), []
        for count in counts:
            for _ in clusters.reduce(count):
                pass
            levels.append(clusters.splats()[0])
        return levels


class _Clusters:
    """The Gaussians that are left, each of which stands for one or more of the input. Neighbours have rows near each
    other, which processors read faster."""

    def __init__(self, source: Splats, pool: Workers) -> None:
        count, self.source, self.pool = len(source), source, pool
        self.origin: Int32[np.ndarray, " M"] = leaves_of(source.means, SEARCH_LEAF)[0]  # the heaviest member
        self.means: Float64[np.ndarray, "M 3"] = source.means[self.origin].astype(np.float64)
        self.covariances: Float64[np.ndarray, "M 6"] = np.empty((count, 6))  # xx, xy, xz, yy, yz, zz
        quats, scales = source.quats[self.origin], source.scales[self.origin]
        self._each(count, lambda a, b: covariances_of(quats, scales, a, b, self.covariances))
        self.alphas: Float64[np.ndarray, " M"] = 1 / (1 + np.exp(-source.opacities[self.origin].astype(np.float64)))
        # SH coefficients, those of sh0 first
        self.colors: Float32[np.ndarray, "M F"] = np.empty((count, 3 + 3 * source.shN.shape[1]), np.float32)
        self.colors[:, :3] = source.sh0[self.origin]
        for rows in blocks(count):
            some = self.origin[rows]
            self.colors[rows, 3:] = source.shN[some].reshape(len(some), -1)
        self.errors: Float64[np.ndarray, " M"] = np.zeros(count)  # that merges have caused, see pair_errors
        self.heaviest: Float64[np.ndarray, " M"] = np.zeros(count)  # weight of the heaviest member
        self.merged: Bool[np.ndarray, " M"] = np.zeros(count, bool)  # whether it stands for several

    def reduce(self, count: int) -> Iterator[int]:
        """Merge until ``count`` Gaussians are left; before each round, yield how many there are."""
        while len(self.means) > count:
            left = len(self.means)
            yield left
            self._merge(min(left - count, max(1, int(left * LARGEST_STEP))))

    def _merge(self, disappearing: int) -> None:
        """Merge the pairs that add the least error until this many Gaussians disappear, or fewer if pairs run out."""
        count, weights = len(self.means), np.empty(len(self.means))
        neighbours = min(NEIGHBOURS, count - 1)
        near, spacing = nearest_neighbours(self.means, neighbours, min(SPACING_RANK, neighbours - 1), self.pool)
        self._each(count, lambda a, b: opacity_areas(self.covariances, self.alphas, spacing, BLUR, a, b, weights))
        self.heaviest = np.where(self.merged, self.heaviest, weights)
        joined, added = self._cheapest_pairs(near, weights, spacing, disappearing)
        del near
        self._each(
            len(joined),
            lambda a, b: merge(
                self.means, self.covariances, self.alphas, self.colors, weights, spacing, BLUR, joined, a, b
            ),
        )
        self._drop(joined, added)

    def _cheapest_pairs(
        self,
        near: Int32[np.ndarray, "M K"],
        weights: Float64[np.ndarray, " M"],
        spacing: Float64[np.ndarray, " M"],
        count: int,
    ) -> tuple[Int32[np.ndarray, "P 2"], Float64[np.ndarray, " P"]]:
        """Return at most ``count`` pairs of which no two share a Gaussian, and the error that each adds."""
        pairs = np.empty((near.size, 2), np.int32)
        pairs = pairs[: unique_pairs(near, pairs)]
        added = np.empty(len(pairs))
        gaussians = self.means, self.covariances, self.alphas, self.colors, weights, spacing
        self._each(len(pairs), lambda a, b: pair_errors(*gaussians, self.errors, BLUR, CONTRAST, pairs, a, b, added))
        chosen = np.empty(count, np.int64)
        order = np.argsort(added, kind="stable")
        chosen = chosen[: choose(order, pairs, len(self.means), chosen)]
        return np.ascontiguousarray(pairs[chosen]), added[chosen]

    def _drop(self, joined: Int32[np.ndarray, "P 2"], added: Float64[np.ndarray, " P"]) -> None:
        """Remove the second of each pair; the first stands for both."""
        kept, dropped = joined.T
        second = self.heaviest[dropped] > self.heaviest[kept]
        self.origin[kept] = np.where(second, self.origin[dropped], self.origin[kept])
        self.heaviest[kept] = np.maximum(self.heaviest[dropped], self.heaviest[kept])
        self.errors[kept] += self.errors[dropped] + added
        self.merged[kept] = True
        left = np.ones(len(self.means), bool)
        left[dropped] = False
        for name in ("means", "covariances", "alphas", "errors", "origin", "heaviest", "merged"):
            setattr(self, name, getattr(self, name)[left])
        rows = np.flatnonzero(left)
        for some in blocks(len(rows)):  # in place: the colours are most of the memory
            self.colors[some] = self.colors[rows[some]]
        self.colors = self.colors[: len(rows)]

    def _each(self, count: int, kernel: Callable[[int, int], None]) -> None:
        """Call a kernel with the first and last row of each part, in threads."""
        each_part(kernel, even(count, self.pool), self.pool)

    def splats(self) -> tuple[Splats, Int64[np.ndarray, " M"]]:
        """Return the scene and the indices in the input, ascending."""
        order = np.argsort(self.origin)
        index = self.origin[order].astype(np.int64)
        kept = self.source.select(index)
        places = np.flatnonzero(self.merged[order])
        rows = order[places]
        quats, scales = np.empty((len(order), 4), np.float32), np.empty((len(order), 3), np.float32)
        self._each(len(rows), lambda a, b: decompose(self.covariances, rows, a, b, quats, scales))
        kept.quats[places], alphas = quats[rows], self.alphas[rows]
        kept.scales[places] = np.clip(scales[rows], -LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)  # what was far apart is larger
        kept.means[places] = self.means[rows]
        kept.opacities[places] = np.clip(np.log(alphas / (1 - alphas)), OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX)
        kept.sh0[places] = self.colors[rows, :3]
        kept.shN[places] = self.colors[rows, 3:].reshape(len(rows), kept.shN.shape[1], 3)
        return kept, index
