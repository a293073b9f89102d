"""Coverage and sensitivity of a scene: how well cameras see each Gaussian, and what its errors cost in images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, Workers, return_free_memory, silent
from kissgs.core.errors import InvalidViewsError
from kissgs.core.sensitivity import LARGEST, OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import SH_C0, Splats, blocks
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.tiles import each_part, even

if TYPE_CHECKING:
    from kissgs.rendering.cpu.records import Frame


LEAF = 512  # largest number of Gaussians in a leaf of the tree, among which neighbours are searched


def local_scale(splats: Splats, *, threads: int = 0) -> Float32[np.ndarray, " N"]:
    """Return the distance from each Gaussian to about its 128th neighbour, at least its own size, world units.
    Distances are measured within the leaves of a k-d tree of equal counts, which adapts to parts of any size. For an
    object of fewer Gaussians, the distance is extrapolated as if its surface continued."""
    from kissgs.rendering.cpu.neighbours import leaf_scales, leaves_of

    means, found = np.array(splats.means, order="C"), np.empty(len(splats), np.float32)
    order, edges = leaves_of(means, LEAF)
    with Workers(threads) as pool:
        leaves = even(len(edges) - 1, pool)
        each_part(lambda first, last: leaf_scales(means, order, edges, first, last, found), leaves, pool)
    sizes = np.exp(np.median(splats.scales, axis=1))
    least = np.maximum(1e-6 * np.abs(splats.means).max(axis=1, initial=0), 1e-12)  # about float32's resolution
    return np.maximum(np.maximum(found, sizes), least).astype(np.float32)


# Coverage: how well the best camera has seen each Gaussian, by visibility and resolution.

RESOLVED = 3.0  # length in the image of the distance to the 128th neighbour, pixels, that is resolved
# A Gaussian whose neighbours are more than ISOLATED times its size away counts as an object of its own, which is viewed
# from up to MAX_APPROACH times nearer.
ISOLATED, MAX_APPROACH = 16.0, 3.0


class Coverage:
    """The best coverage of each Gaussian over the images added so far."""

    def __init__(self, splats: Splats) -> None:
        self._splats = splats
        self._scale = local_scale(splats)
        # From 0, seen by no camera or only from far away, to 1, seen from nearby.
        self.share: Float32[np.ndarray, " N"] = np.zeros(len(splats), np.float32)

    @property
    def close_up(self) -> Float32[np.ndarray, " N"]:
        """``(N,)`` mean squared alpha, 0 to 1, of each Gaussian in an unobstructed image that its surroundings fill."""
        found = np.empty(len(self._scale), np.float32)
        for rows in blocks(len(found)):
            logs = np.sort(self._splats.scales[rows], axis=1)[:, 1:].astype(np.float64)
            scale = self._scale[rows].astype(np.float64)
            near = np.maximum(np.minimum(scale, ISOLATED * np.exp(logs[:, 0])), scale / MAX_APPROACH)
            area = np.pi * np.exp(logs.sum(axis=1)) / near**2
            opacity = 1 / (1 + np.exp(-self._splats.opacities[rows].astype(np.float64)))
            found[rows] = opacity**2 * np.minimum(area, 1)
        return found

    def add(self, frame: Frame, seen: Float32[np.ndarray, " N"], pool: Workers, finer: float = 1.0) -> None:
        """Update the coverage by one rendered image. ``seen``: sum over pixels of (alpha T)² by row of the frame's
        footprints; ``finer``: ratio of the resolution of the image that this one is a thumbnail of to its own."""
        from kissgs.rendering.cpu.sensitivity import raise_coverage

        length, parts = RESOLVED / finer, frame.parts.tolist()
        pool.map(lambda part: raise_coverage(frame, self._scale, part[0], part[1], seen, length, self.share), parts)


# Measurement of the sensitivity of a scene, exactly to first order, with one backward pass per image.

HIDDEN = 0.003  # transmittance behind which a change has a hundred-thousandth of the squared error


@dataclass(frozen=True, slots=True, eq=False)
class WeightedCameras:
    """Cameras from which sensitivity is measured, with the weights of their images.

    Attributes:
        cameras: one or more, with the sizes of the images to render.
        weights: one for each camera, positive; they need not sum to 1.
        background: ``(3,)`` mean of the background, RGB from 0 to 1.
        spread: standard deviation of each channel of the background, which is unknown in general.
        captured: number of cameras of a capture, which come first.

    Raises:
        InvalidViewsError: no camera; another number of weights than of cameras; a weight that is not positive and
            finite; a spread that is negative or not finite.
    """

    cameras: Sequence[Camera]
    weights: Sequence[float]
    background: Float32[np.ndarray, "3"]
    spread: float = 0.25
    captured: int = 0

    def __post_init__(self) -> None:
        if not self.cameras or len(self.cameras) != len(self.weights):
            raise InvalidViewsError(
                f"sensitivity needs at least one camera and a weight for each, not {len(self.cameras)} cameras with "
                f"{len(self.weights)} weights"
            )
        if not all(0 < weight < math.inf for weight in self.weights) or not 0 <= self.spread < math.inf:
            raise InvalidViewsError(
                "weights of cameras must be positive and finite, and the spread finite and not negative"
            )

    def per_pixel(self) -> list[float]:
        """Return the weight of a single value of each image, such that the weighted sum of squared errors is a mean."""
        total = float(sum(self.weights))
        pixels = [3 * camera.width * camera.height for camera in self.cameras]
        return [weight / total / count for weight, count in zip(self.weights, pixels, strict=True)]


def measure_sensitivity(
    splats: Splats,
    cameras: WeightedCameras,
    *,
    view_uncertainty: float = 0.0,
    threads: int = 0,
    progress: Progress = silent,
) -> Sensitivity:
    """Measure the sensitivity of a scene: the Gauss-Newton Hessian of the squared image error, a block per Gaussian.

    The Hessian is J ᵀ J with J the derivative of the images, without sampling. Of a change of position, J omits the
    small effects on the footprint's shape (and so on the opacity's compensation in an antialiased scene), on the
    view-dependent colour and on the depth order. A Gaussian behind a
    transmittance of :data:`HIDDEN` counts as unseen in that pixel.

    Args:
        splats: a finite scene (:func:`kissgs.clean`).
        cameras: cameras and weights of the images.
        view_uncertainty: from 0 to 1, how strongly to shrink towards the prior for other cameras
            (:meth:`kissgs.Sensitivity.with_prior`).
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "sensitivity".

    Raises:
        UnsupportedError: an image would take too much memory.
    """
    from kissgs.rendering.cpu.frame import add_sensitivities, draw, for_kernels
    from kissgs.rendering.cpu.sensitivity import moments_to_hessians

    splats = for_kernels(splats)
    coverage = Coverage(splats)
    found = Sensitivity.none(len(splats), splats.sh_degree, captured=cameras.captured > 0)
    if not view_uncertainty:
        found.captured[:] = 1  # no other cameras count
    with Workers(threads) as pool:
        for done, (camera, weight) in enumerate(zip(cameras.cameras, cameras.per_pixel(), strict=True)):
            progress("sensitivity", done / len(cameras.cameras))
            frame = draw(splats, camera, cameras.background, pool, HIDDEN)
            coverage.add(frame, add_sensitivities(frame, weight, cameras.spread, found, pool), pool)
            if view_uncertainty and done + 1 == cameras.captured:
                found.captured[:] = coverage.share
            del frame  # before the next one is made
        shapes, parts = (splats.scales, splats.opacities), even(len(splats), pool)
        each_part(lambda a, b: moments_to_hessians(*shapes, a, b, found.shape_hessian), parts, pool)
    # Bound what overflows, and turn the sums of harmonics into means.
    _bound(found.position_hessian, (0, 1, 2))
    _bound(found.shape_hessian, OPACITY + SCALES + ROTATION)
    np.nan_to_num(found.color_weight, copy=False, nan=LARGEST, posinf=LARGEST)
    colors = found.color_weight[:, None]
    for harmonics in (found.mean_harmonics, found.higher_harmonics):
        np.nan_to_num(harmonics, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        np.divide(harmonics, colors, out=harmonics, where=colors > 0)
    return_free_memory()
    progress("sensitivity", 1.0)
    return found.with_prior(splats, coverage.close_up, coverage.share, view_uncertainty)


def _bound(hessians: Float32[np.ndarray, "N n"], diagonal: tuple[int, ...]) -> None:
    """Replace Hessians that overflow by their diagonals, at most :data:`LARGEST`."""
    for rows in blocks(len(hessians)):
        block = hessians[rows]
        overflowing = ~(np.abs(block) <= LARGEST).all(axis=1)
        if overflowing.any():
            kept = np.nan_to_num(block[overflowing][:, diagonal], nan=LARGEST)
            block[overflowing] = 0
            block[np.ix_(overflowing, diagonal)] = np.minimum(kept, LARGEST)


# Colour refit: base colours that compensate for the quantisation of all other attributes, by least squares.
#
# A rendered image is linear in the base colours. With all other attributes as decoded, the base colours whose images
# are nearest to the original's solve a linear system that is never built: rendering applies the matrix, and the
# gradient of a rendering applies its transpose. Conjugate gradients solve it, preconditioned by its diagonal, the
# colour sensitivity. A few steps suffice: the first ones remove errors that neighbouring Gaussians share, which are the
# visible ones.

DAMPING = 0.02  # weight of the attraction to the initial colours, in units of the median of the diagonal
MAX_CHANGE = 0.5 / SH_C0  # of a coefficient, half of a colour's range: larger changes fit the given cameras only
MAX_CACHED_PIXELS = 1 << 27  # of the original's images kept in memory; above, they are rendered for each step
PROBE_RMS = 0.1  # of the colour changes that the matrix is applied to: clamping at black is not linear


def refit_colors(
    decoded: Splats,
    original: Splats,
    cameras: WeightedCameras,
    color_weight: Float32[np.ndarray, " M"],
    prior: Float32[np.ndarray, " M"],
    context: Context = DEFAULT_CONTEXT,
    *,
    steps: int,
) -> Float32[np.ndarray, "M 3"]:
    """Return base colours of ``decoded`` with which its renderings are nearest to those of ``original``. They are like
    ``sh0``, at most :data:`MAX_CHANGE` from the initial ones, to which ``prior`` attracts them. Each of the ``steps``
    of conjugate gradients takes one rendering and one gradient per camera."""
    from kissgs.rendering.cpu.frame import add_color_gradients, draw

    if steps == 0 or not (color_weight > 0).any():
        return decoded.sh0
    diagonal = color_weight.astype(np.float64)[:, None] * SH_C0**2
    damping = DAMPING * float(np.median(diagonal[diagonal > 0]))
    attraction = prior.astype(np.float64)[:, None] * SH_C0**2 + damping
    views, passes = list(zip(cameras.cameras, cameras.per_pixel(), strict=True)), itertools.count()
    with Workers(context.threads) as pool:
        targets = []
        if sum(camera.width * camera.height for camera, _ in views) <= MAX_CACHED_PIXELS:
            targets = [draw(original, camera, cameras.background, pool).image for camera, _ in views]

        def negative_gradient(sh0: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3"]:
            """Return minus half the gradient by the base colours; renders all images once."""
            total, number = np.zeros(sh0.shape, np.float32), next(passes)
            scene = replace(decoded, sh0=sh0.astype(np.float32))
            for done, (camera, weight) in enumerate(views):
                context.progress("refit", (number + done / len(views)) / (steps + 1))
                frame = draw(scene, camera, cameras.background, pool)
                target = targets[done] if targets else draw(original, camera, cameras.background, pool).image
                add_color_gradients(frame, (target - frame.image) * np.float32(weight), total, pool)
            return attraction * (decoded.sh0 - sh0) + total

        sh0 = _conjugate_gradients(negative_gradient, decoded.sh0.astype(np.float64), diagonal + damping, steps)
    context.progress("refit", 1.0)
    return np.clip(sh0, decoded.sh0 - MAX_CHANGE, decoded.sh0 + MAX_CHANGE).astype(np.float32)


def _conjugate_gradients(
    negative_gradient: Callable[[Float64[np.ndarray, "M 3"]], Float64[np.ndarray, "M 3"]],
    sh0: Float64[np.ndarray, "M 3"],
    diagonal: Float64[np.ndarray, "M 1"],
    steps: int,
) -> Float64[np.ndarray, "M 3"]:
    """Minimise by preconditioned conjugate gradients; the matrix is applied by a difference of two gradients."""
    residual = negative_gradient(sh0)
    direction = residual / diagonal
    squared_norm = float((residual * direction).sum())
    for _ in range(steps):
        scale = PROBE_RMS / max(float(np.sqrt(np.mean(direction**2))), 1e-30)
        applied = (residual - negative_gradient(sh0 + scale * direction)) / scale
        curvature = float((direction * applied).sum())
        if not curvature > 0 or not squared_norm > 0:
            break
        sh0 = sh0 + (squared_norm / curvature) * direction
        residual = residual - (squared_norm / curvature) * applied
        preconditioned = residual / diagonal
        squared_norm, before = float((residual * preconditioned).sum()), squared_norm
        direction = preconditioned + (squared_norm / before) * direction
    return sh0
