"""What there is to see in a scene, at every scale: its regions, and cameras that may be chosen for each.

The first region is the scene's densest part with all that can be seen from there. Wherever that leaves Gaussians that
its cameras do not see, or see too small to tell apart, another region is found among these: an object far away or much
smaller, the inside of another room.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.views import black
from kissgs.cameras.virtual.candidates import FIELD_OF_VIEW
from kissgs.cameras.virtual.scene_bounds import SceneBounds, opacity, scene_bounds
from kissgs.cameras.virtual.scoring import SKETCH, ViewScorer, sketch_of
from kissgs.cameras.virtual.select import ROUNDS, Tried, choose, score_candidates
from kissgs.core.array_types import Float64
from kissgs.core.progress import Progress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.coverage import Coverage
from kissgs.rendering.local_scale import local_scale

MOST = 16
"""Regions that are looked for, at most."""

LEAST = 0.01
"""Share of what a scene shows that a further region must add."""

POSES = 40
"""Cameras that are tried around each further region."""

PROBES = 6
"""Cameras by which it is told what a region's views show."""

PROBE_SIDE = 160
"""Pixels of their longer side."""

TYPICAL_SIDE = 384
"""Pixels of the longer side of the images in which the scene will be looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A part of the scene to look at from around or within.

    Attributes:
        scene: centre, radius and up.
        critic: scores views of it.
        tried: cameras that were scored.
        share: of all that the scene shows, what only this region's cameras show, from 0 to 1.
    """

    scene: SceneBounds
    critic: ViewScorer
    tried: Tried
    share: float

    def cameras(self, count: int) -> list[Camera]:
        """The best of them, far from each other."""
        return [self.tried.cameras[n] for n in choose(self.tried, self.scene, count)]


def regions(splats: Splats, size: tuple[int, int], pool: Workers, progress: Progress, *, wanted: int) -> list[Region]:
    """Regions of a scene in the order in which they were found, at least one.

    Args:
        splats: finite.
        size: of the images, width and height in pixels.
        pool: to render with.
        progress: receives the stage ``"cameras"``.
        wanted: cameras that will be chosen in all.

    Raises:
        InvalidViewsError: an image has no pixel.
    """
    scene, critic, tried = score_candidates(splats, size, pool, progress)
    for _ in range(ROUNDS):
        if len(tried.good()) >= 2 * wanted:
            break
        tried = tried.with_more(scene, critic)
    sketch = sketch_of(splats)
    worth = _worth(sketch)
    coverage, spacing = Coverage(sketch), local_scale(sketch)
    found = [Region(scene, critic, tried, 1.0)]
    unseen = worth * (1 - _look(sketch, found[0], coverage, pool))
    shares = [float(worth.sum() - unseen.sum())]
    for _ in range(MOST):
        left = np.flatnonzero(unseen > 0.5 * worth)
        if len(left) < 8 or worth[left].sum() < LEAST * worth.sum():
            break
        densest = left[np.argsort(spacing[left], kind="stable")[len(left) // 20]]
        start = sketch.means[densest].astype(np.float64), 4 * float(spacing[densest])
        part = scene_bounds(sketch.select(left), start)
        part = SceneBounds(part.centre, part.radius, scene.up)
        region = _region(splats, part, tried.cameras[0], pool, progress)
        before = float(unseen.sum())
        unseen = worth * (1 - _look(sketch, region, coverage, pool))
        gain = before - float(unseen.sum())
        if gain >= LEAST * float(worth.sum()):
            found.append(region)
            shares.append(gain)
        near = np.linalg.norm(sketch.means[left] - part.centre, axis=1) <= 2 * part.radius
        worth[left[near]] = 0.0  # looked at; what is still hidden there shows from nowhere
        unseen = np.minimum(unseen, worth)
    total = max(sum(shares), 1e-30)
    return [replace(region, share=share / total) for region, share in zip(found, shares, strict=True)]


def allot(found: list[Region], count: int, least: int = 4) -> list[int]:
    """How many of ``count`` views each region gets: one at least, else by what it shows.

    A region whose share is less than ``least`` views counts as if it were that much.
    """
    least = min(least, max(1, count // len(found)))
    wanted = np.maximum(np.array([region.share for region in found]) * count, least)
    given = np.maximum(np.floor(wanted * count / wanted.sum()), min(least, 1)).astype(int)
    given[0] += max(0, count - int(given.sum()))
    return [int(n) for n in given]


def _worth(sketch: Splats) -> Float64[np.ndarray, " n"]:
    """What each Gaussian could show to a camera nearby; nothing where no renderer draws it."""
    visible = opacity(sketch)
    return np.where(visible > 1 / 255, visible, 0.0)


def _look(sketch: Splats, region: Region, coverage: Coverage, pool: Workers) -> Float64[np.ndarray, " n"]:
    """Coverage of the sketch once some of the region's views were rendered."""
    from kissgs.rendering.cpu.frame import add_sensitivities, draw

    for camera in region.cameras(PROBES):
        probe = camera.at_most(PROBE_SIDE)
        shown = Sensitivity.none(len(sketch), 0)
        add_sensitivities(draw(sketch, probe, black(), pool), 1.0, 0.0, shown, pool)
        coverage.add(probe, shown.color_weight, TYPICAL_SIDE / PROBE_SIDE)
    return coverage.share


def _region(splats: Splats, part: SceneBounds, like: Camera, pool: Workers, progress: Progress) -> Region:
    """Score views all around a further part of the scene, of the scene in front of and behind it too."""
    distance = np.linalg.norm(splats.means - part.centre, axis=1)
    near = distance <= 6 * part.radius
    sketch = _joined(
        sketch_of(splats.select(np.flatnonzero(near)), SKETCH // 2),
        sketch_of(splats.select(np.flatnonzero(~near)), SKETCH // 2),
    )
    critic = ViewScorer(sketch, part, pool, progress)
    cameras = list(_poses(part, like))
    return Region(part, critic, Tried(cameras, critic.judge(cameras), False, False, np.zeros(len(cameras))), 0.0)


def _poses(part: SceneBounds, like: Camera) -> Iterator[Camera]:
    """From all directions, evenly, at distances at which the part fills the image or leaves some air around."""
    for n in range(POSES):
        height, turn = 1 - (2 * n + 1) / POSES, n * np.pi * (3 - np.sqrt(5))
        flat = np.sqrt(1 - height**2)
        direction = np.array([flat * np.cos(turn), height, flat * np.sin(turn)])
        place = part.centre + part.radius * (1.3, 2.0, 3.0)[n % 3] * direction
        yield look_at(place, part.centre, part.up, fov=FIELD_OF_VIEW, width=like.width, height=like.height)


def _joined(first: Splats, second: Splats) -> Splats:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return Splats(**{name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names})
