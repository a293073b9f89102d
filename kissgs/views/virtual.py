"""Virtual cameras: where a visitor would look at a scene from that came without photographs.

Many cameras are tried, on orbits around the scene's middle and inside it, each by a thumbnail of what it would see.
Good ones see sharp things all over the picture, the scene's middle among them, and nothing right before the lens: a
trained scene is sharp from where it was photographed and dissolves elsewhere, so this finds the side that was captured.
Of the good ones, some are chosen that are far from each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float64, Int
from kissgs.errors import InvalidViewsError
from kissgs.parallel import Workers
from kissgs.progress import Progress, silent
from kissgs.rendering.camera import Camera, look_at, pinhole
from kissgs.splats import Splats
from kissgs.views.anatomy import Anatomy, anatomy
from kissgs.views.candidates import FIELD_OF_VIEW, RADII, WAYS_TO_LOOK, around, ground, inside, orbit, turned
from kissgs.views.critic import Critic, Seen, scores_of, sketch_of
from kissgs.views.view import View, Views, black

HOLD_OUT = 8
THUMBNAIL = 64
"""Pixels of the longer side."""

ENCLOSED = 0.85
"""A picture is full of the scene if the scene covers this share of it."""

GOOD_ENOUGH = 0.3
"""How much lower than the best a chosen view may score."""

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
    if min(width, height, count) < 1:
        raise InvalidViewsError(f"at least 1 view of 1x1 pixels can be had, not {count} of {width}x{height}")
    sketch = sketch_of(splats)
    scene = anatomy(sketch)
    shrink = THUMBNAIL / max(width, height)
    small = max(1, round(width * shrink)), max(1, round(height * shrink))
    with Workers(threads) as pool:
        critic = Critic(sketch, scene, pool, progress)
        tried = _try_all(sketch, scene, small, critic)
        for _ in range(ROUNDS):
            if len(tried.good()) >= 2 * count:
                break
            tried = tried.with_more(scene, critic)
    progress("cameras", 1.0)
    K = pinhole(FIELD_OF_VIEW, width, height)
    return _split([Camera(camera.viewmat, K, width, height) for camera in _choose(tried, scene, count)])


@dataclass(frozen=True, slots=True)
class _Tried:
    """Cameras, what they see, and how good that is, 1 at best."""

    cameras: list[Camera]
    seen: list[Seen]
    whole: bool
    """Whether the scene should fill the picture; else it stands alone."""
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

    def with_more(self, scene: Anatomy, critic: Critic) -> _Tried:
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
        return _Tried([*self.cameras, *between], [*self.seen, *critic.judge(between)], self.whole, deduction)


def _try_all(splats: Splats, scene: Anatomy, size: tuple[int, int], critic: Critic) -> _Tried:
    """Within a room or under a sky; before something with a background; or around something that stands alone."""
    within, outer = list(inside(scene, size)), list(orbit(scene, size))
    cameras = [*within, *outer]
    seen = critic.judge(cameras)
    deduction = np.zeros(len(cameras))
    full = np.reshape([view.covered - view.near for view in seen[: len(within)]], (-1, WAYS_TO_LOOK)).mean(axis=1)
    if (full > ENCLOSED).sum() >= 3:
        behind = critic.judge([turned(camera) for camera in cameras])
        deduction[[view.covered < ENCLOSED for view in behind]] = 1
        return _Tried(cameras, seen, True, deduction)
    if np.quantile([view.covered for view in seen[-len(outer) // len(RADII) :]], 0.9) > ENCLOSED:
        return _Tried(cameras, seen, True, deduction)
    cameras = list(around(splats, scene, size))
    return _Tried(cameras, critic.judge(cameras), False, np.zeros(len(cameras)))


def _poses(cameras: list[Camera], scene: Anatomy) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Where cameras stand, in radii of the scene, and where they look."""
    places = np.array([camera.position for camera in cameras]) / scene.radius
    return places, np.array([camera.viewmat[2, :3] for camera in cameras])


def _apart(
    places: Float64[np.ndarray, "n 3"], looks: Float64[np.ndarray, "n 3"], one: int
) -> Float64[np.ndarray, " n"]:
    """How different each pose is from ``one`` of them."""
    return np.asarray(np.linalg.norm(places - places[one], axis=1) + np.linalg.norm(looks - looks[one], axis=1))


def _choose(tried: _Tried, scene: Anatomy, count: int) -> list[Camera]:
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
    ordered = [tried.cameras[good[chosen[n]]] for n in np.argsort(angle, kind="stable")]
    return [ordered[n % len(ordered)] for n in range(count)]


def _split(cameras: list[Camera]) -> Views:
    digits = len(str(len(cameras) - 1))
    views = [View(f"virtual_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]
    test = tuple(view for n, view in enumerate(views) if n % HOLD_OUT == 0 and len(views) > 1)
    train = tuple(view for view in views if view not in test)
    return Views(train, test, black(), f"{len(cameras)} virtual cameras")
