"""One image on the CPU: rendering, removal scores and sensitivity, independent of the number of threads."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int64, Shaped
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending, sensitivity
from kissgs.rendering.cpu.records import Blended, Footprints, Gaussians, Projection, TileLists
from kissgs.rendering.cpu.tiles import (
    Part,
    each_part,
    even,
    even_tiles,
    find_footprints,
    number_slots,
    sort_into_tiles,
)

BAND = 1 << 19
"""Number of members of tiles whose moments are in memory at once."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A rendered image, with the intermediate results that its derivatives and scores need."""

    gaussians: Gaussians
    camera: Camera
    projection: Projection
    footprints: Footprints
    parts: list[Part]
    """Ranges of rows that hold footprints; other rows are not set."""
    lists: TileLists
    blended: Blended

    @property
    def image(self) -> Float32[np.ndarray, "H W 3"]:
        """RGB, 0 and up, not clamped to 1."""
        return self.blended.image

    @property
    def transmittance(self) -> Float32[np.ndarray, "H W"]:
        """Share of the background that is visible, 1 - alpha."""
        return self.blended.transmittance

    def rows(self) -> Int64[np.ndarray, " M"]:
        """Return the rows that hold footprints, ascending."""
        return np.concatenate([np.arange(first, last) for first, last in self.parts])


def draw(
    splats: Splats,
    camera: Camera,
    background: Shaped[np.ndarray, "..."],
    pool: Workers,
    end: float = constants.TRANSMITTANCE_MIN,
) -> Frame:
    """Render an image of a finite scene (:func:`kissgs.clean`) by the image model of :mod:`kissgs.rendering.constants`.

    The list of a pixel ends at the transmittance ``end``. A larger one than that of the image model takes less time,
    and shows the background instead of what is behind.
    """
    colour = np.array(background, np.float32, order="C")
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InvalidViewsError("a background must be three finite numbers: red, green and blue, from 0 to 1")
    try:
        return _draw(for_kernels(splats), camera, colour, pool, end)
    except MemoryError as error:
        size = f"{camera.width}x{camera.height}"
        raise UnsupportedError(f"there is not enough memory for an image of {size}; render a smaller one") from error


def _draw(splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], pool: Workers, end: float) -> Frame:
    gaussians, projection = Gaussians.of(splats), Projection.of(splats, camera)
    footprints, parts = find_footprints(gaussians, projection, pool)
    lists = sort_into_tiles(footprints, parts, projection, pool)
    blended = Blended(
        np.empty((camera.height, camera.width, 3), np.float32),
        np.empty((camera.height, camera.width), np.float32),
        np.empty((len(lists.starts) - 1, constants.TILE**2), np.int32),
        background,
        np.array([constants.ALPHA_MIN, constants.ALPHA_MAX, end], np.float32),
    )
    each_part(
        lambda first, last: blending.blend(footprints.records, lists, first, last, blended),
        even_tiles(lists, pool),
        pool,
    )
    return Frame(gaussians, camera, projection, footprints, parts, lists, blended)


def removal_scores(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """Return, for each Gaussian of the scene, the squared change of the image by its removal alone, ``(N,)``.

    A sum over pixels and RGB (GaussianPOP, section 3), exact except for Gaussians behind the end of a pixel's list,
    which a removal may reveal; 0 for Gaussians outside the image.
    """
    lists, records = frame.lists, frame.footprints.records
    slots, errors = number_slots(lists, len(records)), np.empty(len(lists.members), np.float32)
    each_part(
        lambda first, last: blending.removal_errors(records, lists, slots, first, last, frame.blended, errors),
        even_tiles(lists, pool),
        pool,
    )
    scores = np.zeros(len(records), np.float64)
    blending.sum_errors(errors, slots, frame.footprints.visible, scores)
    return scores


def add_sensitivities(
    frame: Frame, weight: float, spread: float, into: Sensitivity, pool: Workers
) -> Float32[np.ndarray, " N"]:
    """Add the sensitivity in this image to sums over images, ``into``; ``weight``: of a single value's squared error.

    ``spread`` is the standard deviation of each channel of the background. ``shape_hessian`` receives moments, to be
    converted by :func:`kissgs.rendering.cpu.sensitivity.moments_to_hessians` in the end; both fields of harmonics
    receive sums of (alpha T)² times the spherical harmonics, to be divided by ``color_weight``.

    Returns:
        Sum of (alpha T)² over the pixels of this image, by row of the frame's footprints; rows without a footprint are
        not set.
    """
    seen = np.empty(len(frame.footprints.records), np.float32)
    for first, last in frame.parts:
        seen[first:last] = 0
    sums = sensitivity.Sums(
        into.position_hessian,
        into.shape_hessian,
        into.color_weight,
        into.mean_harmonics,
        into.higher_harmonics,
        seen,
    )
    for band in itertools.pairwise(_bands(frame.lists)):
        _add_band(frame, (int(band[0]), int(band[1])), weight, spread, sums, pool)
    return seen


def _add_band(frame: Frame, band: Part, weight: float, spread: float, sums: sensitivity.Sums, pool: Workers) -> None:
    """Add the sensitivity in a band of tiles."""
    lists, footprints = frame.lists, frame.footprints
    slots = number_slots(lists, len(footprints.records), band)
    moments = np.empty((len(slots.of), sensitivity.MOMENTS), np.float32)
    each_part(
        lambda first, last: sensitivity.moments(
            footprints.records, lists, slots, first, last, frame.blended, spread, moments
        ),
        even_tiles(lists, pool, band),
        pool,
    )
    each_part(
        lambda first, last: sensitivity.add_to_parameters(
            frame.gaussians, frame.projection, footprints.visible, slots, moments, first, last, weight, sums
        ),
        even(len(slots.rows), pool),
        pool,
    )


def _bands(lists: TileLists) -> Int64[np.ndarray, " edges"]:
    """Return the edges of bands of tiles of about :data:`BAND` members each."""
    edges = np.searchsorted(lists.starts, np.arange(0, lists.starts[-1], BAND))
    return np.unique(np.append(edges, [0, len(lists.starts) - 1]))


def for_kernels(splats: Splats) -> Splats:
    """Return the scene with contiguous, writeable arrays, as kernels need them; copied only where necessary."""
    arrays = {name: np.require(getattr(splats, name), requirements=("C", "W")) for name in ATTRIBUTES}
    return (
        splats if all(array is getattr(splats, name) for name, array in arrays.items()) else replace(splats, **arrays)
    )
