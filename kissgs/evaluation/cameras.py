"""Evaluation cameras: drawn at random over a whole scene, at all scales, from a seed; and of overlooked parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.views import Vec3, View, Views, camera_at, log_uniform, random_direction
from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, Workers
from kissgs.core.errors import InvalidViewsError
from kissgs.core.splats import Splats
from kissgs.evaluation.scene_parts import (
    GaussianSampler,
    Part,
    base_colors_only,
    blending_weights,
    find_parts,
    mahalanobis_distances,
    prominence,
)
from kissgs.rendering.camera import Camera
from kissgs.rendering.constants import NEAR
from kissgs.rendering.cpu.frame import draw, drawn_opacities

BACKGROUNDS = (0.0, 0.5, 1.0)  # grey levels, in turn: on black, missing parts of a dark scene would not show
FIELDS_OF_VIEW = np.radians((50.0, 90.0))  # smallest and largest, along the longer side, radians
MAX_DRAWS = 12  # largest number of cameras drawn for one view until one is accepted
THUMBNAIL = 64  # longer side of the thumbnails that decide whether a camera is accepted, pixels

# Cameras for overlooked parts of a scene: parts whose loss would hardly change any image of the drawn cameras.

MAX_ADDED = 72  # largest number of added cameras

VISIBLE_PSNR = 18.0
"""Largest PSNR, decibels, between thumbnails with and without a part at which its loss counts as visible; between full
images it is then at most about 20."""

DISTANCES = (0.6, 1.6)  # of a camera to its part, in units of that at which the part's sphere just fits the image


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Separate parts of a scene (:func:`kissgs.evaluation.scene_parts.find_parts`)."""

    splats: Splats
    parts: list[Part]
    part_of: Int[np.ndarray, " N"]

    def overlooked(self, shares: Float64[np.ndarray, "V P"], views: Sequence[View], pool: Workers) -> list[int]:
        """Return the parts whose loss hardly changes the view that shows them best, least visible parts first."""

        def psnr(part: int) -> float:
            view = views[int(shares[:, part].argmax())]
            assert view.background is not None  # noqa: S101  every drawn view has one
            return self._psnrs_without(part, view.camera, (float(view.background[0]),))[0]

        order = [int(part) for part in np.argsort(shares.max(axis=0), kind="stable")]
        return [part for part, without in zip(order, pool.map(psnr, order), strict=True) if without > VISIBLE_PSNR]

    def cameras_for(self, parts: Sequence[int], rng: np.random.Generator, pool: Workers) -> list[View]:
        """Draw a camera for each part until its loss is visible; after the last attempt, return the best one."""
        best: dict[int, tuple[float, View]] = {}
        remaining = list(parts)
        for _ in range(MAX_DRAWS):
            drawn = []
            for part, sphere in ((part, self.parts[part]) for part in remaining):
                fov = float(rng.uniform(*FIELDS_OF_VIEW))
                narrow = np.arctan(np.tan(fov / 2) * HEIGHT / WIDTH)
                distance = sphere.radius / np.sin(narrow) * log_uniform(rng, *DISTANCES)
                position = sphere.center + distance * random_direction(rng)
                drawn.append((part, camera_at(position, sphere.center, fov, (WIDTH, HEIGHT))))
            found_views = pool.map(lambda each: self._over_best_background(*each), drawn)
            for part, found in zip(remaining, found_views, strict=True):
                if part not in best or found[0] < best[part][0]:
                    best[part] = found
            remaining = [part for part in remaining if best[part][0] > VISIBLE_PSNR]
        return [best[part][1] for part in parts]

    def _over_best_background(self, part: int, camera: Camera) -> tuple[float, View]:
        """Return the view over the grey on which the part's loss is most visible, and its PSNR without the part."""
        psnrs = self._psnrs_without(part, camera, BACKGROUNDS)
        least = int(np.argmin(psnrs))
        background = _grey(BACKGROUNDS[least])
        return psnrs[least], View("part", camera, background=background, target=self.parts[part].center, added=True)

    def _psnrs_without(self, part: int, camera: Camera, backgrounds: Sequence[float]) -> list[float]:
        """Return the PSNR between thumbnails with and without a part, over each of these grey backgrounds."""
        others, thumbnails = self.splats.select(np.flatnonzero(self.part_of != part)), []
        with Workers(1) as single:
            for scene in (self.splats, others):
                frame = draw(scene, camera.at_most(THUMBNAIL), np.zeros(3, np.float32), single)
                thumbnails.append((frame.image, frame.transmittance[:, :, None]))
        (image, transmittance), (other_image, other_transmittance) = thumbnails
        psnrs = list[float]()
        for grey in backgrounds:
            with_it = np.clip(image + grey * transmittance, 0, 1)
            without = np.clip(other_image + grey * other_transmittance, 0, 1)
            error = float(np.mean(np.square(with_it - without), dtype=np.float64))
            psnrs.append(-10 * float(np.log10(max(error, 1e-12))))
        return psnrs


# The encoder has cameras of its own (:mod:`kissgs.cameras.virtual`) and stores coarsely what these do not see;
# evaluated with the same cameras, these errors would not show. So evaluation chooses its own: cameras are
# drawn at random instead of optimised, and every Gaussian that can be visible may become a target.

COUNT = 24  # number of evaluation views, without those added for overlooked parts
WIDTH, HEIGHT = 320, 240  # size of the images, pixels

KINDS = ("far", "around", "close-up", "across")
"""Kinds of poses, in turn: outside of the scene; around a part of random size; close to a surface; from one part of the
scene towards another."""

EXTENT_SHARES = (1.0, 0.98, 0.9, 0.5)  # of Gaussians that a "far" view frames: a few may lie far away
CLOSE_UP_RANKS = (100, 1000)  # Gaussians that are nearer to the target of a close-up than its camera is
MIN_SIGMAS = 5.0  # smallest distance of a camera to its target Gaussian, in the Gaussian's standard deviations
MIN_MEAN_ALPHA = 0.02  # an image with a smaller mean alpha counts as empty
INSIDE_SIGMAS = 3.0  # a camera within this Mahalanobis distance of a Gaussian's mean counts as inside it
MAX_INSIDE_SHARE, MAX_SINGLE_SHARE = 0.5, 0.3  # of an image, by Gaussians around the camera, by a single one
CUT_MARGIN = 0.1  # share of the near plane's depth within which the least change shows or hides a Gaussian whole
MAX_CUT_SHARE = 0.01  # of an image, by such Gaussians


def evaluation_views(splats: Splats, context: Context = DEFAULT_CONTEXT, *, seed: int = 0) -> Views:
    """Draw evaluation cameras over a whole scene; all of them are test views. Four kinds alternate, see :data:`KINDS`.
    A camera is drawn again only if its image is empty, mostly covered by Gaussians that contain the camera or by a
    single one, or if Gaussians at the near plane are in it. Cameras are added for separate parts of the scene whose
    loss would hardly change any of these images.
    The cameras depend on the scene and the seed only, not on the threads."""
    if seed < 0:
        raise InvalidViewsError(f"the seed of evaluation cameras is {seed}; give a whole number from 0")
    rng, counts = np.random.Generator(np.random.PCG64(seed)), prominence(splats)
    sampler = _PoseSampler.of(splats, counts)
    parts = Parts(base_colors_only(splats), *find_parts(splats, counts))
    with Workers(context.threads) as pool:
        drawn, shares = _draw_views(sampler, parts, rng, pool, context.progress)
        added = parts.cameras_for(parts.overlooked(shares, drawn, pool)[:MAX_ADDED], rng, pool)
    context.progress("cameras", 1.0)
    digits = len(str(len(drawn) + len(added) - 1))
    views = [replace(view, name=f"{n:0{digits}} {view.name}") for n, view in enumerate([*drawn, *added])]
    return Views((), tuple(views), _grey(0.5), f"drawn over the whole scene, seed {seed}", origin=splats.origin)


def farther(views: Views, distance: float) -> Views:
    """Return drawn views with their cameras at ``distance`` times the distance from the points that they look at."""
    if not 0 < distance < math.inf:
        raise InvalidViewsError(f"a distance of {distance} times that of the cameras is none; give a number above 0")
    if distance == 1:
        return views
    source = f"{views.source}, at {distance:g} times the distance"
    moved = list[View]()
    for view in views.test:
        assert view.target is not None  # noqa: S101  every drawn view has one
        viewmat = view.camera.viewmat.copy()
        # A point x has camera coordinates R x + t; the target's are in front of the camera, and scale with distance.
        viewmat[:3, 3] += (distance - 1) * (viewmat[:3, :3] @ view.target + viewmat[:3, 3])
        moved.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
    return replace(views, test=tuple(moved), source=source)


def _draw_views(
    sampler: _PoseSampler, parts: Parts, rng: np.random.Generator, pool: Workers, progress: Progress
) -> tuple[list[View], Float64[np.ndarray, "V P"]]:
    """Draw each view until it is accepted; return them and the share of each image that each part covers."""
    # One number from 0 to 1 per view selects its target, stratified over the near kinds and over the other kinds.
    near, count = np.array([KINDS[n % len(KINDS)] in ("around", "close-up") for n in range(COUNT)]), COUNT
    quantiles = np.empty(count)
    for group in (near, ~near):
        size = int(group.sum())
        quantiles[group] = rng.permutation((np.arange(size) + rng.random(size)) / size)
    views = [sampler.view(n, 0, float(quantiles[n]), rng) for n in range(count)]
    shares = np.zeros((count, len(parts.parts)))
    rejected = list(range(count)) if sampler.any_visible else []
    for attempt in range(1, MAX_DRAWS):
        progress("cameras", (count - len(rejected)) / count)
        if not rejected:
            break
        checked = pool.map(lambda n: _check_camera(parts, views[n].camera.at_most(THUMBNAIL)), rejected)
        shares[rejected] = [share if accepted else 0 * share for accepted, share in checked]
        rejected = [n for n, (accepted, _) in zip(rejected, checked, strict=True) if not accepted]
        for n in rejected:
            views[n] = sampler.view(n, attempt, float(quantiles[n]), rng)
    return views, shares


def _grey(level: float) -> Float32[np.ndarray, "3"]:
    return np.full(3, level, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _PoseSampler:
    """Draws poses relative to the visible Gaussians of a scene."""

    any_visible: bool  # whether there are any; if not, one at the origin stands in, so that there are cameras
    columns: Float32[np.ndarray, "3 n"]  # positions, as stored
    sizes: Float64[np.ndarray, " n"]  # standard deviations along the middle axis
    gaussians: GaussianSampler

    @classmethod
    def of(cls, splats: Splats, counts: Float64[np.ndarray, " N"]) -> _PoseSampler:
        visible = np.flatnonzero(drawn_opacities(splats) > 0)
        if not len(visible):
            single = GaussianSampler(np.zeros(1, np.int64), np.ones(1))
            return cls(False, np.zeros((3, 1), np.float32), np.ones(1), single)
        means = splats.means[visible].astype(np.float64)
        sizes = np.exp(np.median(splats.scales[visible].astype(np.float64), axis=1))
        gaussians = GaussianSampler.of(means, counts[visible])
        return cls(True, np.ascontiguousarray(splats.means[visible].T), sizes, gaussians)

    def view(self, number: int, attempt: int, quantile: float, rng: np.random.Generator) -> View:
        """Return the ``attempt``-th camera for a view; ``quantile``, 0 to 1, selects the target of the first ones."""
        kind = KINDS[number % len(KINDS)] if 2 * attempt < MAX_DRAWS else "around"  # the kind that fails least
        target_index = self.gaussians.at(quantile if 2 * attempt < MAX_DRAWS else rng.random())
        origin_index = self.gaussians.at(rng.random())
        fov, direction = float(rng.uniform(*FIELDS_OF_VIEW)), random_direction(rng)
        shift = 2 * attempt * (attempt % 2)  # every other attempt: an isolated cluster may have fewer Gaussians
        fewest, most = (max(1, min(limit, self.columns.shape[1]) >> shift) for limit in CLOSE_UP_RANKS)
        close_rank = _whole_log_uniform(rng, fewest, most)
        target = self._position(target_index)
        if kind == "far":
            # The sphere around the box that holds this share of Gaussians along each axis.
            share = EXTENT_SHARES[(number // len(KINDS) + attempt) % len(EXTENT_SHARES)]
            low, high = np.quantile(self.columns.astype(np.float64), [(1 - share) / 2, (1 + share) / 2], axis=1)
            least = MIN_SIGMAS * float(np.median(self.sizes))
            target, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), least)
            narrow = np.tan(fov / 2) * HEIGHT / WIDTH
            position = target + direction * radius / np.sin(np.arctan(narrow))
        elif kind == "across":
            position = self._position(origin_index) + direction * self._distance(origin_index, close_rank)
        else:
            widest = max(fewest, self.columns.shape[1] >> shift)
            rank = close_rank if kind == "close-up" else _whole_log_uniform(rng, fewest, widest)
            position = target + direction * self._distance(target_index, rank)
        background = _grey(BACKGROUNDS[number % len(BACKGROUNDS)])
        return View(kind, camera_at(position, target, fov, (WIDTH, HEIGHT)), background=background, target=target)

    def _position(self, index: int) -> Vec3:
        return self.columns[:, index].astype(np.float64)

    def _distance(self, index: int, count: int) -> float:
        """Return the radius around a Gaussian that holds ``count`` of them, itself included; at least MIN_SIGMAS."""
        x, y, z = self.columns
        squares = np.square(x - x[index])
        squares += np.square(y - y[index])
        squares += np.square(z - z[index])
        radius = float(np.sqrt(np.partition(squares, count - 1)[count - 1], dtype=np.float64))
        return max(radius, MIN_SIGMAS * float(self.sizes[index]))


def _whole_log_uniform(rng: np.random.Generator, low: int, high: int) -> int:
    return int(np.clip(np.rint(log_uniform(rng, low, high)), low, high))


def _check_camera(parts: Parts, camera: Camera) -> tuple[bool, Float64[np.ndarray, " P"]]:
    """Return whether the image is neither empty nor covered by Gaussians too near, and each part's share of it."""
    with Workers(1) as single:
        cut = _cut_share(parts.splats, camera, single)
        frame = draw(parts.splats, camera, _grey(0.0), single)
        if 1 - float(frame.transmittance.mean(dtype=np.float64)) < MIN_MEAN_ALPHA:
            return False, np.zeros(len(parts.parts))
        weights = blending_weights(frame, single)
    pixels = frame.transmittance.size
    shares = np.bincount(parts.part_of + 1, weights, minlength=len(parts.parts) + 1)[1:] / pixels
    shown = np.flatnonzero(weights > 0)
    inside = mahalanobis_distances(parts.splats.select(shown), camera.position) < INSIDE_SIGMAS
    largest, around = weights.max() / pixels, weights[shown[inside]].sum() / pixels
    accepted = largest < MAX_SINGLE_SHARE and around < MAX_INSIDE_SHARE and cut < MAX_CUT_SHARE
    return bool(accepted), shares


def _cut_share(splats: Splats, camera: Camera, pool: Workers) -> float:
    """Return the share of an image by Gaussians whose depth is about that of the near plane, if all are in front."""
    depths = splats.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    cut = np.abs(depths - NEAR) < CUT_MARGIN * NEAR
    if not cut.any():
        return 0.0
    viewmat = camera.viewmat.copy()
    viewmat[2, 3] += CUT_MARGIN * NEAR
    frame = draw(splats, replace(camera, viewmat=viewmat), _grey(0.0), pool)
    return float(blending_weights(frame, pool)[cut].sum() / frame.transmittance.size)
