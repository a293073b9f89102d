"""One image on the CPU: rendering, removal scores and sensitivity, independent of the number of threads.

Sums over several tiles go through slots: one per pair of footprint and tile, numbered footprint by footprint. A tile
writes its own slots, and the slots of a footprint are added in order.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int32, Int64, Shaped
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.resources import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending, sensitivity
from kissgs.rendering.cpu.tiles import (
    Footprints,
    Slots,
    TileLists,
    each_part,
    even,
    even_tiles,
    find_footprints,
    number_slots,
    projection_constants,
    sort_into_tiles,
)

LIMITS = np.array([constants.ALPHA_MIN, constants.ALPHA_MAX, constants.TRANSMITTANCE_MIN], np.float32)
"""Constants of blending, as kernels take them."""

PIXELS_PER_TILE = constants.TILE**2

BAND = 1 << 19
"""Number of members of tiles whose moments are in memory at once."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A rendered image, with the intermediate results that its derivatives and scores need.

    Attributes:
        splats: the scene.
        image: ``(H, W, 3)`` RGB, 0 and up, not clamped to 1.
        transmittance: ``(H, W)`` share of the background that is visible, 1 - alpha.
        camera: the camera.
        background: ``(3,)`` RGB.
        footprints: Gaussians that touch the image, in the order of the scene.
        lists: lists of the footprints that touch each tile.
        stops: ``(tiles, 256)`` index of the first member of the tile that is not drawn at the pixel.
    """

    splats: Splats
    image: Float32[np.ndarray, "H W 3"]
    transmittance: Float32[np.ndarray, "H W"]
    camera: Camera
    background: Float32[np.ndarray, "3"]
    footprints: Footprints
    lists: TileLists
    stops: Int32[np.ndarray, "tiles 256"]


def draw(
    splats: Splats,
    camera: Camera,
    background: Shaped[np.ndarray, "..."],
    pool: Workers,
    end: float = constants.TRANSMITTANCE_MIN,
) -> Frame:
    """Render an image of a finite scene (:func:`kissgs.clean`) by the image model of :mod:`kissgs.rendering.constants`.

    Args:
        splats: the scene.
        camera: the camera.
        background: ``(3,)`` RGB.
        pool: threads; the result does not depend on their number.
        end: transmittance at which the list of a pixel ends; that of the image model by default. A larger one takes
            less time, and shows the background instead of what is behind.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: too many footprints for the lists of tiles, or too little memory for the image.
    """
    try:
        return _draw(for_kernels(splats), camera, _colour(background), pool, end)
    except MemoryError as error:
        size = f"{camera.width}x{camera.height}"
        raise UnsupportedError(f"there is not enough memory for an image of {size}; render a smaller one") from error


def _draw(splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], pool: Workers, end: float) -> Frame:
    footprints = find_footprints(splats, camera, pool)
    lists = sort_into_tiles(footprints, camera, pool)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    transmittance = np.empty((camera.height, camera.width), np.float32)
    stops = np.empty((len(lists.starts) - 1, PIXELS_PER_TILE), np.int32)
    limits = np.array([constants.ALPHA_MIN, constants.ALPHA_MAX, end], np.float32)

    def blend(first: int, last: int) -> None:
        blending.blend(
            footprints.records,
            lists.members,
            lists.spans,
            lists.starts,
            first,
            last,
            camera.width,
            camera.height,
            lists.columns,
            limits,
            background,
            image,
            transmittance,
            stops,
        )

    each_part(blend, even_tiles(lists, pool), pool)
    return Frame(splats, image, transmittance, camera, background, footprints, lists, stops)


def removal_scores(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """Return, for each Gaussian of the scene, the squared change of the image by its removal alone, ``(N,)``.

    A sum over pixels and RGB (GaussianPOP, section 3), exact except for Gaussians behind the end of a pixel's list,
    which a removal may reveal; 0 for Gaussians outside the image.
    """
    lists, (visible, records) = frame.lists, (frame.footprints.visible, frame.footprints.records)
    slots = number_slots(frame.footprints, lists, 0, len(lists.starts) - 1)
    errors = np.empty(len(lists.members), np.float32)

    def blend(first: int, last: int) -> None:
        blending.removal_errors(
            records,
            lists.members,
            lists.spans,
            slots.of,
            lists.starts,
            first,
            last,
            lists.columns,
            LIMITS,
            frame.background,
            frame.transmittance,
            frame.stops,
            errors,
        )

    each_part(blend, even_tiles(lists, pool), pool)
    scores = np.zeros(len(frame.splats), np.float64)
    blending.sum_errors(errors, slots.rows, slots.first, visible, scores)
    return scores


def add_sensitivities(
    frame: Frame, weight: float, spread: float, into: Sensitivity, pool: Workers
) -> Float32[np.ndarray, " N"]:
    """Add the sensitivity in this image, times ``weight``, to ``into``.

    Args:
        frame: a rendered image.
        weight: weight of the squared error of a single value of the image.
        spread: standard deviation of each channel of the background.
        into: sums over images; ``shape_hessian`` receives moments, to be converted by
            :func:`kissgs.rendering.cpu.sensitivity.moments_to_hessians` in the end; both fields of harmonics receive
            sums of (alpha T)² times the spherical harmonics, to be divided by ``color_weight``.
        pool: threads; the result does not depend on their number.

    Returns:
        Sum of (alpha T)² over the pixels of this image, by row of the frame's footprints; rows without a footprint are
        not set.
    """
    splats, camera, lists = frame.splats, frame.camera, frame.lists
    visible, records = frame.footprints.visible, frame.footprints.records
    seen = np.empty(len(visible), np.float32)
    for a, b in frame.footprints.parts:
        seen[a:b] = 0
    for top, bottom in itertools.pairwise(_bands(lists)):
        slots = number_slots(frame.footprints, lists, top, bottom)
        moments = np.empty((len(slots.of), sensitivity.MOMENTS), np.float32)

        def blend(first: int, last: int, slots: Slots = slots, moments: np.ndarray = moments, top: int = top) -> None:
            sensitivity.moments(
                records,
                lists.members,
                lists.spans,
                slots.of,
                lists.starts,
                lists.starts[top],
                first,
                last,
                lists.columns,
                LIMITS,
                frame.background,
                spread,
                frame.transmittance,
                frame.stops,
                moments,
            )

        each_part(blend, even_tiles(lists, pool, top, bottom), pool)

        def project(first: int, last: int, slots: Slots = slots, moments: np.ndarray = moments) -> None:
            sensitivity.add_to_parameters(
                splats.means,
                splats.quats,
                splats.scales,
                visible,
                slots.rows,
                slots.first,
                moments,
                first,
                last,
                camera.viewmat,
                camera.position,
                camera.K,
                camera.width,
                camera.height,
                projection_constants(splats, camera),
                weight,
                into.position_hessian,
                into.shape_hessian,
                into.color_weight,
                into.mean_harmonics,
                into.higher_harmonics,
                seen,
            )

        each_part(project, even(len(slots.rows), pool), pool)
    return seen


def _bands(lists: TileLists) -> Int64[np.ndarray, " edges"]:
    """Return the edges of bands of tiles of about :data:`BAND` members each."""
    edges = np.searchsorted(lists.starts, np.arange(0, lists.starts[-1], BAND))
    return np.unique(np.append(edges, [0, len(lists.starts) - 1]))


def _colour(background: Shaped[np.ndarray, "..."]) -> Float32[np.ndarray, "3"]:
    colour = np.array(background, np.float32, order="C")
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InvalidViewsError("a background must be three finite numbers: red, green and blue, from 0 to 1")
    return colour


def for_kernels(splats: Splats) -> Splats:
    """Return the scene with contiguous, writeable arrays, as kernels need them; copied only where necessary."""
    arrays = {name: np.require(getattr(splats, name), requirements=("C", "W")) for name in ATTRIBUTES}
    return (
        splats if all(array is getattr(splats, name) for name, array in arrays.items()) else replace(splats, **arrays)
    )
