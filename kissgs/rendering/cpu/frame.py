"""One picture on the processor: the kernels in their order, split over threads so that no result depends on how many.

Every sum that crosses tiles goes through slots: one per pair of footprint and tile, numbered footprint by footprint.
A tile writes its own slots, a footprint adds up its own in their order.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from kissgs._typing import Float32, Float64, Int32, Int64, Shaped, UInt16
from kissgs.errors import InvalidViewsError, UnsupportedError
from kissgs.importance import Importance
from kissgs.parallel import Workers
from kissgs.rendering import semantics
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import blending, projection, sensitivity, shading, tiles
from kissgs.splats import ATTRIBUTES, Splats

RULES = np.array(
    [semantics.NEAR, semantics.FAR, semantics.DILATION, semantics.FRUSTUM_MARGIN, semantics.ALPHA_MIN], np.float64
)
LIMITS = np.array([semantics.ALPHA_MIN, semantics.ALPHA_MAX, semantics.TRANSMITTANCE_MIN], np.float32)

PIXELS_PER_TILE = semantics.TILE**2
R = TypeVar("R")

MAX_PAIRS = 2**31 - 1
"""Footprints times the tiles they touch: more would not fit the int32 lists."""

MAX_MEMBERS = 2**24 - 1
"""Footprints in one tile: their places there are float32, so that they fit into vectors with the rest."""

PARTS_PER_THREAD = 4
"""Parts of the work differ in cost; finer ones even it out."""


@dataclass(frozen=True, slots=True)
class Footprints:
    """The M Gaussians that touch a picture, front to back.

    Attributes:
        visible: ``(M,)`` which Gaussians they are.
        rows: ``(M,)`` footprints in the order of their Gaussians.
        records: ``(M, 11)``, see :func:`kissgs.rendering.cpu.projection.project`.
    """

    visible: Int32[np.ndarray, " M"]
    rows: Int64[np.ndarray, " M"]
    records: Float32[np.ndarray, "M 11"]


@dataclass(frozen=True, slots=True)
class TileLists:
    """Which footprints touch which tile.

    Attributes:
        columns: tiles per row of tiles.
        starts: ``(tiles + 1,)`` where each tile's list begins.
        members: ``(P,)`` footprints, tile after tile, front to back.
        spans: ``(P,)`` the rows of pixels that each touches there, see :func:`kissgs.rendering.cpu.tiles.fill_tiles`.
        slots: ``(P,)`` the slot of each of these pairs.
        slots_from: ``(M,)`` the first slot of each footprint; they are numbered in the order of the Gaussians.
        slot_counts: ``(M,)`` how many it has, one per tile that it touches.
    """

    columns: int
    starts: Int64[np.ndarray, " tiles_1"]
    members: Int32[np.ndarray, " P"]
    spans: UInt16[np.ndarray, " P"]
    slots: Int32[np.ndarray, " P"]
    slots_from: Int64[np.ndarray, " M"]
    slot_counts: Int64[np.ndarray, " M"]


@dataclass(frozen=True, slots=True)
class Frame:
    """A picture, and what its derivative and the scores need.

    Attributes:
        splats: the scene.
        image: ``(H, W, 3)`` linear in the Gaussians' colours, 0 and up, not clamped to 1.
        transmittance: ``(H, W)`` share of the background that is seen; 1 - alpha.
        camera: that took it.
        background: ``(3,)``.
        footprints: front to back.
        lists: of the tiles.
        stops: ``(tiles, 256)`` members from this one on were not drawn at the pixel.
    """

    splats: Splats
    image: Float32[np.ndarray, "H W 3"]
    transmittance: Float32[np.ndarray, "H W"]
    camera: Camera
    background: Float32[np.ndarray, "3"]
    footprints: Footprints
    lists: TileLists
    stops: Int32[np.ndarray, "tiles 256"]


@dataclass(frozen=True, slots=True)
class Gradients:
    """Gradients of a loss by the stored parameters; of the shapes of those of :class:`kissgs.Splats`."""

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    sh0: Float32[np.ndarray, "N 3"]
    shN: Float32[np.ndarray, "N K 3"]


def draw(splats: Splats, camera: Camera, background: Shaped[np.ndarray, "..."], pool: Workers) -> Frame:
    """Take a picture of finite Gaussians (:func:`kissgs.clean`), as :mod:`kissgs.rendering.semantics` says.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: too many footprints for the lists of the tiles, or too little memory for the picture.
    """
    try:
        return _draw(_readable(splats), camera, _colour(background), pool)
    except MemoryError as error:
        size = f"{camera.width}x{camera.height}"
        raise UnsupportedError(f"there is not enough memory for a picture of {size}: render it smaller") from error


def _draw(splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], pool: Workers) -> Frame:
    footprints = _project(splats, camera, pool)
    lists = _sort_into_tiles(footprints, camera, pool)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    transmittance = np.empty((camera.height, camera.width), np.float32)
    stops = np.empty((len(lists.starts) - 1, PIXELS_PER_TILE), np.int32)

    def blend(first: int, last: int) -> None:
        blending.blend(
            *(footprints.records, lists.members, lists.spans, lists.starts, first, last, camera.width, camera.height),
            *(lists.columns, LIMITS, background, image, transmittance, stops),
        )

    _each_part(blend, _even_tiles(lists, pool), pool)
    return Frame(splats, image, transmittance, camera, background, footprints, lists, stops)


def differentiate(
    frame: Frame,
    v_image: Float32[np.ndarray, "H W 3"],
    v_alpha: Float32[np.ndarray, "H W"],
    pool: Workers,
) -> Gradients:
    """Gradients of a loss, given those by the picture and by its alpha.

    Raises:
        MemoryError: there is not enough for them.
    """
    splats = frame.splats
    camera, lists, visible, rows = frame.camera, frame.lists, frame.footprints.visible, frame.footprints.rows
    records = frame.footprints.records
    v_slots = np.empty((len(lists.members), 9), np.float32)

    def blend(first: int, last: int) -> None:
        blending.blend_backward(
            *(records, lists.members, lists.spans, lists.slots, lists.starts, first, last, lists.columns, LIMITS),
            *(frame.background, frame.transmittance, frame.stops, v_image, v_alpha, v_slots),
        )

    _each_part(blend, _even_tiles(lists, pool), pool)
    found = Gradients(*(np.zeros(getattr(splats, name).shape, np.float32) for name in Gradients.__slots__))
    v_colors = np.empty((len(visible), 3), np.float64)

    def project(first: int, last: int) -> None:
        projection.project_backward(
            *(splats.means, splats.quats, splats.scales, splats.opacities),
            *(visible, rows, lists.slots_from, lists.slot_counts, v_slots),
            *(first, last, camera.viewmat, camera.K),
            *(camera.width, camera.height, RULES),
            *(found.means, found.quats, found.scales, found.opacities, v_colors),
        )
        shading.shade_backward(
            *(splats.means, splats.shN, camera.position, visible, rows, first, last, records),
            *(v_colors, found.means, found.sh0, found.shN),
        )

    _each_part(project, _even(len(visible), pool), pool)
    return found


def removal_scores(frame: Frame, pool: Workers) -> Float64[np.ndarray, " N"]:
    """For each of the scene's Gaussians, by how much its removal alone would change the picture.

    The squared change, summed over pixels and RGB (GaussianPOP); exact but for what was hidden behind the end of a
    pixel's list, which a removal may reveal. Gaussians not in the picture score 0.
    """
    lists, (visible, records) = frame.lists, (frame.footprints.visible, frame.footprints.records)
    errors = np.empty(len(lists.members), np.float32)

    def blend(first: int, last: int) -> None:
        blending.removal_errors(
            *(records, lists.members, lists.spans, lists.slots, lists.starts, first, last, lists.columns, LIMITS),
            *(frame.background, frame.transmittance, frame.stops, errors),
        )

    _each_part(blend, _even_tiles(lists, pool), pool)
    scores = np.zeros(len(frame.splats), np.float64)
    blending.sum_errors(errors, lists.slots_from, lists.slot_counts, visible, 0, len(visible), scores)
    return scores


def add_sensitivities(frame: Frame, weight: float, spread: float, into: Importance, pool: Workers) -> None:
    """Add to ``into`` what small changes of each Gaussian cost in this picture, times ``weight``.

    ``spread`` is the standard deviation of each channel of the background. In ``directions``, sums of (alpha T)² times
    the harmonics, to be divided by ``colors`` in the end.
    """
    splats, camera, lists = frame.splats, frame.camera, frame.lists
    visible, rows, records = frame.footprints.visible, frame.footprints.rows, frame.footprints.records
    slots = np.empty((len(lists.members), 16), np.float32)

    def blend(first: int, last: int) -> None:
        sensitivity.moments(
            *(records, lists.members, lists.spans, lists.slots, lists.starts, first, last, lists.columns, LIMITS),
            *(frame.background, spread, frame.transmittance, frame.stops, slots),
        )

    _each_part(blend, _even_tiles(lists, pool), pool)

    def project(first: int, last: int) -> None:
        sensitivity.add_to_parameters(
            *(splats.means, splats.quats, splats.scales, splats.opacities),
            *(visible, rows, lists.slots_from, lists.slot_counts, slots),
            first,
            last,
            *(camera.viewmat, camera.position, camera.K),
            camera.width,
            camera.height,
            RULES,
            weight,
            *(into.places, into.shapes, into.colors, into.directions),
        )

    _each_part(project, _even(len(visible), pool), pool)


def _colour(background: Shaped[np.ndarray, "..."]) -> Float32[np.ndarray, "3"]:
    colour = np.array(background, np.float32, order="C")
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InvalidViewsError("a background is three finite numbers: red, green and blue, from 0 to 1")
    return colour


def _readable(splats: Splats) -> Splats:
    """The same if its arrays are such as kernels read, which are contiguous and writeable; else copies."""
    arrays = {name: np.require(getattr(splats, name), requirements=("C", "W")) for name in ATTRIBUTES}
    return splats if all(array is getattr(splats, name) for name, array in arrays.items()) else Splats(**arrays)


def _project(splats: Splats, camera: Camera, pool: Workers) -> Footprints:
    count = len(splats)
    visible, depths = np.empty(count, np.int32), np.empty(count, np.float32)
    records = np.empty((count, 11), np.float32)

    def project(first: int, last: int) -> slice:
        found = projection.project(
            *(splats.means, splats.quats, splats.scales, splats.opacities, first, last, camera.viewmat, camera.K),
            *(camera.width, camera.height, RULES, visible, depths, records),
        )
        shading.shade(splats.means, splats.sh0, splats.shN, camera.position, visible, first, first + found, records)
        return slice(first, first + found)

    parts = _each_part(project, _even(count, pool), pool)
    rows = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    order = np.empty_like(rows)
    tiles.sort_keys(depths[rows].view(np.uint32), order, np.empty_like(rows))  # positive floats sort as their bits
    in_scene = np.empty_like(order)
    in_scene[order] = np.arange(len(order))
    rows = rows[order]
    return Footprints(visible[rows], in_scene, records[rows])


def _sort_into_tiles(footprints: Footprints, camera: Camera, pool: Workers) -> TileLists:
    columns, rows = -(-camera.width // semantics.TILE), -(-camera.height // semantics.TILE)
    records = footprints.records
    parts = _even(len(records), pool)
    slot_counts = np.empty(len(records), np.int64)

    def count(first: int, last: int) -> Int64[np.ndarray, " tiles"]:
        per_tile = np.zeros(columns * rows, np.int64)
        tiles.count_tiles(records, first, last, columns, rows, per_tile, slot_counts)
        return per_tile

    per_part = np.stack(_each_part(count, parts, pool))
    starts, slots_from = _running_sum(per_part.sum(axis=0)), np.empty_like(slot_counts)
    slots_from[footprints.rows] = _running_sum(slot_counts[footprints.rows])[:-1]
    _check_lists(starts)
    members, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    spans = np.empty(starts[-1], np.uint16)
    ends = dict(zip(parts.tolist(), starts[:-1] + np.cumsum(per_part, axis=0) - per_part, strict=False))

    def fill(first: int, last: int) -> None:
        tiles.fill_tiles(records, first, last, columns, rows, ends[first], slots_from, members, slots, spans)

    _each_part(fill, parts, pool)
    return TileLists(columns, starts, members, spans, slots, slots_from, slot_counts)


def _check_lists(starts: Int64[np.ndarray, " tiles_1"]) -> None:
    if starts[-1] > MAX_PAIRS:
        raise UnsupportedError(
            f"this view has {starts[-1]:,} pairs of a Gaussian and a tile of the picture; at most {MAX_PAIRS:,} fit. "
            "Render it smaller"
        )
    longest = int(np.diff(starts).max())
    if longest > MAX_MEMBERS:
        raise UnsupportedError(
            f"{longest:,} Gaussians meet in 16x16 pixels of this view; at most {MAX_MEMBERS:,} can be drawn. "
            "Go nearer, or render it larger"
        )


def _running_sum(counts: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n_1"]:
    total = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=total[1:])
    return total


def _even(count: int, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Edges of parts of about the same number of items; at least one part, none empty unless all are."""
    parts = max(1, min(pool.threads * PARTS_PER_THREAD, count))
    return np.linspace(0, count, parts + 1).astype(np.int64)


def _even_tiles(lists: TileLists, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Edges of parts of about the same number of members, plus something for each tile."""
    tiles_count = len(lists.starts) - 1
    work = lists.starts + 8 * np.arange(tiles_count + 1)
    edges = np.searchsorted(work, np.linspace(0, work[-1], pool.threads * PARTS_PER_THREAD + 1))
    edges[0], edges[-1] = 0, tiles_count
    return np.unique(edges)


def _each_part(work: Callable[[int, int], R], edges: Int64[np.ndarray, " edges"], pool: Workers) -> list[R]:
    return pool.map(lambda pair: work(int(pair[0]), int(pair[1])), list(itertools.pairwise(edges)))
