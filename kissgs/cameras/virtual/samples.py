"""Sampled cameras: where photographs might have been taken, close to single Gaussians, anywhere around a scene."""

from __future__ import annotations

import numpy as np

from kissgs.cameras.random_cameras import Vec3, camera_facing, log_uniform, random_direction
from kissgs.cameras.views import Views
from kissgs.cameras.virtual.candidates import horizontal_axes, opacity, proxy_scene, scene_bounds
from kissgs.cameras.virtual.regions import Region, allocate_cameras, find_regions, scene_views
from kissgs.cameras.virtual.select import ScoredCandidates, split_views
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.coverage import local_scale

# ``random_poses``: virtual cameras to train or to measure losses with, from where photographs might have been taken.
#
# :func:`kissgs.virtual_views` selects a few cameras that are as good as possible. A scene that is trained from such
# views only falls apart between and beside them. Random cameras are near and far, high and low, around every region;
# only those with a low view score are left out.

SCORE_MARGIN = 0.5
"""How much lower than the best candidate a random camera may score; photographs of real captures stay within it."""

FIELDS_OF_VIEW = np.radians((50, 90))
"""Smallest and largest angle of view along the longer side, radians: from phone to wide-angle lens."""

NEAREST_RADII, FARTHEST_RADII = 0.8, 2.6
"""Distances from the centre, radii of the scene, in front of a scene with a background."""

MIN_ELEVATION, MAX_ELEVATION = -np.pi / 6, np.pi / 3
"""Elevations above the ground as seen from the centre, radians, where the scene does not enclose the cameras."""

TARGET_SPREAD = 0.35
"""Standard deviation of the look-at target around the centre along each axis, radii of the scene."""

MAX_COUNT_FACTOR = 4.0
"""Largest number of views of a scene with several regions, relative to ``count``."""

MAX_ATTEMPTS = 8
"""Largest number of poses that are drawn for each camera."""

Pose = tuple[Vec3, Vec3]
"""Position and look-at target, world units."""


def random_poses(
    splats: Splats, *, side: int, count: int, seed: int = 0, threads: int = 0, progress: Progress = silent
) -> Views:
    """Return views for square images from random poses around every region of a scene; every 8th is held out.

    ``count`` is the number of views of a scene with one region. With several there are so many more that the region
    with the largest share gets ``count``, at most :data:`MAX_COUNT_FACTOR` times ``count``; where few poses show the
    scene, there are fewer. The result is the same for any number of threads.
    """
    if count < 1:
        raise InvalidViewsError(f"there must be at least 1 view, not {count}")
    rng = np.random.default_rng(seed)
    cameras: list[Camera] = []
    with Workers(threads) as pool:
        regions = find_regions(splats, (side, side), pool, progress, camera_count=0)
        largest_share = max(region.share for region in regions) or 1.0
        total = round(count * min(1 / largest_share, MAX_COUNT_FACTOR))
        for region, region_count in zip(regions, allocate_cameras(regions, total), strict=True):
            cameras += _random_cameras(region, region_count, side, rng)
    if len(cameras) < min(2, count):
        return scene_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
    progress("cameras", 1.0)
    return split_views(cameras[:total])


def _random_cameras(region: Region, count: int, side: int, rng: np.random.Generator) -> list[Camera]:
    """Return at most ``count`` random cameras of a region that score within :data:`SCORE_MARGIN` of the best."""
    candidates = region.candidates
    sampler = _PoseSampler(candidates, rng)
    up, thumbnail_side = candidates.bounds.up, candidates.cameras[0].width
    min_score = float(candidates.scores.max()) - SCORE_MARGIN
    cameras: list[Camera] = []
    for _ in range(MAX_ATTEMPTS):
        poses = [sampler.draw() for _ in range(count)]
        fields = rng.uniform(FIELDS_OF_VIEW[0], FIELDS_OF_VIEW[1], count)
        thumbnails = [_square(pose, up, fov, thumbnail_side) for pose, fov in zip(poses, fields, strict=True)]
        accepted = candidates.scores_of(thumbnails) >= min_score
        cameras += [_square(poses[n], up, fields[n], side) for n in np.flatnonzero(accepted)]
        if len(cameras) >= count:
            break
    return cameras[:count]


def _square(pose: Pose, up: Vec3, fov: float, side: int) -> Camera:
    """Return a camera for square images at a pose; ``fov`` in radians."""
    position, target = pose
    return look_at(position, target, up, fov=fov, width=side, height=side)


class _PoseSampler:
    """Draws random poses that suit the kind of scene."""

    def __init__(self, candidates: ScoredCandidates, rng: np.random.Generator) -> None:
        self._bounds, self._candidates, self._rng = candidates.bounds, candidates, rng
        self._east, self._north = horizontal_axes(candidates.bounds.up)
        samplers = {"enclosed": self._inside, "background": self._in_front, "object": self._around_object}
        self.draw = samplers[candidates.kind]

    def _inside(self) -> Pose:
        """Draw a position within one radius of the centre, near its height, and any roughly horizontal direction."""
        rng, bounds = self._rng, self._bounds
        offset = np.sqrt(rng.uniform()) * self._direction(0.0) + rng.uniform(-0.1, 0.4) * bounds.up
        position = bounds.centre + bounds.radius * offset
        return position, position + self._direction(self._elevation(-0.5, 0.3))

    def _around_object(self) -> Pose:
        """Draw a position at 0.4 to 1 times the distance of a random candidate, looking roughly at the centre."""
        rng, candidates, centre = self._rng, self._candidates, self._bounds.centre
        framing = candidates.cameras[rng.integers(len(candidates.cameras))]
        distance = rng.uniform(0.4, 1.0) * np.linalg.norm(framing.position - centre)
        return centre + distance * self._direction(self._elevation()), self._target()

    def _in_front(self) -> Pose:
        """Draw a position at a log-uniform distance, looking roughly at the centre."""
        bounds = self._bounds
        distance = log_uniform(self._rng, NEAREST_RADII, FARTHEST_RADII)
        return bounds.centre + distance * bounds.radius * self._direction(self._elevation()), self._target()

    def _direction(self, elevation: float) -> Vec3:
        """Draw a unit vector at this elevation, radians, and a uniform azimuth."""
        azimuth = self._rng.uniform(0, 2 * np.pi)
        horizontal = np.cos(azimuth) * self._east + np.sin(azimuth) * self._north
        return np.asarray(np.cos(elevation) * horizontal + np.sin(elevation) * self._bounds.up)

    def _elevation(self, low: float = MIN_ELEVATION, high: float = MAX_ELEVATION) -> float:
        """Draw an elevation, radians, so that directions are uniform on the sphere between the limits."""
        return float(np.arcsin(self._rng.uniform(np.sin(low), np.sin(high))))

    def _target(self) -> Vec3:
        """Draw a look-at target around the centre."""
        return self._bounds.centre + TARGET_SPREAD * self._bounds.radius * self._rng.normal(size=3)


# ``close_ups``: cameras close to single Gaussians, which see what views of whole objects are too far away to resolve.
#
# A scene that is pruned without them gets holes behind and between what other cameras see.

FIELD_OF_VIEW = np.radians(70)
"""Angle of view along both sides, radians, where no longer lens is needed."""

OCTAVES = 3.0
"""Distances are one local scale (:func:`~kissgs.rendering.coverage.local_scale`) to this many octaves more."""


def close_ups(splats: Splats, *, side: int, count: int, seed: int = 0) -> list[Camera]:
    """Return cameras for square images, each with a random Gaussian in the centre, from a random direction.

    A Gaussian is drawn in proportion to its opacity; without any visible one there are no cameras.
    """
    weights = opacity(splats)
    if not weights.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales = local_scale(splats)
    cameras = []
    for target in rng.choice(len(splats), count, p=weights / weights.sum()):
        distance = float(scales[target] * 2 ** rng.uniform(0, OCTAVES))
        position = splats.means[target].astype(np.float64)
        cameras.append(camera_facing(position, random_direction(rng), distance, FIELD_OF_VIEW, (side, side)))
    return cameras


# ``scattered_cameras``: cameras anywhere in and around a scene, for what a capture does not show.
#
# They preserve what is seen from beside, behind and above the cameras of a capture, from afar and from within.

NEAREST, FARTHEST = 10.0, 3.0
"""Smallest distance from the Gaussian in the centre, local scales (:func:`~kissgs.rendering.coverage.local_scale`)
of the proxy scene but at most a radius of the scene, and the largest one, radii."""

ACROSS = 3
"""One in this many cameras stands beside another Gaussian, and looks across the scene."""

MAX_BESIDE = 8.0
"""Largest distance of such a camera from the Gaussian beside it, local scales; the smallest one is a local scale."""


def scattered_cameras(splats: Splats, *, side: int, count: int, seed: int = 0, threads: int = 0) -> list[Camera]:
    """Return cameras for square images, each with a random Gaussian in the centre, from any distance.

    Gaussians of the proxy scene are drawn in proportion to their opacity; distances are log-uniformly distributed,
    directions uniformly. Without any visible Gaussian there are no cameras.
    """
    proxy = proxy_scene(splats)
    weights = opacity(proxy)
    if not weights.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales, radius = local_scale(proxy, threads=threads), scene_bounds(proxy).radius
    drawn = rng.choice(len(proxy), (count, 2), p=weights / weights.sum())
    cameras = []
    for n, (looked_at, beside) in enumerate(drawn):
        target, direction = proxy.means[looked_at].astype(np.float64), random_direction(rng)
        if n % ACROSS == 0:
            offset = direction * log_uniform(rng, float(scales[beside]), MAX_BESIDE * float(scales[beside]))
            direction = proxy.means[beside].astype(np.float64) + offset - target
            distance = max(float(np.linalg.norm(direction)), 1e-9)
            direction /= distance
        else:
            nearest = min(NEAREST * float(scales[looked_at]), radius)
            distance = log_uniform(rng, nearest, FARTHEST * radius)
        cameras.append(camera_facing(target, direction, distance, FIELD_OF_VIEW, (side, side)))
    return cameras
