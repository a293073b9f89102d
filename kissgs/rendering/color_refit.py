"""Colour refit: base colours that compensate for the quantisation of all other attributes, by least squares.

A rendered image is linear in the base colours. With all other attributes as decoded, the base colours whose images are
nearest to the original's solve a linear system that is never built: rendering applies the matrix, and the gradient of a
rendering applies its transpose. Conjugate gradients solve it, preconditioned by its diagonal, the colour sensitivity. A
few steps suffice: the first ones remove errors that neighbouring Gaussians share, which are the visible ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.sensitivity import WeightedCameras

DAMPING = 0.02
"""Weight of the attraction to the initial colours, in units of the median of the diagonal."""

MAX_CHANGE = 0.5 / SH_C0
"""Largest change of a coefficient: half of a colour's range. Faint Gaussians would fit the given cameras with larger
changes that do not help other views."""

MAX_CACHED_PIXELS = 1 << 27
"""Largest number of pixels of the original's images that are kept in memory; above, they are rendered for each step."""

PROBE_RMS = 0.1
"""Root mean square of the colour changes that the matrix is applied to; small, because clamping at black is not
linear."""


def refit_colors(
    decoded: Splats,
    original: Splats,
    cameras: WeightedCameras,
    color_weight: Float32[np.ndarray, " M"],
    prior: Float32[np.ndarray, " M"],
    *,
    steps: int,
    threads: int = 0,
    progress: Progress = silent,
) -> Float32[np.ndarray, "M 3"]:
    """Return base colours of ``decoded`` with which its renderings are nearest to those of ``original``.

    Args:
        decoded: the scene that a decoder will get, finite, with initial base colours.
        original: the uncompressed scene, finite.
        cameras: cameras and weights of the images to compare.
        color_weight: ``(M,)`` :attr:`kissgs.Sensitivity.color_weight` of ``decoded``.
        prior: ``(M,)`` :attr:`kissgs.Sensitivity.prior` of ``decoded``, which attracts to the initial colours.
        steps: number of steps of conjugate gradients; each takes one rendering and one gradient per camera.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "refit".

    Returns:
        ``(M, 3)`` coefficients like ``sh0``, at most :data:`MAX_CHANGE` from the initial ones.

    Raises:
        UnsupportedError: an image would take too much memory.
    """
    if steps == 0 or not (color_weight > 0).any():
        return decoded.sh0
    diagonal = color_weight.astype(np.float64)[:, None] * SH_C0**2
    damping = DAMPING * float(np.median(diagonal[diagonal > 0]))
    with Workers(threads) as pool:
        problem = _LeastSquares(
            decoded=decoded,
            original=original,
            cameras=cameras,
            attraction=prior.astype(np.float64)[:, None] * SH_C0**2 + damping,
            pool=pool,
            progress=progress,
            total_passes=steps + 1,
        )
        sh0 = _conjugate_gradients(problem.negative_gradient, decoded.sh0.astype(np.float64), diagonal + damping, steps)
    progress("refit", 1.0)
    return np.clip(sh0, decoded.sh0 - MAX_CHANGE, decoded.sh0 + MAX_CHANGE).astype(np.float32)


class _LeastSquares:
    """The squared image error as a function of the base colours, plus the attraction to the initial ones."""

    def __init__(
        self,
        *,
        decoded: Splats,
        original: Splats,
        cameras: WeightedCameras,
        attraction: Float64[np.ndarray, "M 1"],
        pool: Workers,
        progress: Progress,
        total_passes: int,
    ) -> None:
        self.decoded, self.original, self.cameras, self.attraction = decoded, original, cameras, attraction
        self.pool, self.progress, self.passes, self.total_passes = pool, progress, 0, total_passes
        pixels = sum(camera.width * camera.height for camera in cameras.cameras)
        self.targets = [self._target(camera) for camera in cameras.cameras] if pixels <= MAX_CACHED_PIXELS else []

    def _target(self, camera: Camera) -> Float32[np.ndarray, "H W 3"]:
        from kissgs.rendering.cpu.frame import draw

        return draw(self.original, camera, self.cameras.background, self.pool).image

    def negative_gradient(self, sh0: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 3"]:
        """Return minus half the gradient by the base colours; renders all images once."""
        from kissgs.rendering.cpu.frame import draw
        from kissgs.rendering.cpu.gradients import add_color_gradients

        total = np.zeros(sh0.shape, np.float32)
        scene, count = replace(self.decoded, sh0=sh0.astype(np.float32)), len(self.cameras.cameras)
        for done, (camera, weight) in enumerate(zip(self.cameras.cameras, self.cameras.per_pixel(), strict=True)):
            self.progress("refit", (self.passes + done / count) / self.total_passes)
            frame = draw(scene, camera, self.cameras.background, self.pool)
            target = self.targets[done] if self.targets else self._target(camera)
            add_color_gradients(frame, (target - frame.image) * np.float32(weight), total, self.pool)
        self.passes += 1
        return self.attraction * (self.decoded.sh0 - sh0) + total


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
