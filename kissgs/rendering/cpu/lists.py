"""Lists of the Gaussians that touch an image and each of its tiles, built in parts by threads.

The result does not depend on the number of parts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from kissgs.core.array_types import Float32, Int32, Int64, UInt16
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu import projection, shading, tiles

PROJECTION_CONSTANTS = np.array(
    [constants.NEAR, constants.FAR, constants.DILATION, constants.FRUSTUM_MARGIN, constants.ALPHA_MIN], np.float64
)
"""Constants of projection, as kernels take them."""

R = TypeVar("R")

MAX_PAIRS = 2**31 - 1
"""Largest number of pairs of a footprint and a tile that it touches: the lists are int32."""

MAX_MEMBERS = 2**24 - 1
"""Largest number of footprints in one tile: kernels store their indices as float32."""

PARTS_PER_THREAD = 4
"""Number of parts per thread; parts differ in cost, and smaller ones balance the load."""


@dataclass(frozen=True, slots=True)
class Footprints:
    """The M Gaussians that touch an image, front to back.

    Attributes:
        visible: ``(M,)`` indices of the Gaussians.
        rows: ``(M,)`` footprints in the order of their Gaussians.
        records: ``(M, 11)``, see :func:`kissgs.rendering.cpu.projection.project`.
    """

    visible: Int32[np.ndarray, " M"]
    rows: Int64[np.ndarray, " M"]
    records: Float32[np.ndarray, "M 11"]


@dataclass(frozen=True, slots=True)
class TileLists:
    """Lists of the footprints that touch each tile.

    Attributes:
        columns: number of tiles in a row of tiles.
        starts: ``(tiles + 1,)`` index of the first member of each tile.
        members: ``(P,)`` footprints, tile after tile, front to back.
        spans: ``(P,)`` rows of pixels that each member touches, see :func:`kissgs.rendering.cpu.tiles.fill_tiles`.
        slots: ``(P,)`` slot of each member.
        slots_from: ``(M,)`` first slot of each footprint; slots are numbered in the order of the Gaussians.
        slot_counts: ``(M,)`` number of slots of each footprint, one per tile that it touches.
    """

    columns: int
    starts: Int64[np.ndarray, " tiles_1"]
    members: Int32[np.ndarray, " P"]
    spans: UInt16[np.ndarray, " P"]
    slots: Int32[np.ndarray, " P"]
    slots_from: Int64[np.ndarray, " M"]
    slot_counts: Int64[np.ndarray, " M"]


def find_footprints(splats: Splats, camera: Camera, pool: Workers) -> Footprints:
    """Project and shade all Gaussians; return those that touch the image, nearest first."""
    count = len(splats)
    visible, depths = np.empty(count, np.int32), np.empty(count, np.float32)
    records = np.empty((count, 11), np.float32)

    def part(first: int, last: int) -> slice:
        found = projection.project(
            splats.means,
            splats.quats,
            splats.scales,
            splats.opacities,
            first,
            last,
            camera.viewmat,
            camera.K,
            camera.width,
            camera.height,
            PROJECTION_CONSTANTS,
            visible,
            depths,
            records,
        )
        shading.shade(splats.means, splats.sh0, splats.shN, camera.position, visible, first, first + found, records)
        return slice(first, first + found)

    parts = each_part(part, even(count, pool), pool)
    rows = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    order = np.empty_like(rows)
    tiles.sort_keys(depths[rows].view(np.uint32), order, np.empty_like(rows))  # positive floats sort as their bits
    in_scene = np.empty_like(order)
    in_scene[order] = np.arange(len(order))
    rows = rows[order]
    return Footprints(visible[rows], in_scene, records[rows])


def sort_into_tiles(footprints: Footprints, camera: Camera, pool: Workers) -> TileLists:
    """Return lists of the footprints that touch each tile, nearest first.

    Raises:
        UnsupportedError: there are more than :data:`MAX_PAIRS`, or more than :data:`MAX_MEMBERS` in one tile.
    """
    columns, rows = -(-camera.width // constants.TILE), -(-camera.height // constants.TILE)
    records = footprints.records
    parts = even(len(records), pool)
    slot_counts = np.empty(len(records), np.int64)

    def count(first: int, last: int) -> Int64[np.ndarray, " tiles"]:
        per_tile = np.zeros(columns * rows, np.int64)
        tiles.count_tiles(records, first, last, columns, rows, per_tile, slot_counts)
        return per_tile

    per_part = np.stack(each_part(count, parts, pool))
    starts, slots_from = _running_sum(per_part.sum(axis=0)), np.empty_like(slot_counts)
    slots_from[footprints.rows] = _running_sum(slot_counts[footprints.rows])[:-1]
    _check_lists(starts)
    members, slots = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.int32)
    spans = np.empty(starts[-1], np.uint16)
    ends = dict(zip(parts.tolist(), starts[:-1] + np.cumsum(per_part, axis=0) - per_part, strict=False))

    def fill(first: int, last: int) -> None:
        tiles.fill_tiles(records, first, last, columns, rows, ends[first], slots_from, members, slots, spans)

    each_part(fill, parts, pool)
    return TileLists(columns, starts, members, spans, slots, slots_from, slot_counts)


def _check_lists(starts: Int64[np.ndarray, " tiles_1"]) -> None:
    if starts[-1] > MAX_PAIRS:
        raise UnsupportedError(
            f"this view has {starts[-1]:,} pairs of a Gaussian and a tile of the image, more than {MAX_PAIRS:,}; "
            "render a smaller image"
        )
    longest = int(np.diff(starts).max())
    if longest > MAX_MEMBERS:
        raise UnsupportedError(
            f"{longest:,} Gaussians touch the same 16x16 pixels of this view, more than {MAX_MEMBERS:,}; move the "
            "camera nearer, or render a larger image"
        )


def _running_sum(counts: Int64[np.ndarray, " n"]) -> Int64[np.ndarray, " n_1"]:
    total = np.zeros(len(counts) + 1, np.int64)
    np.cumsum(counts, out=total[1:])
    return total


def even(count: int, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Return the edges of at least one part of about equal numbers of items; no part is empty if there are items."""
    parts = max(1, min(pool.threads * PARTS_PER_THREAD, count))
    return np.linspace(0, count, parts + 1).astype(np.int64)


def even_tiles(lists: TileLists, pool: Workers) -> Int64[np.ndarray, " edges"]:
    """Return the edges of parts of tiles of about equal cost: the number of members plus a constant per tile."""
    tiles_count = len(lists.starts) - 1
    work = lists.starts + 8 * np.arange(tiles_count + 1)
    edges = np.searchsorted(work, np.linspace(0, work[-1], pool.threads * PARTS_PER_THREAD + 1))
    edges[0], edges[-1] = 0, tiles_count
    return np.unique(edges)


def each_part(work: Callable[[int, int], R], edges: Int64[np.ndarray, " edges"], pool: Workers) -> list[R]:
    """Call ``work`` with the edges (first, last) of each part in threads; return the results in order."""
    return pool.map(lambda pair: work(int(pair[0]), int(pair[1])), list(itertools.pairwise(edges)))
