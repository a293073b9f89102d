"""How good a view is, judged by a thumbnail of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.cameras.views import black
from kissgs.cameras.virtual.scene_bounds import SceneBounds, weighted_median
from kissgs.core.array_types import Float64
from kissgs.core.progress import Progress
from kissgs.core.splats import SH_C0, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

SKETCH = 30_000
"""Gaussians in a thumbnail. Of larger scenes, evenly many are left out and the rest enlarged."""

TOO_NEAR = 0.35
"""Matter nearer than this, in radii of the scene's middle, is in the way."""


@dataclass(frozen=True, slots=True)
class ViewStats:
    """What a camera would see, as means over the picture.

    Attributes:
        covered: alpha.
        coarse: logarithm of the size of Gaussians, in world units; the median. What was not captured is coarse.
        blurred: logarithm of the angle under which they are seen, in radians; the median.
        near: the share of matter right before the lens.
        middle: the share of the scene's middle.
    """

    covered: float
    coarse: float
    blurred: float
    near: float
    middle: float


class ViewScorer:
    """Takes thumbnails and judges them."""

    def __init__(self, sketch: Splats, scene: SceneBounds, pool: Workers, progress: Progress) -> None:
        self._scene, self._pool, self._progress = scene, pool, progress
        self._sketch = sketch
        self._size = sketch.scales.max(axis=1)
        self._middle = np.linalg.norm(sketch.means - scene.centre, axis=1) < 2 * scene.radius
        self._done = 0

    def judge(self, cameras: list[Camera]) -> list[ViewStats]:
        """What each sees."""

        def report(fraction: float) -> None:
            tried = self._done + fraction * len(cameras)
            self._progress("cameras", tried / (tried + 300))  # how many will follow is not known

        found = self._pool.map(self._look, cameras, report)
        self._done += len(cameras)
        return found

    def _look(self, camera: Camera) -> ViewStats:
        """Draw the scene with size, depth and place for colours, so that the picture holds their visible means."""
        depth = np.log(np.maximum(self._sketch.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3], 1e-12))
        values = self._size, depth, 30.0 * self._middle
        colours = np.stack([_as_colour(value) for value in values], axis=1)
        s = self._sketch
        painted = Splats(
            means=s.means,
            quats=s.quats,
            scales=s.scales,
            opacities=s.opacities,
            sh0=colours.astype(np.float32),
            shN=np.empty((len(s), 0, 3), np.float32),
        )
        with Workers(1) as alone:
            frame = draw(painted, camera, black(), alone)
        alpha = 1 - frame.transmittance.astype(np.float64)
        size, depth, middle = (_from_colour(frame.image[:, :, c] / np.maximum(alpha, 1e-6)) for c in range(3))
        near = (np.exp(depth) < TOO_NEAR * self._scene.radius) * alpha
        return ViewStats(
            covered=float(alpha.mean()),
            coarse=weighted_median(size.ravel(), alpha.ravel()),
            blurred=weighted_median((size - depth).ravel(), alpha.ravel()),
            near=float(near.mean()),
            middle=float((middle / 30 * alpha).mean()),
        )


def _as_colour(logarithm: np.ndarray) -> np.ndarray:
    return (np.clip(logarithm / 60 + 0.5, 0, 1) - 0.5) / SH_C0


def _from_colour(colour: np.ndarray) -> np.ndarray:
    return (colour - 0.5) * 60


def sketch_of(splats: Splats, most: int = SKETCH) -> Splats:
    """The scene without gloss, in ``most`` Gaussians at most."""
    step = max(1, -(-len(splats) // most))
    thinned = splats.select(slice(None, None, step))
    return Splats(
        means=np.ascontiguousarray(thinned.means),
        quats=np.ascontiguousarray(thinned.quats),
        scales=thinned.scales + np.float32(np.log(step) / 2),
        opacities=np.ascontiguousarray(thinned.opacities),
        sh0=np.ascontiguousarray(thinned.sh0),
        shN=np.empty((len(thinned), 0, 3), np.float32),
    )


def scores_of(seen: list[ViewStats], *, whole: bool = True) -> Float64[np.ndarray, " n"]:
    """1 for a sharp picture of the scene's middle, without holes and with nothing right before the lens; else less.

    ``whole``: the scene should fill the picture; if false, it stands alone, and only next to nothing is too little.
    """
    names = ("covered", "coarse", "blurred", "near", "middle")
    covered, coarse, blurred, near, middle = (np.array([getattr(view, name) for view in seen]) for name in names)
    filled = covered >= 0.5 * covered.max()
    excess = [np.maximum(value - np.quantile(value[filled], 0.1), 0) for value in (coarse, blurred)]
    holes = 2 * (1 - covered) if whole else np.maximum(0.5 - covered / max(covered.max(), 1e-9), 0)
    missed = np.maximum(1 - middle / 0.25, 0) if whole else np.zeros(len(seen))
    return np.asarray(1 - holes - 0.4 * excess[0] - 0.35 * excess[1] - near - 0.5 * missed)
