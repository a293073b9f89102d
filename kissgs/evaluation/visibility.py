"""How much of a scene some views show: what every Gaussian adds to their pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.prominence import prominence
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending
from kissgs.rendering.cpu.frame import LIMITS, Frame, draw
from kissgs.rendering.cpu.lists import each_part, even_tiles

LITTLE = 1e-6
"""Share of a picture: a Gaussian that takes up no more of it is not shown by it."""

SIDE = 160
"""Pixels of the longer side of the pictures that tell, at most."""


def weights_of(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """For each of the scene's Gaussians, the sum over all pixels of its weight in their colours.

    That is alpha times the transmittance before it; together with that of the background, the sum is the number of
    pixels.
    """
    lists, footprints = frame.lists, frame.footprints
    height, width = frame.transmittance.shape
    ones, zeros = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    ones[:, :, 0] = 1  # the gradient by a colour's red is then the sum of weights
    slots = np.empty((len(lists.members), 9), np.float32)

    def blend(first: int, last: int) -> None:
        blending.blend_backward(
            *(footprints.records, lists.members, lists.spans, lists.slots, lists.starts, first, last, lists.columns),
            *(LIMITS, frame.background, frame.transmittance, frame.stops, ones, zeros, slots),
        )

    each_part(blend, even_tiles(lists, pool), pool)
    weights = np.zeros(len(frame.splats), np.float64)
    of_slot, visible = np.ascontiguousarray(slots[:, 6]), footprints.visible
    blending.sum_errors(of_slot, lists.slots_from, lists.slot_counts, visible, 0, len(visible), weights)
    return weights


def share_shown(splats: Splats, cameras: Sequence[Camera], *, threads: int = 0) -> float:
    """The share of a scene that some cameras show, from 0 to 1; that of a scene of which nothing can be seen is 1.

    A Gaussian is shown if it takes up more than :data:`LITTLE` of one of the pictures, and counts by what it can show
    (:func:`kissgs.evaluation.prominence.prominence`). What lies hidden behind others from all sides is not shown.
    """
    counts, bare = prominence(splats), without_gloss(splats)
    if not counts.any():
        return 1.0
    shown = np.zeros(len(splats), bool)
    with Workers(threads) as pool:
        for camera in cameras:
            small = camera.at_most(SIDE)
            frame = draw(bare, small, np.zeros(3, np.float32), pool)
            shown |= weights_of(frame, pool) > LITTLE * small.width * small.height
    return float(counts[shown].sum() / counts.sum())


def without_gloss(splats: Splats) -> Splats:
    """The same in base colours alone, for those who do not look at colours: they cost as much as all else."""
    return Splats(
        means=splats.means,
        quats=splats.quats,
        scales=splats.scales,
        opacities=splats.opacities,
        sh0=splats.sh0,
        shN=np.empty((len(splats), 0, 3), np.float32),
    )
