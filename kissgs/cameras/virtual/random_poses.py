"""Cameras to learn from: at random, wherever a photograph of a scene might have been taken.

:func:`kissgs.virtual_views` picks few cameras, each as good as can be, to judge by. What is fitted to pictures from
such falls apart between them and beside them. These are many and of all sorts: near and far, high and low, from the
sides as well, of every region of the scene, all that the critic lets pass.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.candidates import ground
from kissgs.cameras.virtual.regions import Region, allot, regions
from kissgs.cameras.virtual.scene_bounds import Point, SceneBounds
from kissgs.cameras.virtual.scene_views import scene_views
from kissgs.cameras.virtual.select import Tried, split_views
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera, look_at

PASSABLE = 0.5
"""How much lower than the best a view may score: as photographs of real captures do."""

FIELDS_OF_VIEW = np.radians((50, 90))
"""Angles along the longer side: from phones' to wide angle."""

NEAR, FAR = 0.8, 2.6
"""Distances from the middle, in radii of the scene, where that does not enclose the cameras."""

LOW, HIGH = -np.pi / 6, np.pi / 3
"""Elevations above the ground, from the middle, likewise."""

AIM = 0.35
"""How far beside the middle a camera aims, radii of the scene along each axis: root mean square."""

MOST = 4.0
"""Times as many views as are asked for, at most, where a scene has several regions."""

PATIENCE = 8
"""Tries for each camera, at most."""

Pose = tuple[Point, Point]
"""Place and target."""


def random_poses(
    splats: Splats, *, side: int, count: int, seed: int = 0, threads: int = 0, progress: Progress = silent
) -> Views:
    """Cameras for square pictures, all about a scene that came without any; every 8th is for testing.

    The same scene and seed give the same cameras, whatever the number of threads.

    Args:
        splats: finite (:func:`kissgs.clean`).
        side: of the pictures, pixels.
        count: how many views of a scene with one region; one with several gets more, as many as give the region that
            shows most its ``count``, up to :data:`MOST` times that. Where a scene hardly shows, they are fewer.
        seed: another one, other views.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: less than one view, or pictures of less than one pixel, are asked for.
    """
    if count < 1:
        raise InvalidViewsError(f"at least 1 view can be had, not {count}")
    rng = np.random.default_rng(seed)
    found: list[Camera] = []
    with Workers(threads) as pool:
        parts = regions(splats, (side, side), pool, progress, wanted=0)
        largest = max(region.share for region in parts) or 1.0
        most = round(count * min(1 / largest, MOST))
        for region, share in zip(parts, allot(parts, most), strict=True):
            found += _around(region, share, side, rng)
    if len(found) < min(2, count):
        return scene_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
    progress("cameras", 1.0)
    return split_views(found[:most])


def _around(region: Region, count: int, side: int, rng: np.random.Generator) -> list[Camera]:
    """Random views of one region that are no worse than photographs would be."""
    scene, tried = region.scene, region.tried
    propose, small = _proposer(scene, tried, rng), tried.cameras[0].width
    least = float(tried.scores.max()) - PASSABLE
    found: list[Camera] = []
    for _ in range(PATIENCE):
        poses = [propose() for _ in range(count)]
        fields = rng.uniform(FIELDS_OF_VIEW[0], FIELDS_OF_VIEW[1], count)
        thumbnails = [_take(pose, scene, fov, small) for pose, fov in zip(poses, fields, strict=True)]
        passes = tried.scores_for(thumbnails, region.critic) >= least
        found += [_take(poses[n], scene, fields[n], side) for n in np.flatnonzero(passes)]
        if len(found) >= count:
            break
    return found[:count]


def _take(pose: Pose, scene: SceneBounds, fov: float, side: int) -> Camera:
    return look_at(*pose, scene.up, fov=fov, width=side, height=side)


def _proposer(scene: SceneBounds, tried: Tried, rng: np.random.Generator) -> Callable[[], Pose]:
    """Where to try, by the kind of scene: in a room, about an object, or before what has a background."""
    east, north = ground(scene.up)

    def towards(elevation: float) -> Float64[np.ndarray, "3"]:
        """A direction at this angle above the ground, from any side."""
        azimuth = rng.uniform(0, 2 * np.pi)
        level = np.cos(azimuth) * east + np.sin(azimuth) * north
        return np.asarray(np.cos(elevation) * level + np.sin(elevation) * scene.up)

    def elevation(low: float = LOW, high: float = HIGH) -> float:
        return float(np.arcsin(rng.uniform(np.sin(low), np.sin(high))))

    def beside(target: Point) -> Point:
        return target + AIM * scene.radius * rng.normal(size=3)

    def in_a_room() -> Pose:
        away = np.sqrt(rng.uniform()) * towards(0.0) + rng.uniform(-0.1, 0.4) * scene.up
        place = scene.centre + scene.radius * away
        return place, place + towards(elevation(-0.5, 0.3))

    def about_an_object() -> Pose:
        framed = tried.cameras[rng.integers(len(tried.cameras))]
        distance = rng.uniform(0.4, 1.0) * np.linalg.norm(framed.position - scene.centre)
        return scene.centre + distance * towards(elevation()), beside(scene.centre)

    def before_it() -> Pose:
        distance = np.exp(rng.uniform(np.log(NEAR), np.log(FAR)))
        return scene.centre + distance * scene.radius * towards(elevation()), beside(scene.centre)

    if tried.enclosed:
        return in_a_room
    return before_it if tried.whole else about_an_object
