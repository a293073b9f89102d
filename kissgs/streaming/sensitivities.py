"""Sensitivity of the files of a streamed scene.

All cameras see the whole scene: the Gaussians of the file as they are, those of other chunks from a coarse level.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from kissgs.cameras.virtual.sensitivity_cameras import MAX_VIEWS, default_view_count, sensitivity_cameras
from kissgs.core.progress import Progress, silent
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import Splats, concatenate
from kissgs.rendering.camera import Camera
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import EncodeSettings

VIEW_UNCERTAINTY = 0.55
"""Default of the setting ``view_uncertainty``, as for all virtual cameras."""

VIEWS_PER_CHUNK, MOST_VIEWS = 2, 1024
"""Least number of cameras per chunk, because a large scene needs more than the default, which falls with its size; and
the largest number of all cameras, whose choice would take hours."""

MIN_SIZE = 64
"""Smallest side of the images in which coarse levels are measured, pixels."""

REACH = 1.3
"""Size of the image in which a sampled Gaussian counts as seen, in units of the image's."""


def choose_cameras(scene: Splats, chunks: int, count: int, settings: EncodeSettings, threads: int) -> WeightedCameras:
    """Return the cameras that see a scene, given by its coarsest level.

    Args:
        scene: the coarsest level.
        chunks: number of chunks.
        count: number of Gaussians of the finest level.
        settings: settings of the encoder.
        threads: number of threads; 0 means one per processor.
    """
    views = settings.sensitivity_views or max(default_view_count(count), min(MOST_VIEWS, VIEWS_PER_CHUNK * chunks))
    return sensitivity_cameras(scene, None, count=views, size=settings.sensitivity_view_size, threads=threads)


def cameras_json(cameras: WeightedCameras) -> dict[str, Any]:
    """Return the cameras as JSON; :func:`cameras_of` reads it."""
    return {
        "background": cameras.background.tolist(),
        "cameras": [
            {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "size": [camera.width, camera.height]}
            for camera in cameras.cameras
        ],
    }


def cameras_of(document: dict[str, Any]) -> WeightedCameras:
    """Return cameras of equal weight from their JSON."""
    cameras = [
        Camera(np.array(camera["viewmat"]), np.array(camera["K"]), *camera["size"]) for camera in document["cameras"]
    ]
    return WeightedCameras(cameras, [1.0] * len(cameras), np.array(document["background"], np.float32))


def measure_file(
    splats: Splats,
    others: Splats,
    cameras: WeightedCameras,
    level: int,
    settings: EncodeSettings,
    threads: int,
    progress: Progress = silent,
) -> Sensitivity:
    """Measure the sensitivity of the Gaussians of a file, as part of the whole scene.

    Args:
        splats: the Gaussians of the file.
        others: those of other chunks, from a coarse level.
        cameras: cameras that see the scene.
        level: level of the file. A level of half the Gaussians is meant for images of half the size.
        settings: settings of the encoder.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage "sensitivity".
    """
    size = max(MIN_SIZE, settings.sensitivity_view_size >> level)
    shown = [_shown(camera, splats) for camera in cameras.cameras]
    best = sorted(np.argsort(np.negative(shown), kind="stable")[:MAX_VIEWS])  # else each file would take more and more
    seeing = [cameras.cameras[n].at_most(size) for n in best if shown[n] > 0]
    if not seeing:
        return Sensitivity.none(len(splats), splats.sh_degree)
    uncertainty = VIEW_UNCERTAINTY if settings.view_uncertainty is None else settings.view_uncertainty
    found = measure_sensitivity(
        concatenate([splats, others]),
        WeightedCameras(seeing, [1.0] * len(seeing), cameras.background),
        view_uncertainty=uncertainty,
        threads=threads,
        progress=progress,
    )
    own = _rows(found, slice(len(splats)))
    share = np.float32(len(seeing) / len(cameras.cameras))  # the mean is over the images of all cameras
    for values in (own.position_hessian, own.shape_hessian, own.color_weight, own.prior):
        values *= share
    return own


def _shown(camera: Camera, splats: Splats) -> float:
    """Return how large sampled Gaussians in the image, or a little outside, appear in it; 0 if there is none."""
    points = splats.means[:: max(1, len(splats) // 4096)].astype(np.float64) @ camera.viewmat[:3, :3].T
    points += camera.viewmat[:3, 3]
    ahead = points[points[:, 2] > 0]
    pixels = ahead[:, :2] / ahead[:, 2:] * camera.K[[0, 1], [0, 1]]
    inside = (np.abs(pixels) < REACH / 2 * np.array([camera.width, camera.height])).all(axis=1)
    return float(np.square(camera.K[0, 0] / ahead[inside, 2]).sum())


def _rows(sensitivity: Sensitivity, rows: slice) -> Sensitivity:
    arrays = [field.name for field in fields(Sensitivity) if field.name != "view_uncertainty"]
    return replace(sensitivity, **{name: getattr(sensitivity, name)[rows] for name in arrays})
