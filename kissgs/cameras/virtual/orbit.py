"""A way around a scene, for a camera to go along: a full circle where all sides can be shown, else to and fro.

Level circles of several sizes and heights are tried by thumbnails all along them, as virtual cameras are. The one with
the longest good stretch is taken. A scene that was captured from one side only dissolves at the ends of its stretch,
which is where the way turns back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.virtual.candidates import FIELD_OF_VIEW, ground
from kissgs.cameras.virtual.scene_bounds import Point, SceneBounds, opacity, weighted_median
from kissgs.cameras.virtual.scoring import ViewScorer
from kissgs.cameras.virtual.select import GOOD_ENOUGH, Tried, of_distance, score_candidates
from kissgs.core.array_types import Bool, Float64, Int
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

STEPS = 24
"""Thumbnails along a circle."""

FINE_STEPS = 72
"""The same along the one that is taken."""

LENIENCE = 0.15
"""How much worse than good enough a place may be on a full circle: better past it than back at it."""

LEAST = float(np.radians(30))
"""To and fro over less would hardly show that it moves."""

RADII = (1.1, 1.5, 2.0, 2.6)
"""Of circles around the scene's middle, in its radii."""

ELEVATIONS = (5, 15, 28)
"""Of circles, degrees, as seen from the middle."""

AIR = 1.1
"""Around what stands alone."""

DOWNWARD = 6
"""Degrees, when looking around from one place."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """A level circle, and the stretch of it from which the scene looks good.

    Attributes:
        hub: the middle of the sphere on which the circle lies.
        reach: its radius; 0 to look around from one place.
        elevation: of the circle above the hub, radians.
        up: unit vector.
        middle: azimuth of the stretch's middle, or of the best place where it is a full circle, radians.
        sweep: length of the stretch, radians; 2 pi for a full circle.
    """

    hub: Point
    reach: float
    elevation: float
    up: Point
    middle: float = 0.0
    sweep: float = 2 * np.pi

    @property
    def full(self) -> bool:
        """Whether it goes all the way round."""
        return self.sweep >= 2 * np.pi

    @property
    def in_words(self) -> str:
        """For people."""
        return "a full circle" if self.full else f"{np.degrees(self.sweep):.0f}° to and fro"

    def camera(self, azimuth: float, width: int, height: int) -> Camera:
        """On the circle, looking at the hub; or from the hub, looking the same way."""
        east, north = ground(self.up)
        level = np.cos(azimuth) * east + np.sin(azimuth) * north
        direction = np.cos(self.elevation) * level + np.sin(self.elevation) * self.up
        place = self.hub + self.reach * direction
        return look_at(place, place - direction, self.up, fov=FIELD_OF_VIEW, width=width, height=height)

    def loop(self, frames: int, width: int, height: int) -> list[Camera]:
        """Cameras of a film that can be repeated without a jolt; equal ones are the same object.

        To and fro is slow at its ends, as a pendulum is.

        Raises:
            InvalidViewsError: there is no frame, or no pixel in it.
        """
        _check(frames, width, height)
        if self.full:
            azimuths = self.middle + np.arange(frames) * (2 * np.pi / frames)
            return [self.camera(float(azimuth), width, height) for azimuth in azimuths]
        phases = [_quarter(frame, frames) for frame in range(frames)]
        swing = {
            phase: self.camera(self.middle + 0.5 * self.sweep * float(np.sin(np.pi * phase / frames)), width, height)
            for phase in sorted(set(phases))
        }
        return [swing[phase] for phase in phases]

    def stops(self, frames: int, width: int, height: int) -> list[Camera]:
        """Cameras of a strip of pictures: evenly along the way, once.

        Raises:
            InvalidViewsError: there is no frame, or no pixel in it.
        """
        _check(frames, width, height)
        if self.full or frames == 1:
            return self.loop(frames, width, height)
        azimuths = self.middle + np.linspace(-0.5, 0.5, frames) * self.sweep
        return [self.camera(float(azimuth), width, height) for azimuth in azimuths]


def find_orbit(
    splats: Splats, *, width: int = 640, height: int = 480, threads: int = 0, progress: Progress = silent
) -> Orbit:
    """The circle with the longest stretch of good views.

    The same scene gives the same circle, whatever the number of threads.

    Args:
        splats: finite (:func:`kissgs.clean`).
        width: of the pictures, pixels; their shape is what counts.
        height: of the pictures, pixels.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: a picture would have no pixel.
    """
    with Workers(threads) as pool:
        scene, critic, tried = score_candidates(splats, (width, height), pool, progress)
        least = tried.scores.max() - GOOD_ENOUGH
        circles = list(_around(splats, scene, width / height) if not tried.whole else _within(scene, tried.enclosed))
        scores = _scores(circles, STEPS, tried, critic)
        best = max(range(len(circles)), key=lambda n: _worth(scores[n] - least, circles[n].reach / scene.radius))
        fine = _scores([circles[best]], FINE_STEPS, tried, critic)[0]
    progress("cameras", 1.0)
    return _stretch(circles[best], fine, least)


def _scores(circles: list[Orbit], steps: int, tried: Tried, critic: ViewScorer) -> Float64[np.ndarray, "circles steps"]:
    """How good the views along each circle are."""
    width, height = tried.cameras[0].width, tried.cameras[0].height
    cameras = [camera for circle in circles for camera in circle.loop(steps, width, height)]
    return tried.scores_for(cameras, critic).reshape(len(circles), steps)


def _within(scene: SceneBounds, enclosed: bool) -> Iterator[Orbit]:
    """Around the middle of a scene with a background; where there is no outside, also looking around in it."""
    for radius in RADII:
        for elevation in ELEVATIONS:
            reach = radius * scene.radius
            yield Orbit(hub=scene.centre, reach=reach, elevation=float(np.radians(elevation)), up=scene.up)
    if enclosed:
        for rise in (0.0, 0.4):
            place = scene.centre + rise * scene.radius * scene.up
            yield Orbit(hub=place, reach=0.0, elevation=float(np.radians(DOWNWARD)), up=scene.up)


def _around(splats: Splats, scene: SceneBounds, aspect: float) -> Iterator[Orbit]:
    """Around what stands alone, so that the upright cylinder about it is never cut off."""
    weights = opacity(splats)
    offsets = splats.means.astype(np.float64) - scene.centre
    axes = np.stack([*ground(scene.up), scene.up])
    along = offsets @ axes.T
    low, high = ([weighted_median(values, weights, share) for values in along.T] for share in (0.01, 0.99))
    middle, half = 0.5 * np.add(high, low), 0.5 * np.subtract(high, low)
    from_axis = np.linalg.norm((along - middle)[:, :2], axis=1)
    wide, tall = (max(size, 0.1 * scene.radius) for size in (weighted_median(from_axis, weights, 0.98), half[2]))
    hub = scene.centre + middle @ axes
    across = np.tan(0.5 * FIELD_OF_VIEW) * np.array([min(1.0, aspect), min(1.0, 1 / aspect)])
    for elevation in np.radians(ELEVATIONS):
        upright = tall * np.cos(elevation) + wide * np.sin(elevation)
        ahead = wide * np.cos(elevation) + tall * np.sin(elevation)
        reach = max(AIR * max(wide / across[0], upright / across[1]), 2 * NEAR) + ahead
        yield Orbit(hub=hub, reach=float(reach), elevation=float(elevation), up=scene.up)


def _worth(surplus: Float64[np.ndarray, " steps"], radius: float) -> tuple[bool, float]:
    """Of a circle with so much above what is good enough at each step; a full one is worth more than any other.

    Four times as long is worth as much as twice as good: the ends of a long stretch are seldom its best.
    """
    good = _good(surplus)
    steps = _longest(good)
    total = (surplus + of_distance(radius)).take(steps, mode="wrap").sum()
    return bool(good.all()), float(total / max(len(steps), 1) ** 0.5)


def _good(surplus: Float64[np.ndarray, " steps"]) -> Bool[np.ndarray, " steps"]:
    """Which steps to take."""
    return np.asarray(surplus >= (-LENIENCE if (surplus >= -LENIENCE).all() else 0))


def _longest(good: Bool[np.ndarray, " steps"]) -> Int[np.ndarray, " stretch"]:
    """The longest stretch of a circle, as the numbers of its steps in their order; it may pass the circle's seam."""
    count = len(good)
    if good.all():
        return np.arange(count)
    begin = int(np.flatnonzero(~good)[0])  # behind something bad no stretch is cut
    turned = np.roll(good, -begin)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], turned, [False]]).astype(np.int8)))
    if not len(edges):
        return np.empty(0, np.int64)
    starts, ends = edges[::2], edges[1::2]
    longest = int((ends - starts).argmax())
    return np.arange(begin + starts[longest], begin + ends[longest])


def _stretch(circle: Orbit, scores: Float64[np.ndarray, " steps"], least: float) -> Orbit:
    """The circle with its good stretch marked."""
    step = 2 * np.pi / len(scores)
    steps = _longest(_good(scores - least))
    if len(steps) == len(scores):
        return replace(circle, middle=step * int(scores.argmax()))
    if len(steps) == 0:
        return replace(circle, middle=step * int(scores.argmax()), sweep=LEAST)
    sweep = max(step * (len(steps) - 1), LEAST)
    return replace(circle, middle=0.5 * step * float(steps[0] + steps[-1]), sweep=sweep)


def _quarter(frame: int, frames: int) -> int:
    """A swing's phase from -frames/2 to frames/2, the same number wherever it is at the same place.

    In quarters: from the middle to one end, back through the middle to the other, and to the middle again.
    """
    if 4 * frame <= frames:
        return 2 * frame
    if 4 * frame <= 3 * frames:
        return frames - 2 * frame
    return 2 * frame - 2 * frames


def _check(frames: int, width: int, height: int) -> None:
    if min(frames, width, height) < 1:
        raise InvalidViewsError(f"at least 1 frame of 1x1 pixels can be had, not {frames} of {width}x{height}")
