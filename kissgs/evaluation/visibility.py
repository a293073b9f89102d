"""Share of a scene that some views show, from the blending weights of its Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.prominence import prominence
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending
from kissgs.rendering.cpu.frame import Frame, draw
from kissgs.rendering.cpu.gradients import differentiate_footprints

SHOWN_SHARE = 1e-6
"""Share of an image that a Gaussian must exceed to count as shown by it."""

MAX_SIDE = 160
"""Longer side of the images, pixels; larger ones are rendered at this size."""


def blending_weights(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """Return the blending weight of each Gaussian, ``(N,)``, summed over all pixels.

    The weight in a pixel is alpha times the transmittance in front of the Gaussian; with the background's weights, the
    total is the number of pixels.

    Args:
        frame: a rendering, with the lists of Gaussians per tile.
        pool: threads.
    """
    height, width = frame.transmittance.shape
    ones, zeros = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    ones[:, :, 0] = 1  # so the gradient with respect to a red value is the sum of weights
    v_slots, slots, _ = differentiate_footprints(frame, ones, zeros, pool)
    weights = np.zeros(len(frame.splats), np.float64)
    blending.sum_errors(np.ascontiguousarray(v_slots[:, 6]), slots.rows, slots.first, frame.footprints.visible, weights)
    return weights


def share_shown(splats: Splats, cameras: Sequence[Camera], *, threads: int = 0) -> float:
    """Return the share of a scene, 0 to 1, that some cameras show; 1 for a scene without visible Gaussians.

    A Gaussian is shown if it covers more than :data:`SHOWN_SHARE` of an image, and counts by its prominence
    (:func:`kissgs.evaluation.prominence.prominence`). Gaussians hidden behind others in all images are not shown.

    Args:
        splats: the scene, finite.
        cameras: any number of cameras; large ones are reduced to :data:`MAX_SIDE` pixels.
        threads: number of threads; 0 means one per processor.
    """
    counts, plain = prominence(splats), base_colors_only(splats)
    if not counts.any():
        return 1.0
    shown = np.zeros(len(splats), bool)
    with Workers(threads) as pool:
        for camera in cameras:
            small = camera.at_most(MAX_SIDE)
            frame = draw(plain, small, np.zeros(3, np.float32), pool)
            shown |= blending_weights(frame, pool) > SHOWN_SHARE * small.width * small.height
    return float(counts[shown].sum() / counts.sum())


def base_colors_only(splats: Splats) -> Splats:
    """Return the scene without shN, for renderings whose colours do not matter: shN costs as much as all else."""
    return replace(splats, shN=np.empty((len(splats), 0, 3), np.float32))
