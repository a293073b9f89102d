"""``virtual_views``: virtual cameras that show a scene well, for people to look at.

Candidates are scored by thumbnails. A trained scene is sharp from where it was photographed and dissolves elsewhere, so
the good ones lie on the side that was captured. Among these, cameras far from each other are chosen.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from kissgs.cameras.views import View, Views, black
from kissgs.cameras.virtual.candidates import FIELD_OF_VIEW, horizontal_axes
from kissgs.cameras.virtual.scored_candidates import (
    ScoredCandidates,
    normalized_poses,
    pose_distances,
    score_candidates,
)
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera, pinhole

HOLD_OUT = 8
"""One in this many virtual views is held out, starting with the first."""

OVERVIEW_BONUS = 0.5
"""Score of being e times as far from the centre, where one view or one orbit stands for the whole scene."""

MIN_OVERVIEW_RADII = 0.5
"""Distance in radii of the scene below which the overview bonus does not fall further."""


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
    candidates, selected = _select(splats, (width, height), count, threads, progress)
    views = split_views(with_size([candidates.cameras[n] for n in selected], width, height))
    return replace(views, origin=splats.origin)


def best_view(
    splats: Splats,
    *,
    width: int = 640,
    height: int = 480,
    count: int = 32,
    threads: int = 0,
    progress: Progress = silent,
) -> View:
    """Return the one of :func:`virtual_views` that represents the scene best; arguments and errors are the same.

    Besides the view score, distance counts: an overview represents a scene better than a close-up.
    """
    candidates, selected = _select(splats, (width, height), count, threads, progress)
    views = split_views(with_size([candidates.cameras[n] for n in selected], width, height))
    bounds = candidates.bounds
    distances = [float(np.linalg.norm(candidates.cameras[n].position - bounds.centre)) for n in selected]
    scores = candidates.scores[selected] + [overview_bonus(distance / bounds.radius) for distance in distances]
    return views.all[int(scores.argmax())]


def overview_bonus(radii: float) -> float:
    """Return what a distance from the centre, in radii of the scene, adds to a view score where few views are shown."""
    return OVERVIEW_BONUS * float(np.log(max(radii, MIN_OVERVIEW_RADII)))


def select_diverse(candidates: ScoredCandidates, count: int) -> list[int]:
    """Return the indices of ``count`` good candidates that are far from each other, in order of azimuth.

    The first is the best; each further one is the farthest from all that are selected, where distance counts less for
    lower scores. With fewer good candidates than ``count``, the best are taken; with fewer candidates, some repeatedly.
    """
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


def check_request(count: int, size: tuple[int, int]) -> None:
    """Check a number of views and the (width, height) of their images.

    Raises:
        InvalidViewsError: one of them is less than 1.
    """
    if min(*size, count) < 1:
        raise InvalidViewsError(
            f"there must be at least 1 view of at least 1x1 pixels, not {count} of {size[0]}x{size[1]}"
        )


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
    splats: Splats, size: tuple[int, int], count: int, threads: int, progress: Progress
) -> tuple[ScoredCandidates, list[int]]:
    """Return all scored candidates of a scene and the indices of the selected ones."""
    check_request(count, size)
    with Workers(threads) as pool:
        candidates = score_candidates(splats, size, pool, progress).refined(count)
    progress("cameras", 1.0)
    return candidates, select_diverse(candidates, count)
