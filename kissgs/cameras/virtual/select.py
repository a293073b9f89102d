"""Virtual cameras: where a visitor would look at a scene from that came without photographs.

Many cameras are tried, on orbits around the scene's middle and inside it, each by a thumbnail of what it would see.
Good ones see sharp things all over the picture, the scene's middle among them, and nothing right before the lens: a
trained scene is sharp from where it was photographed and dissolves elsewhere, so this finds the side that was captured.
Of the good ones, some are chosen that are far from each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.cameras.views import View, Views, black
from kissgs.cameras.virtual.candidates import FIELD_OF_VIEW, RADII, WAYS_TO_LOOK, around, ground, inside, orbit, turned
from kissgs.cameras.virtual.scene_bounds import SceneBounds, scene_bounds
from kissgs.cameras.virtual.scoring import ViewScorer, ViewStats, scores_of, sketch_of
from kissgs.core.array_types import Float64, Int
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera, look_at, pinhole

HOLD_OUT = 8
THUMBNAIL = 64
"""Pixels of the longer side."""

ENCLOSED = 0.85
"""A picture is full of the scene if the scene covers this share of it."""

GOOD_ENOUGH = 0.3
"""How much lower than the best a chosen view may score."""

OVERVIEW = 0.5
"""What e times the distance is worth where one view stands for the whole scene."""

ROUNDS = 3
"""Of trying more cameras between good ones, where these are few."""


def virtual_views(
    splats: Splats,
    *,
    width: int = 640,
    height: int = 480,
    count: int = 32,
    threads: int = 0,
    progress: Progress = silent,
) -> Views:
    """Cameras around or inside a scene; every 8th, in the order of their names, is for testing.

    The same scene gives the same cameras, whatever the number of threads.

    Args:
        splats: finite (:func:`kissgs.clean`).
        width: of the pictures, pixels.
        height: of the pictures, pixels.
        count: how many views.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: less than one view, or pictures of less than one pixel, are asked for.
    """
    _, tried, chosen = _find(splats, (width, height), count, threads, progress)
    return split_views(sized([tried.cameras[n] for n in chosen], width, height))


def best_view(
    splats: Splats,
    *,
    width: int = 640,
    height: int = 480,
    count: int = 32,
    threads: int = 0,
    progress: Progress = silent,
) -> View:
    """The one of :func:`virtual_views`, from the same arguments, to show where only one is shown.

    Good as they are, and from some distance: what shows more of the scene stands for it better than a close-up.
    """
    scene, tried, chosen = _find(splats, (width, height), count, threads, progress)
    views = split_views(sized([tried.cameras[n] for n in chosen], width, height))
    distances = [float(np.linalg.norm(tried.cameras[n].position - scene.centre)) for n in chosen]
    scores = tried.scores[chosen] + [of_distance(distance / scene.radius) for distance in distances]
    return views.all[int(scores.argmax())]


def of_distance(radii: float) -> float:
    """What it adds to a view's score, where few are shown, to be so far from the scene's middle."""
    return OVERVIEW * float(np.log(max(radii, 0.5)))


def score_candidates(
    splats: Splats, size: tuple[int, int], pool: Workers, progress: Progress
) -> tuple[SceneBounds, ViewScorer, Tried]:
    """Look a scene over by thumbnails in the shape of a picture of ``size``, (width, height).

    Returns:
        What the scene is like, who judges its views, and those that were judged for a start.

    Raises:
        InvalidViewsError: such a picture has no pixel.
    """
    if min(size) < 1:
        raise InvalidViewsError(f"a picture has at least 1x1 pixels, not {size[0]}x{size[1]}")
    sketch = sketch_of(splats)
    scene = scene_bounds(sketch)
    shrink = THUMBNAIL / max(size)
    small = max(1, round(size[0] * shrink)), max(1, round(size[1] * shrink))
    critic = ViewScorer(sketch, scene, pool, progress)
    return scene, critic, _try_all(sketch, scene, small, critic)


def _find(
    splats: Splats, size: tuple[int, int], count: int, threads: int, progress: Progress
) -> tuple[SceneBounds, Tried, list[int]]:
    """What the scene is like, all that was tried, and the chosen ones of it."""
    check_wanted(count, size)
    with Workers(threads) as pool:
        scene, critic, tried = score_candidates(splats, size, pool, progress)
        for _ in range(ROUNDS):
            if len(tried.good()) >= 2 * count:
                break
            tried = tried.with_more(scene, critic)
    progress("cameras", 1.0)
    return scene, tried, choose(tried, scene, count)


def check_wanted(count: int, size: tuple[int, int]) -> None:
    """Refuse to choose no view, or views without a pixel; ``size`` is (width, height).

    Raises:
        InvalidViewsError: it is refused.
    """
    if min(*size, count) < 1:
        raise InvalidViewsError(f"at least 1 view of 1x1 pixels can be had, not {count} of {size[0]}x{size[1]}")


def sized(cameras: list[Camera], width: int, height: int) -> list[Camera]:
    """The same poses with images of another size, ``FIELD_OF_VIEW`` along the longer side."""
    K = pinhole(FIELD_OF_VIEW, width, height)
    return [Camera(camera.viewmat, K, width, height) for camera in cameras]


@dataclass(frozen=True, slots=True)
class Tried:
    """Cameras, what they see, and how good that is, 1 at best."""

    cameras: list[Camera]
    seen: list[ViewStats]
    whole: bool
    """Whether the scene should fill the picture; else it stands alone."""
    enclosed: bool
    """Whether the cameras are within a room or under a sky."""
    outside: Float64[np.ndarray, " n"]
    """Deduction for cameras outside of what encloses the scene."""

    @property
    def scores(self) -> Float64[np.ndarray, " n"]:
        """One for each."""
        return scores_of(self.seen, whole=self.whole) - self.outside

    def good(self) -> Int[np.ndarray, " good"]:
        """Which are good enough."""
        scores = self.scores
        return np.flatnonzero(scores >= scores.max() - GOOD_ENOUGH)

    def scores_for(self, cameras: list[Camera], critic: ViewScorer) -> Float64[np.ndarray, " more"]:
        """How good others are, on the same scale."""
        deduction = _outside(cameras, critic) if self.enclosed else np.zeros(len(cameras))
        seen = [*self.seen, *critic.judge(cameras)]
        return scores_of(seen, whole=self.whole)[len(self.seen) :] - deduction

    def with_more(self, scene: SceneBounds, critic: ViewScorer) -> Tried:
        """And those half-way between each good one and the good ones nearest to it."""
        good = self.good()
        places, looks = _poses([self.cameras[n] for n in good], scene)
        pairs = set()
        for n in range(len(good)):
            nearest = np.argsort(_apart(places, looks, n), kind="stable")[1:5]
            pairs |= {(min(n, int(other)), max(n, int(other))) for other in nearest}
        first = self.cameras[0]
        between = []
        for one, other in sorted(pairs):
            place = 0.5 * (places[one] + places[other]) * scene.radius
            target = place + looks[one] + looks[other]
            between.append(look_at(place, target, scene.up, fov=FIELD_OF_VIEW, width=first.width, height=first.height))
        deduction = np.concatenate([self.outside, np.zeros(len(between))])
        seen = [*self.seen, *critic.judge(between)]
        return Tried([*self.cameras, *between], seen, self.whole, self.enclosed, deduction)


def _try_all(splats: Splats, scene: SceneBounds, size: tuple[int, int], critic: ViewScorer) -> Tried:
    """Within a room or under a sky; before something with a background; or around something that stands alone."""
    within, outer = list(inside(scene, size)), list(orbit(scene, size))
    cameras = [*within, *outer]
    seen = critic.judge(cameras)
    full = np.reshape([view.covered - view.near for view in seen[: len(within)]], (-1, WAYS_TO_LOOK)).mean(axis=1)
    if (full > ENCLOSED).sum() >= 3:
        return Tried(cameras, seen, True, True, _outside(cameras, critic))
    far = len(outer) // len(RADII)
    filled = float(np.quantile([view.covered for view in seen[-far:]], 0.9))
    if filled > ENCLOSED and size[0] < size[1]:  # what stands alone may fill a narrow picture
        across = critic.judge(list(orbit(scene, (size[1], size[0])))[-far:])
        filled = float(np.quantile([view.covered for view in across], 0.9))
    if filled > ENCLOSED:
        return Tried(cameras, seen, True, False, np.zeros(len(cameras)))
    cameras = list(around(splats, scene, size))
    return Tried(cameras, critic.judge(cameras), False, False, np.zeros(len(cameras)))


def _outside(cameras: list[Camera], critic: ViewScorer) -> Float64[np.ndarray, " n"]:
    """1 for cameras behind which the scene has an end."""
    behind = critic.judge([turned(camera) for camera in cameras])
    return np.array([float(view.covered < ENCLOSED) for view in behind])


def _poses(cameras: list[Camera], scene: SceneBounds) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Where cameras stand, in radii of the scene, and where they look."""
    places = np.array([camera.position for camera in cameras]) / scene.radius
    return places, np.array([camera.viewmat[2, :3] for camera in cameras])


def _apart(
    places: Float64[np.ndarray, "n 3"], looks: Float64[np.ndarray, "n 3"], one: int
) -> Float64[np.ndarray, " n"]:
    """How different each pose is from ``one`` of them."""
    return np.asarray(np.linalg.norm(places - places[one], axis=1) + np.linalg.norm(looks - looks[one], axis=1))


def choose(tried: Tried, scene: SceneBounds, count: int) -> list[int]:
    """Among the good ones: the best, then always the one farthest from all chosen; in the order of going round."""
    scores, good = tried.scores, tried.good()
    if len(good) < count:
        good = np.argsort(-scores, kind="stable")[:count]
    places, looks = _poses([tried.cameras[n] for n in good], scene)
    chosen = [int(scores[good].argmax())]
    apart = np.full(len(good), np.inf)
    while len(chosen) < min(count, len(good)):
        apart = np.minimum(apart, _apart(places, looks, chosen[-1]))
        chosen.append(int((apart * (1 + scores[good] - scores.max())).argmax()))
    east, north = ground(scene.up)
    angle = [float(np.arctan2(looks[n] @ north, looks[n] @ east)) for n in chosen]
    ordered = [int(good[chosen[n]]) for n in np.argsort(angle, kind="stable")]
    return [ordered[n % len(ordered)] for n in range(count)]


def split_views(cameras: list[Camera]) -> Views:
    """Named by number; every 8th is for testing, unless it is the only one."""
    digits = len(str(len(cameras) - 1))
    views = [View(f"virtual_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]
    test = tuple(view for n, view in enumerate(views) if n % HOLD_OUT == 0 and len(views) > 1)
    train = tuple(view for view in views if view not in test)
    return Views(train, test, black(), f"{len(cameras)} virtual cameras")
