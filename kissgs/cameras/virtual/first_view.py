"""The view with which viewers open a scene: which camera, and its record in the metadata of a container.

The record has ``eye`` and ``target``, positions like those of the Gaussians; ``up``, a unit vector; and ``fov``,
degrees: the vertical angle of view, which narrow windows keep from side to side. A viewer turns about the target.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kissgs.cameras.views import Vec3, black
from kissgs.cameras.virtual.select import (
    THUMBNAIL_SIZE,
    SceneBounds,
    ScoredCandidates,
    framing_camera,
    opacity,
    overview_bonus,
    proxy_scene,
    score_candidates,
    weighted_quantiles,
)
from kissgs.core.array_types import Float64
from kissgs.core.context import DEFAULT_CONTEXT, Context, Workers, load_kernels
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

Record = dict[str, list[float] | float]
"""A view in JSON."""

FIELDS_OF_VIEW = {"object": 60.0, "background": 55.0, "enclosed": 55.0}
"""Recorded angle of view by the kind of scene, degrees. The edges of a scene with a background dissolve."""

MIN_FOV, MAX_FOV = 1.0, 150.0
"""Smallest and largest angle of view that viewers accept, degrees."""

REACH = 3.0
"""Distance from the median of an object, in units of the one within which 75 % of the opacity lies, beyond which
Gaussians are floaters and need not be in the image."""

FRONTS, SIMILAR = 12, 0.15
"""Largest number of views of an object that are compared, and how much lower they may score than the best."""

FRAMED_GAUSSIANS = 8000
"""Largest number of Gaussians that tell where an object ends."""

CENTRAL = 0.5
"""Share of an image's width and height, around its middle, in which a photograph must show the densest part."""


def first_view(candidates: ScoredCandidates, captured: Sequence[Camera] = ()) -> Record:
    """Return the record of a captured camera in whose middle the densest part is, else of the best candidate.

    Of captured ones, it is the best of those near the middle of all, upright, with the photograph's angle of view. Of
    candidates, it is the best by view score and distance; where an object stands alone, all of it is framed, from the
    side with the most detail among the best, which is the front of most things.
    """
    bounds = candidates.bounds
    captured = list(captured)
    seeing = [camera for camera in captured if _shows_centre(camera, bounds)]
    if seeing:
        scores = candidates.scores_of([camera.at_most(THUMBNAIL_SIZE) for camera in seeing])
        camera = seeing[int((scores + _bonuses(seeing, bounds) - _eccentricities(seeing, captured)).argmax())]
        fov = 2 * np.degrees(np.arctan(camera.height / (2 * camera.K[1, 1])))
        return _record(camera, bounds, _captured_up(bounds.up, captured), float(fov))
    good = candidates.good()
    cameras = [candidates.cameras[n] for n in good]
    scores = candidates.scores[good] + _bonuses(cameras, bounds)
    camera = cameras[int(scores.argmax())]
    if candidates.kind == "object":
        best = np.argsort(-scores, kind="stable")[:FRONTS]
        directions = [-cameras[n].viewmat[2, :3] for n in best if scores[n] > scores.max() - SIMILAR]
        framed = _framed(candidates, directions)
        details = [_detail(candidates.scorer.proxy, camera) for camera in framed]
        level = [float(np.linalg.norm(np.cross(direction, bounds.up))) for direction in directions]
        camera = framed[int(np.argmax(np.array(details) * level))]  # things look their best from the side
    return _record(camera, bounds, bounds.up, FIELDS_OF_VIEW[candidates.kind])


def first_view_of(splats: Splats, context: Context = DEFAULT_CONTEXT) -> Record | None:
    """Return the record of a clean scene without a capture; None if nothing of it is visible."""
    if not opacity(splats).any():
        return None
    load_kernels(context.progress)
    with Workers(context.threads) as pool:
        candidates = score_candidates(splats, (THUMBNAIL_SIZE, THUMBNAIL_SIZE), pool, context.progress)
    return first_view(candidates)


def _bonuses(cameras: list[Camera], bounds: SceneBounds) -> Float64[np.ndarray, " n"]:
    distances = [float(np.linalg.norm(camera.position - bounds.centre)) for camera in cameras]
    return np.array([overview_bonus(distance / bounds.radius) for distance in distances])


def _shows_centre(camera: Camera, bounds: SceneBounds) -> bool:
    """Whether the centre of the densest part is in the middle of a camera's image."""
    x, y, depth = camera.viewmat[:3, :3] @ bounds.centre + camera.viewmat[:3, 3]
    if depth <= 0:
        return False
    place = (camera.K[:2] @ (x / depth, y / depth, 1.0)) / (camera.width, camera.height)
    return bool((np.abs(place - 0.5) < CENTRAL / 2).all())


def _eccentricities(some: list[Camera], cameras: list[Camera]) -> Float64[np.ndarray, " n"]:
    """Return how much farther some cameras are from all, on average, than the one in the middle is, relative to it."""
    positions = np.array([camera.position for camera in cameras])
    distances = [float(np.linalg.norm(positions - each, axis=1).mean()) for each in positions]
    own = [float(np.linalg.norm(positions - camera.position, axis=1).mean()) for camera in some]
    return np.array(own) / max(min(distances), 1e-30) - 1


def _captured_up(up: Vec3, cameras: list[Camera]) -> Vec3:
    """Return the scene's up direction if photographs are held like that or upside down, else their mean one."""
    mean = -np.mean([camera.viewmat[1, :3] for camera in cameras], axis=0)
    along = float(up @ mean)
    if abs(along) >= 0.5 * np.linalg.norm(mean):
        return up if along >= 0 else -up
    return np.asarray(mean / np.linalg.norm(mean))


def _framed(candidates: ScoredCandidates, directions: list[Vec3]) -> list[Camera]:
    """Return a camera in each direction that frames an object without its floaters, in a square image."""
    proxy, bounds = proxy_scene(candidates.scorer.proxy, FRAMED_GAUSSIANS), candidates.bounds
    means, weights = proxy.means.astype(np.float64), opacity(proxy)
    median = [weighted_quantiles(axis, weights, 0.5)[0] for axis in means.T]
    distances = np.linalg.norm(means - median, axis=1)
    near = distances <= REACH * weighted_quantiles(distances, weights, 0.75)[0]
    size = THUMBNAIL_SIZE, THUMBNAIL_SIZE
    return [framing_camera(means, weights * near, bounds, direction, size) for direction in directions]


def _detail(proxy: Splats, camera: Camera) -> float:
    """Return the sum of the differences in brightness between neighbouring pixels of an object."""
    with Workers(1) as single:
        frame = draw(proxy, camera, black(), single)
    light, opaque = frame.image.mean(axis=2), frame.transmittance < 0.5
    down, right = np.abs(np.diff(light, axis=0)), np.abs(np.diff(light, axis=1))
    return float(down[opaque[1:] & opaque[:-1]].sum() + right[opaque[:, 1:] & opaque[:, :-1]].sum())


def _record(camera: Camera, bounds: SceneBounds, up: Vec3, fov: float) -> Record:
    """Return the record of a camera; its target is as deep in the image as the centre, if that is ahead of it."""
    forward = camera.viewmat[2, :3]
    depth = float(forward @ (bounds.centre - camera.position))
    depth = depth if depth > 0.3 * bounds.radius else bounds.radius  # from within, walls are about as far
    up = up if abs(float(up @ forward)) < 0.99 else -camera.viewmat[1, :3]
    target = camera.position + depth * forward
    decimals = 4 - int(np.floor(np.log10(depth)))  # five digits of the distance, wherever the scene is

    def rounded(values: Vec3, digits: int) -> list[float]:
        return [round(float(value), digits) + 0.0 for value in values]

    return {
        "eye": rounded(camera.position, decimals),
        "target": rounded(target, decimals),
        "up": rounded(up, 4),
        "fov": round(min(max(fov, MIN_FOV), MAX_FOV), 1),
    }
