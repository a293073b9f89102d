"""Cameras for parts of a scene at their own scale, and sampled ones: photographs, close-ups, anywhere around."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.views import Vec3, Views, black, camera_facing, check_images, log_uniform, random_direction
from kissgs.cameras.virtual.first_view import Record, first_view
from kissgs.cameras.virtual.select import (
    FIELD_OF_VIEW,
    PROXY_GAUSSIANS,
    SceneBounds,
    ScoredCandidates,
    ViewScorer,
    direction_at,
    opacity,
    proxy_scene,
    scene_bounds,
    score_candidates,
    select_diverse,
    split_views,
    with_size,
)
from kissgs.core.array_types import Bool, Float32, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats, blocks, concatenate
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.cpu.frame import add_sensitivities, draw, drawn_opacities
from kissgs.rendering.sensitivity import Coverage, WeightedCameras, local_scale

# Regions: parts of a scene that each need cameras at their own scale.
#
# The first region is the densest part of the scene, with all that can be seen from there. Where its cameras leave
# Gaussians that they do not see, or see too small to resolve, further regions are found: a distant or a much smaller
# object, the inside of another room.

MAX_FURTHER_REGIONS = 16  # largest number of further regions that are looked for
MIN_SHARE = 0.01  # share of the scene's visible opacity that a further region must add, and below which the search ends
MIN_UNSEEN_GAUSSIANS = 8  # number of unseen Gaussians below which the search ends
CANDIDATES_PER_REGION = 40  # number of candidate cameras around each further region
PROBE_CAMERAS = 6  # number of a region's cameras from which coverage is measured
PROBE_SIZE = 160  # longer side of the images in which coverage is measured, pixels
TYPICAL_SIZE = 384  # longer side of the images that cameras will have, pixels: what they resolve depends on it


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """A part of the scene that needs cameras around or inside it."""

    candidates: ScoredCandidates
    share: float
    """Share of the scene's visible opacity that only this region's cameras show, 0 to 1; of the first region, all
    that its cameras show."""

    def cameras(self, count: int) -> list[Camera]:
        """Return ``count`` good cameras that are far from each other."""
        return [self.candidates.cameras[n] for n in select_diverse(self.candidates, count)]


def find_regions(
    splats: Splats, size: tuple[int, int], pool: Workers, progress: Progress, *, camera_count: int
) -> list[Region]:
    """Return the regions of a scene, at least one; shares add up to 1. ``camera_count`` is the number of cameras that
    will be selected for the first region, at most."""
    candidates = score_candidates(splats, size, pool, progress).refined(camera_count)
    proxy = proxy_scene(splats)
    visible, coverage, spacing = drawn_opacities(proxy), Coverage(proxy), local_scale(proxy)
    regions = [Region(candidates, 1.0)]
    unseen = visible * (1 - _updated_coverage(coverage, proxy, regions[0], pool))
    gains = [float(visible.sum() - unseen.sum())]
    for _ in range(MAX_FURTHER_REGIONS):
        remaining = np.flatnonzero(unseen > 0.5 * visible)
        if len(remaining) < MIN_UNSEEN_GAUSSIANS or visible[remaining].sum() < MIN_SHARE * visible.sum():
            break
        bounds = replace(_densest_part(proxy, remaining, spacing), up=candidates.bounds.up)
        region = _further_region(splats, bounds, candidates.cameras[0], pool, progress)
        before = float(unseen.sum())
        unseen = visible * (1 - _updated_coverage(coverage, proxy, region, pool))
        gain = before - float(unseen.sum())
        if gain >= MIN_SHARE * float(visible.sum()):
            regions.append(region)
            gains.append(gain)
        near = np.linalg.norm(proxy.means[remaining] - bounds.centre, axis=1) <= 2 * bounds.radius
        visible[remaining[near]] = 0.0  # what its cameras still do not show is hidden from all sides
        unseen = np.minimum(unseen, visible)
    total = max(sum(gains), 1e-30)
    return [replace(region, share=gain / total) for region, gain in zip(regions, gains, strict=True)]


def allocate_cameras(regions: list[Region], count: int) -> list[int]:
    """Return how many of ``count`` cameras each region gets: by its share, at least four where there are enough."""
    wanted = np.maximum(np.array([region.share for region in regions]) * count, min(4, max(1, count // len(regions))))
    counts = np.maximum(np.floor(wanted * count / wanted.sum()), 1).astype(int)
    counts[0] += max(0, count - int(counts.sum()))
    return [int(n) for n in counts]


def _updated_coverage(coverage: Coverage, proxy: Splats, region: Region, pool: Workers) -> Float32[np.ndarray, " n"]:
    """Add some of the region's cameras to ``coverage``, and return its share."""
    for camera in region.cameras(PROBE_CAMERAS):
        probe = camera.at_most(PROBE_SIZE)
        frame = draw(proxy, probe, black(), pool)
        seen = add_sensitivities(frame, 1.0, 0.0, Sensitivity.none(len(proxy), 0), pool)
        coverage.add(frame, seen, pool, TYPICAL_SIZE / PROBE_SIZE)
    return coverage.share


def _densest_part(proxy: Splats, remaining: Int[np.ndarray, " m"], spacing: Float32[np.ndarray, " n"]) -> SceneBounds:
    """Return the bounds of the part where the Gaussians ``remaining`` are densest. Mean shift starts at the 5 %
    quantile of spacing, because the smallest spacings are often single pairs."""
    densest = remaining[np.argsort(spacing[remaining], kind="stable")[len(remaining) // 20]]
    start = proxy.means[densest].astype(np.float64), 4 * float(spacing[densest])
    return scene_bounds(proxy.select(remaining), start)


def _further_region(splats: Splats, bounds: SceneBounds, like: Camera, pool: Workers, progress: Progress) -> Region:
    """Return a region with candidates all around; half of its proxy scene shows what is in front of it and behind."""
    near = _within(splats.means, bounds.centre, 6 * bounds.radius)
    parts = np.flatnonzero(near), np.flatnonzero(~near)
    proxy = concatenate([proxy_scene(splats, PROXY_GAUSSIANS // 2, part) for part in parts])
    scorer = ViewScorer(proxy, bounds, pool, progress)
    cameras = list(_surrounding_cameras(bounds, like))
    return Region(ScoredCandidates(scorer, "object", cameras, scorer.measure(cameras), np.zeros(len(cameras))), 0.0)


def _within(means: Float32[np.ndarray, "N 3"], centre: Vec3, radius: float) -> Bool[np.ndarray, " N"]:
    found = np.empty(len(means), bool)
    for rows in blocks(len(means)):
        offsets = means[rows] - centre
        found[rows] = np.einsum("nc,nc->n", offsets, offsets) <= radius**2
    return found


def _surrounding_cameras(bounds: SceneBounds, like: Camera) -> Iterator[Camera]:
    """Yield cameras evenly from all directions (a Fibonacci sphere), at 1.3, 2 and 3 radii in turn."""
    for n in range(CANDIDATES_PER_REGION):
        height, azimuth = 1 - (2 * n + 1) / CANDIDATES_PER_REGION, n * np.pi * (3 - np.sqrt(5))  # the golden angle
        horizontal = np.sqrt(1 - height**2)
        direction = np.array([horizontal * np.cos(azimuth), height, horizontal * np.sin(azimuth)])
        position = bounds.centre + bounds.radius * (1.3, 2.0, 3.0)[n % 3] * direction
        yield look_at(position, bounds.centre, bounds.up, fov=FIELD_OF_VIEW, width=like.width, height=like.height)


def scene_views(splats: Splats, context: Context = DEFAULT_CONTEXT, *, width: int, height: int, count: int) -> Views:
    """Return views of every region of a scene, more of regions that show more; every 8th is held out."""
    check_images(count, width, height)
    with Workers(context.threads) as pool:
        return _scene_views(splats, (width, height), count, pool, context)[0]


def _scene_views(
    splats: Splats, size: tuple[int, int], count: int, pool: Workers, context: Context
) -> tuple[Views, ScoredCandidates]:
    """Return :func:`scene_views`, and the candidates of the densest region."""
    regions = find_regions(splats, size, pool, context.progress, camera_count=count)
    context.progress("cameras", 1.0)
    counts = allocate_cameras(regions, count)
    cameras = [camera for region, n in zip(regions, counts, strict=True) for camera in region.cameras(n)]
    return split_views(with_size(cameras[:count], *size)), regions[0].candidates


# Cameras of the sensitivity and of the colour refit: a capture's and some virtual ones, or virtual ones alone.

VIRTUAL_WEIGHT = 0.3
"""Weight of all virtual cameras together, relative to all cameras of a capture. Parts that no photograph shows must not
fall apart, and the photographed parts lose almost nothing by it."""

WIDE_FOCAL_SCALE = 0.6  # of every other virtual camera: parts just outside the images count too
MAX_VIEWS, MIN_VIEWS = 48, 16  # largest and smallest number of cameras that are chosen by the size of the scene
FEW_GAUSSIANS = 150_000  # number of Gaussians up to which there are MAX_VIEWS


def default_view_count(gaussians: int, *, captured: bool) -> int:
    """Return how many cameras measure a scene: in a large one, errors of single Gaussians matter less. Virtual ones are
    chosen to show all of it: 25 instead of 35 lose nothing for 542,104 Gaussians, and 1 dB with a capture."""
    share = (FEW_GAUSSIANS / max(gaussians, 1)) ** (0.25 if captured else 0.5)
    return round(min(max(MAX_VIEWS * share, MIN_VIEWS), MAX_VIEWS))


def sensitivity_cameras(
    splats: Splats, views: Views | None, context: Context = DEFAULT_CONTEXT, *, count: int, size: int
) -> tuple[WeightedCameras, Record]:
    """Return the cameras, each with its weight, that measure sensitivity and refit colours; and the first view. Of a
    capture, at most ``count`` training views are used, and two thirds as many virtual cameras are added; without any,
    ``count`` are virtual. ``size`` is the longer side of the images, pixels; larger ones are sampled."""
    if views is None or not views.train:
        side = size * 4 // 5
        with Workers(context.threads) as pool:
            virtual, candidates = _scene_views(splats, (side, side), count, pool, context)
            opening = first_view(candidates)
        cameras = [view.camera for view in virtual.all]
        for n in range(1, len(cameras), 2):  # a wider field of view
            K = cameras[n].K.copy()
            K[[0, 1], [0, 1]] *= WIDE_FOCAL_SCALE
            cameras[n] = Camera(cameras[n].viewmat, K, cameras[n].width, cameras[n].height)
        return WeightedCameras(cameras, [1.0] * len(virtual.all), virtual.background), opening
    captured = [view.camera for view in views.train]
    chosen = np.unique(np.linspace(0, len(captured) - 1, count).astype(int))
    selected = [captured[n].sampled_at_most(size) for n in chosen]  # virtual cameras see what is between the samples
    side = round(float(np.sqrt(selected[0].width * selected[0].height)))
    with Workers(context.threads) as pool:
        virtual, candidates = _scene_views(splats, (side, side), max(1, count * 2 // 3), pool, context)
        opening = first_view(candidates, selected)
    weight = VIRTUAL_WEIGHT * len(selected) / len(virtual.all)
    cameras = [*selected, *(view.camera for view in virtual.all)]
    weights = [1.0] * len(selected) + [weight] * len(virtual.all)
    weighted = WeightedCameras(cameras, weights, views.background, captured=len(selected))
    return weighted, opening


# Random poses, from where photographs might have been taken, to train or to measure losses with.
#
# A scene that is trained from a few cameras that are as good as possible falls apart between and beside them. Random
# ones are near and far, high and low, around every region; only those with a low view score are left out.

SCORE_MARGIN = 0.5  # below the best candidate; photographs of real captures stay within it
FIELDS_OF_VIEW = np.radians((50, 90))  # along the longer side, radians: from phone to wide-angle lens
NEAREST_RADII, FARTHEST_RADII = 0.8, 2.6  # distances from the centre, where a scene has a background
MIN_ELEVATION, MAX_ELEVATION = -np.pi / 6, np.pi / 3  # radians, where the scene does not enclose the cameras
TARGET_SPREAD = 0.35  # standard deviation of the look-at target around the centre along each axis, radii of the scene
MAX_COUNT_FACTOR = 4.0  # largest number of views of a scene with several regions, relative to count
MAX_ATTEMPTS = 8  # largest number of poses that are drawn for each camera
Pose = tuple[Vec3, Vec3]  # position and look-at target, world units


def random_poses(splats: Splats, context: Context = DEFAULT_CONTEXT, *, side: int, count: int, seed: int = 0) -> Views:
    """Return views for square images from random poses around every region of a scene; every 8th is held out. The
    region with the largest share gets ``count`` of them; together there are at most :data:`MAX_COUNT_FACTOR` times as
    many, and fewer where few poses show the scene."""
    check_images(count, side, side)
    rng = np.random.default_rng(seed)
    cameras: list[Camera] = []
    with Workers(context.threads) as pool:
        regions = find_regions(splats, (side, side), pool, context.progress, camera_count=0)
        largest_share = max(region.share for region in regions) or 1.0
        total = round(count * min(1 / largest_share, MAX_COUNT_FACTOR))
        for region, region_count in zip(regions, allocate_cameras(regions, total), strict=True):
            cameras += _random_cameras(region, region_count, side, rng)
    if len(cameras) < min(2, count):
        return scene_views(splats, context, width=side, height=side, count=count)
    context.progress("cameras", 1.0)
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
        return direction_at(self._bounds.up, elevation, self._rng.uniform(0, 2 * np.pi))

    def _elevation(self, low: float = MIN_ELEVATION, high: float = MAX_ELEVATION) -> float:
        """Draw an elevation, radians, so that directions are uniform on the sphere between the limits."""
        return float(np.arcsin(self._rng.uniform(np.sin(low), np.sin(high))))

    def _target(self) -> Vec3:
        """Draw a look-at target around the centre."""
        return self._bounds.centre + TARGET_SPREAD * self._bounds.radius * self._rng.normal(size=3)


# Close-ups see what views of whole objects are too far away to resolve: a scene that is pruned without them gets holes
# behind and between what other cameras see.

PHOTOGRAPH_FIELD_OF_VIEW = np.radians(70)  # angle of view along both sides, radians, where no longer lens is needed
OCTAVES = 3.0  # distances are one local scale (local_scale) to this many octaves more


def close_ups(splats: Splats, *, side: int, count: int, seed: int = 0) -> list[Camera]:
    """Return cameras with random Gaussians in the centre, drawn by opacity; none if none is visible."""
    weights = opacity(splats)
    if not weights.sum() > 0:
        return []
    rng = np.random.default_rng(seed)
    scales = local_scale(splats)
    cameras = []
    for target in rng.choice(len(splats), count, p=weights / weights.sum()):
        distance = float(scales[target] * 2 ** rng.uniform(0, OCTAVES))
        position = splats.means[target].astype(np.float64)
        cameras.append(camera_facing(position, random_direction(rng), distance, PHOTOGRAPH_FIELD_OF_VIEW, (side, side)))
    return cameras


# Scattered cameras preserve what is seen from beside, behind and above the cameras of a capture, from afar and within.

NEAREST, FARTHEST = 10.0, 3.0
"""Smallest distance from the Gaussian in the centre, local scales (:func:`~kissgs.rendering.sensitivity.local_scale`)
of the proxy scene but at most a radius of the scene, and the largest one, radii."""

ACROSS = 3  # one in this many cameras stands beside another Gaussian, and looks across the scene
MAX_BESIDE = 8.0  # largest distance of such a camera from the Gaussian beside it, local scales; one is the smallest


def scattered_cameras(splats: Splats, *, side: int, count: int, seed: int = 0, threads: int = 0) -> list[Camera]:
    """Return cameras like :func:`close_ups`, but from any distance."""
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
        cameras.append(camera_facing(target, direction, distance, PHOTOGRAPH_FIELD_OF_VIEW, (side, side)))
    return cameras
