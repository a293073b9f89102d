"""``virtual_views``: virtual cameras that show a scene well, for people to look at."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from kissgs.cameras.views import View, Views, black, check_images
from kissgs.cameras.virtual.candidates import (
    FIELD_OF_VIEW,
    INSIDE_DIRECTIONS,
    ORBIT_RADII,
    SceneBounds,
    ViewScorer,
    ViewStats,
    horizontal_axes,
    inside_cameras,
    object_cameras,
    orbit_cameras,
    proxy_scene,
    reversed_camera,
    scene_bounds,
    view_scores,
)
from kissgs.core.array_types import Float64, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress, silent
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at, pinhole

# Which candidates suit depends on the kind of scene. Inside a room or under a sky, cameras must stay within what
# encloses them; before a background, the image should be full; an object that stands alone is framed from all sides.

THUMBNAIL_SIZE = 64  # longer side of a thumbnail, pixels
FULL_ALPHA = 0.85  # an image is full if its mean alpha is above this
SCORE_MARGIN = 0.3  # how much lower than the best a camera may score to be chosen
MAX_REFINEMENTS = 3  # largest number of times that cameras between good ones are added where good ones are few
NEIGHBOURS = 4  # number of the nearest good cameras towards each of which a camera is added

SceneKind = Literal["enclosed", "background", "object"]
"""A room or a scene under a sky, seen from inside; a scene before a background; an object that stands alone."""


@dataclass(frozen=True, slots=True, eq=False)
class ScoredCandidates:
    """Candidate cameras with what is needed to compare their views."""

    scorer: ViewScorer  # measures further views on the same scale
    kind: SceneKind
    cameras: list[Camera]  # one or more, with the size of thumbnails
    stats: list[ViewStats]
    outside_penalty: Float64[np.ndarray, " n"]  # 1 for cameras outside of what encloses the scene, else 0

    @property
    def bounds(self) -> SceneBounds:
        """Bounds of the scene, or of the region."""
        return self.scorer.bounds

    @property
    def scores(self) -> Float64[np.ndarray, " n"]:
        """View scores, at most 1."""
        return view_scores(self.stats, fills_image=self.kind != "object") - self.outside_penalty

    def good(self) -> Int[np.ndarray, " good"]:
        """Return the indices of the cameras that score at most :data:`SCORE_MARGIN` less than the best."""
        scores = self.scores
        return np.flatnonzero(scores >= scores.max() - SCORE_MARGIN)

    def scores_of(self, cameras: list[Camera]) -> Float64[np.ndarray, " more"]:
        """Return the view scores of other cameras, on the same scale."""
        penalty = _outside_penalty(cameras, self.scorer) if self.kind == "enclosed" else np.zeros(len(cameras))
        stats = [*self.stats, *self.scorer.measure(cameras)]
        return view_scores(stats, fills_image=self.kind != "object")[len(self.stats) :] - penalty

    def refined(self, count: int) -> ScoredCandidates:
        """Return the candidates with cameras between good ones added, until twice ``count`` are good, if possible."""
        candidates = self
        for _ in range(MAX_REFINEMENTS):
            if len(candidates.good()) >= 2 * count:
                break
            candidates = candidates._with_midpoints()
        return candidates

    def _with_midpoints(self) -> ScoredCandidates:
        """Return the candidates with one more half-way between each good camera and its nearest good neighbours."""
        good = self.good()
        positions, forward = normalized_poses([self.cameras[n] for n in good], self.bounds)
        pairs = set()
        for n in range(len(good)):
            nearest = np.argsort(pose_distances(positions, forward, n), kind="stable")[1 : NEIGHBOURS + 1]
            pairs |= {(min(n, int(other)), max(n, int(other))) for other in nearest}
        width, height = self.cameras[0].width, self.cameras[0].height
        added = []
        for one, other in sorted(pairs):
            position = 0.5 * (positions[one] + positions[other]) * self.bounds.radius
            target = position + forward[one] + forward[other]
            added.append(look_at(position, target, self.bounds.up, fov=FIELD_OF_VIEW, width=width, height=height))
        return ScoredCandidates(
            self.scorer,
            self.kind,
            [*self.cameras, *added],
            [*self.stats, *self.scorer.measure(added)],
            np.concatenate([self.outside_penalty, np.zeros(len(added))]),
        )


def score_candidates(splats: Splats, size: tuple[int, int], pool: Workers, progress: Progress) -> ScoredCandidates:
    """Return some hundred candidate cameras of a scene, with their view scores."""
    check_images(1, *size)
    proxy = proxy_scene(splats)
    bounds = scene_bounds(proxy)
    scale = THUMBNAIL_SIZE / max(size)
    thumbnail_size = max(1, round(size[0] * scale)), max(1, round(size[1] * scale))
    scorer = ViewScorer(proxy, bounds, pool, progress)
    inside, orbits = list(inside_cameras(bounds, thumbnail_size)), list(orbit_cameras(bounds, thumbnail_size))
    cameras = [*inside, *orbits]
    stats = scorer.measure(cameras)
    # Enclosed if images are full in all directions from three or more positions inside the scene.
    clear = np.reshape([view.alpha - view.near for view in stats[: len(inside)]], (-1, INSIDE_DIRECTIONS)).mean(axis=1)
    if (clear > FULL_ALPHA).sum() >= 3:
        return ScoredCandidates(scorer, "enclosed", cameras, stats, _outside_penalty(cameras, scorer))
    if _has_background(stats[len(inside) :], thumbnail_size, scorer):
        return ScoredCandidates(scorer, "background", cameras, stats, np.zeros(len(cameras)))
    cameras = list(object_cameras(proxy, bounds, thumbnail_size))
    return ScoredCandidates(scorer, "object", cameras, scorer.measure(cameras), np.zeros(len(cameras)))


def _has_background(orbits: list[ViewStats], size: tuple[int, int], scorer: ViewScorer) -> bool:
    """Whether a tenth of the images from the largest orbit are full; an object may fill portrait images alone."""

    def fills(stats: list[ViewStats]) -> bool:
        return bool(np.quantile([view.alpha for view in stats], 0.9) > FULL_ALPHA)

    outermost = len(orbits) // len(ORBIT_RADII)
    if not fills(orbits[-outermost:]) or size[0] >= size[1]:
        return fills(orbits[-outermost:])
    landscape = list(orbit_cameras(scorer.bounds, (size[1], size[0])))
    return fills(scorer.measure(landscape[-outermost:]))


def _outside_penalty(cameras: list[Camera], scorer: ViewScorer) -> Float64[np.ndarray, " n"]:
    """Return 1 for each camera that sees a gap when it is turned around: it is outside the enclosing scene; else 0."""
    behind = scorer.measure([reversed_camera(camera) for camera in cameras])
    return np.array([float(view.alpha < FULL_ALPHA) for view in behind])


def normalized_poses(
    cameras: list[Camera], bounds: SceneBounds
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Return positions in radii of the scene and unit viewing directions of cameras."""
    positions = np.array([camera.position for camera in cameras]) / bounds.radius
    return positions, np.array([camera.viewmat[2, :3] for camera in cameras])


def pose_distances(
    positions: Float64[np.ndarray, "n 3"], forward: Float64[np.ndarray, "n 3"], index: int
) -> Float64[np.ndarray, " n"]:
    """Return how far each of :func:`normalized_poses` is from one of them: radii plus change of direction."""
    to_position = np.linalg.norm(positions - positions[index], axis=1)
    return np.asarray(to_position + np.linalg.norm(forward - forward[index], axis=1))


# Candidates are scored by thumbnails. A trained scene is sharp from where it was photographed and dissolves elsewhere,
# so the good ones lie on the side that was captured. Among these, cameras far from each other are chosen.

HOLD_OUT = 8  # one in this many virtual views is held out, starting with the first
OVERVIEW_BONUS = 0.5  # of being e times as far from the centre, where one view or orbit stands for the scene
MIN_OVERVIEW_RADII = 0.5  # distance in radii of the scene below which the overview bonus does not fall further


def virtual_views(
    splats: Splats,
    *,
    width: int = 640,
    height: int = 480,
    count: int = 32,
    threads: int = 0,
    progress: Progress = silent,
) -> Views:
    """Return views around or inside a scene; every 8th in the order of names is held out.

    The result is the same for any number of threads.

    Args:
        splats: the scene, finite (:func:`kissgs.clean`).
        width: of the images, pixels.
        height: of the images, pixels.
        count: number of views, 1 or more. A scene with fewer good candidates has some cameras several times.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: ``count``, ``width`` or ``height`` is less than 1.
    """
    _, _, views = _select(splats, (width, height), count, Context(threads, progress=progress))
    return replace(views, origin=splats.origin)


def best_view(splats: Splats, context: Context = DEFAULT_CONTEXT, *, width: int, height: int) -> View:
    """Return the one of :func:`virtual_views` that represents the scene best, by view score and distance."""
    candidates, selected, views = _select(splats, (width, height), 32, context)
    bounds = candidates.bounds
    distances = [float(np.linalg.norm(candidates.cameras[n].position - bounds.centre)) for n in selected]
    scores = candidates.scores[selected] + [overview_bonus(distance / bounds.radius) for distance in distances]
    return views.all[int(scores.argmax())]


def overview_bonus(radii: float) -> float:
    """Return what a distance from the centre, in radii of the scene, adds to a view score where few views are shown."""
    return OVERVIEW_BONUS * float(np.log(max(radii, MIN_OVERVIEW_RADII)))


def select_diverse(candidates: ScoredCandidates, count: int) -> list[int]:
    """Return the indices of ``count`` good candidates that are far from each other, in order of azimuth. Starting with
    the best, each further one is the farthest from all that are selected, where distance counts less for lower scores.
    Of fewer than ``count``, some are returned repeatedly."""
    scores, good = candidates.scores, candidates.good()
    if len(good) < count:
        good = np.argsort(-scores, kind="stable")[:count]
    positions, forward = normalized_poses([candidates.cameras[n] for n in good], candidates.bounds)
    selected = [int(scores[good].argmax())]
    nearest_selected = np.full(len(good), np.inf)
    while len(selected) < min(count, len(good)):
        nearest_selected = np.minimum(nearest_selected, pose_distances(positions, forward, selected[-1]))
        selected.append(int((nearest_selected * (1 + scores[good] - scores.max())).argmax()))
    east, north = horizontal_axes(candidates.bounds.up)
    azimuths = [float(np.arctan2(forward[n] @ north, forward[n] @ east)) for n in selected]
    ordered = [int(good[selected[n]]) for n in np.argsort(azimuths, kind="stable")]
    return [ordered[n % len(ordered)] for n in range(count)]


def with_size(cameras: list[Camera], width: int, height: int) -> list[Camera]:
    """Return cameras at the same poses with images of ``width`` x ``height`` pixels, and the default field of view."""
    K = pinhole(FIELD_OF_VIEW, width, height)
    return [Camera(camera.viewmat, K, width, height) for camera in cameras]


def split_views(cameras: list[Camera]) -> Views:
    """Return numbered views over black, at least one; every 8th is held out, unless it is the only one."""
    digits = len(str(len(cameras) - 1))
    views = [View(f"virtual_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]
    test = tuple(view for n, view in enumerate(views) if n % HOLD_OUT == 0 and len(views) > 1)
    train = tuple(view for view in views if view not in test)
    return Views(train, test, black(), f"{len(cameras)} virtual cameras")


def _select(
    splats: Splats, size: tuple[int, int], count: int, context: Context
) -> tuple[ScoredCandidates, list[int], Views]:
    """Return all scored candidates of a scene, the indices of the selected ones, and their views."""
    check_images(count, *size)
    with Workers(context.threads) as pool:
        candidates = score_candidates(splats, size, pool, context.progress).refined(count)
    context.progress("cameras", 1.0)
    selected = select_diverse(candidates, count)
    return candidates, selected, split_views(with_size([candidates.cameras[n] for n in selected], *size))
