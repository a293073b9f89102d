"""One image on the CPU: rendering, removal scores, sensitivity and gradients, independent of the number of threads."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int32, Shaped
from kissgs.core.context import Workers
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending, sensitivity
from kissgs.rendering.cpu.projection import add_colors, project_backward, shade_backward
from kissgs.rendering.cpu.records import Blended, Frame, Gaussians, Projection, Slots
from kissgs.rendering.cpu.tiles import Part, each_part, even, even_tiles, find_footprints, number_slots, sort_into_tiles

BAND = 1 << 19  # number of members of tiles whose moments are in memory at once


def draw(
    splats: Splats,
    camera: Camera,
    background: Shaped[np.ndarray, "..."],
    pool: Workers,
    end: float = constants.TRANSMITTANCE_MIN,
) -> Frame:
    """Render an image of a finite scene (:func:`kissgs.clean`) by the image model of :mod:`kissgs.rendering.constants`.
    Beyond the transmittance ``end``, the background is shown instead of what is behind."""
    colour = np.array(background, np.float32, order="C")
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InvalidViewsError("a background must be three finite numbers: red, green and blue, from 0 to 1")
    try:
        gaussians, projection = Gaussians.of(for_kernels(splats)), Projection.of(splats, camera)
        footprints, parts = find_footprints(gaussians, projection, pool)
        lists = sort_into_tiles(footprints, parts, projection, pool)
        image = np.empty((camera.height, camera.width, 3), np.float32)
        transmittance = np.empty((camera.height, camera.width), np.float32)
        stops = np.empty((len(lists.starts) - 1, constants.TILE**2), np.int32)
        limits = np.array([constants.ALPHA_MIN, constants.ALPHA_MAX, end], np.float32)
        blended = Blended(image, transmittance, stops, colour, limits)
        frame = Frame(gaussians, projection, footprints, np.array(parts), lists, blended)
        each_part(lambda first, last: blending.blend(frame, first, last), even_tiles(lists, pool), pool)
    except MemoryError as error:
        size = f"{camera.width}x{camera.height}"
        raise UnsupportedError(f"there is not enough memory for an image of {size}; render a smaller one") from error
    return frame


def _each_tile(
    kernel: Callable[..., None], frame: Frame, slots: Slots, pool: Workers, *arguments: object, band: Part | None = None
) -> None:
    """Call a kernel for all tiles, or for a band of them, in threads."""
    tiles = even_tiles(frame.lists, pool, band)
    each_part(lambda first, last: kernel(frame, slots, first, last, *arguments), tiles, pool)


def _each_footprint(kernel: Callable[..., None], frame: Frame, slots: Slots, pool: Workers, *arguments: object) -> None:
    """Call a kernel for all footprints with slots, in threads."""
    rows = even(len(slots.rows), pool)
    each_part(lambda first, last: kernel(frame, slots, first, last, *arguments), rows, pool)


def removal_scores(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """Return the squared change of the image by each Gaussian's removal; see :func:`rasterizer.removal_scores`."""
    slots = number_slots(frame.lists, len(frame.gaussians.means))
    errors = np.zeros(len(frame.lists.members), np.float32)
    _each_tile(blending.removal_errors, frame, slots, pool, errors)
    return sums_of_slots(frame, slots, errors)


def sums_of_slots(frame: Frame, slots: Slots, values: Float32[np.ndarray, " slots"]) -> Float64[np.ndarray, " N"]:
    """Return, for each Gaussian of the scene, the sum of the values in its slots."""
    sums = np.zeros(len(frame.footprints.records), np.float64)
    blending.sum_slots(values, slots, frame.footprints.visible, sums)
    return sums


def add_sensitivities(
    frame: Frame, weight: float, spread: float, into: Sensitivity, pool: Workers
) -> Float32[np.ndarray, " N"]:
    """Add the sensitivity in this image to ``into``, and return the sum of (alpha T)² over its pixels by footprint.
    ``weight`` is that of a single value's squared error, ``spread`` the standard deviation of the background.
    ``shape_hessian`` receives moments, which :func:`sensitivity.moments_to_hessians` converts in the end; harmonics are
    weighted by (alpha T)², and to be divided by ``color_weight``."""
    seen = np.empty(len(frame.footprints.records), np.float32)
    for first, last in frame.parts:
        seen[first:last] = 0
    sums = sensitivity.Sums(
        into.position_hessian, into.shape_hessian, into.color_weight, into.mean_harmonics, into.higher_harmonics, seen
    )
    starts = frame.lists.starts
    edges = np.searchsorted(starts, np.arange(0, starts[-1], BAND))
    for first, last in itertools.pairwise(np.unique(np.append(edges, [0, len(starts) - 1])).tolist()):
        slots = number_slots(frame.lists, len(frame.footprints.records), (first, last))
        moments = np.zeros((len(slots.of), blending.MOMENTS), np.float32)
        _each_tile(blending.moments, frame, slots, pool, spread, moments, band=(first, last))
        _each_footprint(sensitivity.add_to_parameters, frame, slots, pool, moments, weight, sums)
    return seen


def for_kernels(splats: Splats) -> Splats:
    """Return the scene with contiguous, writeable arrays, as kernels need them; copied only where necessary."""
    arrays = {name: np.require(getattr(splats, name), requirements=("C", "W")) for name in ATTRIBUTES}
    return (
        splats if all(array is getattr(splats, name) for name, array in arrays.items()) else replace(splats, **arrays)
    )


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a loss by the stored parameters of the R Gaussians that have any; those of all others are 0."""

    gaussians: Int32[np.ndarray, " R"]  # indices of these Gaussians, ascending
    means: Float32[np.ndarray, "R 3"]
    quats: Float32[np.ndarray, "R 4"]
    scales: Float32[np.ndarray, "R 3"]
    opacities: Float32[np.ndarray, " R"]
    sh0: Float32[np.ndarray, "R 3"]
    shN: Float32[np.ndarray, "R K 3"]

    def add_to(self, name: str, total: Shaped[np.ndarray, "N ..."]) -> None:
        """Add the gradients by the attribute ``name`` to those of all Gaussians."""
        total[self.gaussians] += getattr(self, name)

    @classmethod
    def sum(cls, parts: Sequence[Gradients]) -> Gradients:
        """Return the sum of one or more gradients, added in order."""
        if len(parts) == 1:
            return parts[0]
        gaussians = np.unique(np.concatenate([part.gaussians for part in parts]))
        totals = []
        for field in fields(cls)[1:]:
            total = np.zeros((len(gaussians), *getattr(parts[0], field.name).shape[1:]), np.float32)
            for part in parts:
                total[np.searchsorted(gaussians, part.gaussians)] += getattr(part, field.name)
            totals.append(total)
        return cls(gaussians, *totals)


def differentiate(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], v_alpha: Float32[np.ndarray, "H W"], pool: Workers
) -> Gradients:
    """Return the gradients of a loss by the stored parameters, given those by the image and by its alpha. Only
    Gaussians that contribute to the image have any: of many Gaussians, most lie outside it, or behind others."""
    slots = number_slots(frame.lists, len(frame.footprints.records))
    v_slots, changed = np.zeros((len(slots.of), 9), np.float32), np.empty_like(slots.rows)
    _each_tile(blending.blend_backward, frame, slots, pool, v_image, v_alpha, v_slots)
    count = blending.rows_with_gradients(slots, v_slots, changed)
    gradients = Gaussians(*(np.empty((count, *array.shape[1:]), np.float32) for array in frame.gaussians))
    indices, v_colors = np.empty(count, np.int32), np.empty((count, 3), np.float64)

    def part(first: int, last: int) -> None:
        project_backward(frame, slots, v_slots, changed, first, last, indices, gradients, v_colors)
        shade_backward(frame, indices, first, last, v_colors, gradients)

    each_part(part, even(count, pool), pool)
    return Gradients(indices, *gradients)


def color_gradients(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], pool: Workers
) -> tuple[Float32[np.ndarray, "slots 3"], Slots]:
    """Return the gradients of a loss by the colours, given that by the image: sums by slot, and the slots."""
    slots = number_slots(frame.lists, len(frame.footprints.records))
    v_slots = np.zeros((len(slots.of), 3), np.float32)
    _each_tile(blending.blend_colors_backward, frame, slots, pool, v_image, v_slots)
    return v_slots, slots


def add_color_gradients(
    frame: Frame, v_image: Float32[np.ndarray, "H W 3"], into: Float32[np.ndarray, "N 3"], pool: Workers
) -> None:
    """Add the gradients of a loss by ``sh0`` alone, given its gradient by the image, ``v_image``, to ``into``."""
    v_slots, slots = color_gradients(frame, v_image, pool)
    _each_footprint(add_colors, frame, slots, pool, v_slots, into)


def drawn_opacities(splats: Splats) -> Float64[np.ndarray, " N"]:
    """Return opacities from 0 to 1; 0 for Gaussians that no renderer draws."""
    opacities = 1 / (1 + np.exp(-splats.opacities.astype(np.float64)))
    return np.where(opacities > constants.ALPHA_MIN, opacities, 0.0)
