"""``sensitivity_cameras``: cameras that sensitivity and the colour refit see a scene from.

These are a capture's cameras and some virtual ones around the scene, or virtual ones alone.
"""

from __future__ import annotations

import numpy as np

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.scene_views import scene_views
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.sensitivity import WeightedCameras

VIRTUAL_WEIGHT = 0.3
"""Weight of all virtual cameras together, relative to all cameras of a capture. Parts that no photograph shows must not
fall apart, and the photographed parts lose almost nothing by it."""

WIDE_FOCAL_SCALE = 0.6
"""Focal length of every other virtual camera, relative to the others: parts just outside their images count too."""

MAX_VIEWS, MIN_VIEWS = 48, 16
"""Largest and smallest number of cameras that are chosen by the size of the scene."""

FEW_GAUSSIANS = 150_000
"""Number of Gaussians up to which there are :data:`MAX_VIEWS`."""


def default_view_count(gaussians: int) -> int:
    """Return how many cameras measure a scene of so many Gaussians.

    The number falls with the fourth root: in a large scene, errors of single Gaussians matter less.
    """
    return round(min(max(MAX_VIEWS * (FEW_GAUSSIANS / max(gaussians, 1)) ** 0.25, MIN_VIEWS), MAX_VIEWS))


def sensitivity_cameras(
    splats: Splats,
    views: Views | None,
    *,
    count: int,
    size: int,
    threads: int = 0,
    progress: Progress = silent,
) -> WeightedCameras:
    """Return the cameras, each with its weight, that measure sensitivity and refit colours.

    Args:
        splats: the scene, finite (:func:`kissgs.clean`).
        views: views of a capture; only training views are used, never held-out ones. None, or no training views: only
            virtual cameras are used.
        count: largest number of a capture's cameras, evenly selected, to which two thirds as many virtual ones are
            added; without a capture, the number of virtual cameras. 1 or more.
        size: longer side of the images, pixels; a capture's smaller images keep their size, larger ones are sampled.
        threads: number of threads; 0 means one per processor.
        progress: receives the stage ``"cameras"``.

    Raises:
        InvalidViewsError: ``count`` or ``size`` is too small for a view.
    """
    if views is None or not views.train:
        side = size * 4 // 5
        virtual = scene_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
        cameras = [_widened(view.camera) if n % 2 else view.camera for n, view in enumerate(virtual.all)]
        return WeightedCameras(cameras, [1.0] * len(virtual.all), virtual.background)
    captured = [view.camera for view in views.train]
    chosen = np.unique(np.linspace(0, len(captured) - 1, count).astype(int))
    selected = [captured[n].sampled_at_most(size) for n in chosen]  # virtual cameras see what is between the samples
    side = round(float(np.sqrt(selected[0].width * selected[0].height)))
    virtual = scene_views(
        splats, width=side, height=side, count=max(1, count * 2 // 3), threads=threads, progress=progress
    )
    weight = VIRTUAL_WEIGHT * len(selected) / len(virtual.all)
    cameras = [*selected, *(view.camera for view in virtual.all)]
    weights = [1.0] * len(selected) + [weight] * len(virtual.all)
    return WeightedCameras(cameras, weights, views.background, captured=len(selected))


def _widened(camera: Camera) -> Camera:
    """Return the camera with a shorter focal length, that is, a wider field of view."""
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= WIDE_FOCAL_SCALE
    return Camera(camera.viewmat, K, camera.width, camera.height)
