"""Evaluation cameras: drawn at random over a whole scene, at all scales, from a seed.

The encoder has cameras of its own (:mod:`kissgs.cameras.virtual`) and stores coarsely what these do not see. The same
cameras would not notice what was lost. So nothing here is shared with them: cameras are drawn, not chosen, and every
Gaussian that can be visible may be looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from kissgs.cameras.views import View, Views
from kissgs.core.array_types import Float32, Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.camera_sampling import BACKGROUNDS, FIELDS_OF_VIEW, PATIENCE, THUMBNAIL, Point, aim, direction
from kissgs.evaluation.overlooked import MOST_ADDED, Parts
from kissgs.evaluation.prominence import GaussianSampler, distances, opacity, prominence
from kissgs.evaluation.visibility import weights_of, without_gloss
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

COUNT = 24
WIDTH, HEIGHT = 320, 240

Kind = Literal["far", "around", "close-up", "across"]
KINDS: tuple[Kind, ...] = get_args(Kind)
"""From outside of all there is; around a part of any size; close to a surface; from one place to another."""

EXTENTS = (1.0, 0.98, 0.9, 0.5)
"""Shares of the Gaussians, along each axis, that views from far have in their picture: a few may be far away."""

CLOSE = (100, 1000)
"""How many Gaussians are nearer than a close-up's camera to what it looks at."""

BESIDE = 5.0
"""Standard deviations: no camera is nearer than that to the Gaussian that it looks at."""

EMPTY = 0.02
"""A picture with less than this mean alpha shows nothing."""

WITHIN = 3.0
"""Standard deviations: a camera that is nearer to a Gaussian's middle stands inside it."""

INSIDE, ALONE = 0.5, 0.3
"""Shares of a picture that may show Gaussians inside of which the camera stands, and a single Gaussian."""


def evaluation_views(
    splats: Splats,
    *,
    count: int = COUNT,
    width: int = WIDTH,
    height: int = HEIGHT,
    seed: int = 0,
    threads: int = 0,
    progress: Progress = silent,
) -> Views:
    """Cameras all over a scene, none of which the encoder uses; all are for testing.

    Four kinds take turns, see :data:`KINDS`. A camera is drawn anew only if it shows nothing at all, or little but the
    inside of Gaussians or a single one. For parts of the scene that stand apart, and whose loss would hardly change any
    of these pictures, cameras are added (:mod:`kissgs.evaluation.overlooked`). The same scene and seed give the same
    cameras, whatever the number of threads.

    Args:
        splats: cleaned (:func:`kissgs.clean`).
        count: how many views, but for those that are added.
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        seed: another one, other cameras.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: less than one view, or pictures of less than one pixel, are asked for; the seed is negative.
    """
    if min(width, height, count) < 1:
        raise InvalidViewsError(f"at least 1 view of 1x1 pixels can be had, not {count} of {width}x{height}")
    if seed < 0:
        raise InvalidViewsError(f"a seed is a whole number from 0, not {seed}")
    rng, counts = np.random.Generator(np.random.PCG64(seed)), prominence(splats)
    sampler = _PoseSampler.of(splats, counts, (width, height))
    subjects = _subjects(count, rng)
    poses: list[_Pose] = [sampler.pose(n, 0, float(subjects[n]), rng) for n in range(count)]
    parts = Parts.of(without_gloss(splats), counts)
    shares = np.zeros((count, len(parts.parts)))
    again = list(range(count)) if sampler.seen else []
    with Workers(threads) as pool:
        for attempt in range(1, PATIENCE):
            progress("cameras", (count - len(again)) / count)
            if not again:
                break
            shown = pool.map(lambda n: _shows(parts, poses[n].camera.at_most(THUMBNAIL)), again)
            shares[again] = [taken if good else 0 * taken for good, taken in shown]
            again = [n for n, (good, _) in zip(again, shown, strict=True) if not good]
            for n in again:
                poses[n] = sampler.pose(n, attempt, float(subjects[n]), rng)
        drawn = [(pose.camera, BACKGROUNDS[n % len(BACKGROUNDS)]) for n, pose in enumerate(poses)]
        few = parts.overlooked(shares, drawn, pool)[:MOST_ADDED]
        added = parts.cameras_for(few, (width, height), rng, pool)
    progress("cameras", 1.0)
    digits = len(str(count + len(added) - 1))
    views = [
        View(f"{n:0{digits}} {pose.kind}", camera, background=_grey(level), target=pose.target)
        for n, (pose, (camera, level)) in enumerate(zip(poses, drawn, strict=True))
    ]
    views += [
        View(f"{n:0{digits}} part", one.camera, background=_grey(one.background), target=one.target, added=True)
        for n, one in enumerate(added, count)
    ]
    return Views((), tuple(views), _grey(0.5), f"drawn over the whole scene, seed {seed}")


def _subjects(count: int, rng: np.random.Generator) -> Float64[np.ndarray, " count"]:
    """Numbers from 0 to 1, one for each view: evenly spread over views of what is near, and over the others."""
    near = np.array([KINDS[n % len(KINDS)] in ("around", "close-up") for n in range(count)])
    numbers = np.empty(count)
    for of in (near, ~near):
        many = int(of.sum())
        numbers[of] = rng.permutation((np.arange(many) + rng.random(many)) / max(many, 1))
    return numbers


def _grey(level: float) -> Float32[np.ndarray, "3"]:
    return np.full(3, level, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    kind: Kind
    camera: Camera
    target: Point


@dataclass(frozen=True, slots=True, eq=False)
class _PoseSampler:
    """Where the visible Gaussians are.

    Attributes:
        seen: whether there is one; else something stands for them, so that there are cameras.
        columns: ``(3, n)`` positions, as they are stored.
        sizes: ``(n,)`` standard deviations along the middle axis.
        gaussians: what to look at.
        size: of pictures, pixels.
    """

    seen: bool
    columns: Float32[np.ndarray, "3 n"]
    sizes: Float64[np.ndarray, " n"]
    gaussians: GaussianSampler
    size: tuple[int, int]

    @classmethod
    def of(cls, splats: Splats, counts: Float64[np.ndarray, " N"], size: tuple[int, int]) -> _PoseSampler:
        visible = np.flatnonzero(opacity(splats) > 0)
        if not len(visible):
            alone = GaussianSampler(np.zeros(1, np.int64), np.ones(1))
            return cls(False, np.zeros((3, 1), np.float32), np.ones(1), alone, size)
        means = splats.means[visible].astype(np.float64)
        sizes = np.exp(np.median(splats.scales[visible].astype(np.float64), axis=1))
        gaussians = GaussianSampler.of(means, counts[visible])
        return cls(True, np.ascontiguousarray(splats.means[visible].T), sizes, gaussians, size)

    def pose(self, number: int, attempt: int, subject: float, rng: np.random.Generator) -> _Pose:
        """The ``attempt``-th camera for a view; ``subject``, from 0 to 1, tells what is looked at, at first."""
        kind = KINDS[number % len(KINDS)] if 2 * attempt < PATIENCE else "around"  # there is always something near
        chosen = self.gaussians.at(subject if 2 * attempt < PATIENCE else rng.random())
        other = self.gaussians.at(rng.random())
        fov, towards = float(rng.uniform(*FIELDS_OF_VIEW)), direction(rng)
        nearer = 2 * attempt * (attempt % 2)  # every other one, in case that a lone cluster has fewer Gaussians
        few, many = (max(1, min(limit, self.columns.shape[1]) >> nearer) for limit in CLOSE)
        close = _between(few, many, rng)
        if kind == "far":
            target, radius = self._extent(EXTENTS[(number // len(KINDS) + attempt) % len(EXTENTS)])
            narrow = np.tan(fov / 2) * min(self.size) / max(self.size)
            return self._take(kind, target + towards * radius / np.sin(np.arctan(narrow)), target, fov)
        target = self._at(chosen)
        if kind == "across":
            place = self._at(other) + towards * self._reach(other, close)
            return self._take(kind, place, target, fov)
        around = close if kind == "close-up" else _between(few, max(few, self.columns.shape[1] >> nearer), rng)
        return self._take(kind, target + towards * self._reach(chosen, around), target, fov)

    def _take(self, kind: Kind, place: Point, target: Point, fov: float) -> _Pose:
        return _Pose(kind, aim(place, target, fov, self.size), target)

    def _at(self, index: int) -> Point:
        return self.columns[:, index].astype(np.float64)

    def _reach(self, index: int, count: int) -> float:
        """How far ``count`` Gaussians, itself included, lie from this one at most; and that it is before a camera."""
        x, y, z = self.columns
        squares = np.square(x - x[index])
        squares += np.square(y - y[index])
        squares += np.square(z - z[index])
        reach = float(np.sqrt(np.partition(squares, count - 1)[count - 1], dtype=np.float64))
        return max(reach, BESIDE * float(self.sizes[index]))

    def _extent(self, share: float) -> tuple[Point, float]:
        """Centre and radius of a sphere around the box that holds this share of all along each axis."""
        low, high = np.quantile(self.columns.astype(np.float64), [(1 - share) / 2, (1 + share) / 2], axis=1)
        radius = 0.5 * float(np.linalg.norm(high - low))
        return 0.5 * (low + high), max(radius, BESIDE * float(np.median(self.sizes)))


def _between(low: int, high: int, rng: np.random.Generator) -> int:
    """A whole number of any order of magnitude."""
    return int(np.clip(np.rint(np.exp(rng.uniform(np.log(low), np.log(high)))), low, high))


def _shows(parts: Parts, camera: Camera) -> tuple[bool, Float64[np.ndarray, " P"]]:
    """Whether there is something to see, and more than the inside of Gaussians, or one of them; the parts' shares."""
    with Workers(1) as alone:
        frame = draw(parts.splats, camera, _grey(0.0), alone)
        if 1 - float(frame.transmittance.mean(dtype=np.float64)) < EMPTY:
            return False, np.zeros(len(parts.parts))
        weights = weights_of(frame, alone)
    pixels = frame.transmittance.size
    around = np.flatnonzero(weights > 0)
    inside = distances(parts.splats.select(around), camera.position) < WITHIN
    good = weights.max() < ALONE * pixels and weights[around[inside]].sum() < INSIDE * pixels
    return bool(good), parts.shares(weights, pixels)
