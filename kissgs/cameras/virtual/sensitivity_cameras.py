"""From where a scene is watched while it is compressed: where it was photographed from, and a little all around."""

from __future__ import annotations

import numpy as np

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.scene_views import scene_views
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.sensitivity import WeightedCameras

AROUND = 0.3
"""Weight of all virtual cameras together, in units of that of the photographs': what was never photographed must not
fall apart, and hardly anything is lost for what was."""


def sensitivity_cameras(
    splats: Splats,
    views: Views | None,
    *,
    count: int,
    size: int,
    threads: int = 0,
    progress: Progress = silent,
) -> WeightedCameras:
    """Cameras to weigh and to refit by.

    Args:
        splats: finite.
        views: of a capture; its cameras for training are used, never those that are held out. None: virtual ones alone.
        count: the largest number of a capture's cameras, taken evenly; and the number of virtual ones if there are no
            others, of which there are else two thirds as many.
        size: longer side of a picture, pixels; smaller pictures stay as they are.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.
    """
    if views is None or not views.train:
        side = size * 4 // 5
        found = scene_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
        cameras = [_wider(view.camera) if n % 2 else view.camera for n, view in enumerate(found.all)]
        return WeightedCameras(cameras, [1.0] * len(found.all), found.background)
    given = [view.camera for view in views.train]
    chosen = [given[n].at_most(size) for n in np.unique(np.linspace(0, len(given) - 1, count).astype(int))]
    side = round(float(np.sqrt(chosen[0].width * chosen[0].height)))
    around = scene_views(
        splats, width=side, height=side, count=max(1, count * 2 // 3), threads=threads, progress=progress
    )
    weight = AROUND * len(chosen) / len(around.all)
    cameras = [*chosen, *(view.camera for view in around.all)]
    return WeightedCameras(
        cameras, [1.0] * len(chosen) + [weight] * len(around.all), views.background, captured=len(chosen)
    )


WIDER = 0.6
"""Focal length of every other virtual camera, in units of that of the others: what they just do not see counts too."""


def _wider(camera: Camera) -> Camera:
    K = camera.K.copy()
    K[[0, 1], [0, 1]] *= WIDER
    return Camera(camera.viewmat, K, camera.width, camera.height)
