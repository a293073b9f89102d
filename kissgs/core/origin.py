"""The origin of a scene, near which the steps of float32 and of containers are finer than any Gaussian.

float32 has 24 bits, and a container 16 bits for the logarithm of a position: far from zero, as in geo-referenced
scenes, both have coarse steps. So positions may be relative to :attr:`kissgs.Splats.origin`, which is float64.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.coarse_positions import COARSE_SHARE, coarse_share
from kissgs.core.errors import InvalidContainerError
from kissgs.core.splats import MEAN_LIMIT, Splats, sampled_rows

Origin = tuple[float, float, float]

WORLD: Origin = (0.0, 0.0, 0.0)
"""Origin of a scene whose positions are those of the world."""


def world_positions(splats: Splats) -> Float64[np.ndarray, "N 3"]:
    """Return the positions in the world, float64 ``(N, 3)``."""
    return splats.means.astype(np.float64) + np.array(splats.origin)


def with_origin(splats: Splats, origin: Origin | None) -> Splats:
    """Return the scene with positions relative to another origin; None: to its own."""
    if origin in (None, splats.origin):
        return splats
    means = (world_positions(splats) - np.array(origin)).astype(np.float32)
    return replace(splats, means=means, origin=origin)


def in_world(splats: Splats) -> Splats:
    """Return the scene with the positions of the world where float32 can hold them, else the same scene."""
    fits = splats.origin != WORLD and origin_for(world_positions(splats), splats.scales) == WORLD
    return with_origin(splats, WORLD) if fits else splats


def centred(splats: Splats) -> Splats:
    """Return the scene with its origin in its middle, that of :func:`middle_of`."""
    return with_origin(splats, middle_of([world_positions(splats)], len(splats)))


def middle_of(blocks: Iterable[Float64[np.ndarray, "n 3"]], count: int) -> Origin:
    """Return the whole numbers nearest to the median of :func:`sampled_rows` of ``count`` positions that are finite."""
    some = sampled_rows(blocks, count)[:, :3]
    some = some[np.isfinite(some).all(axis=1)]
    x, y, z = np.rint(np.median(some, axis=0)) + 0.0 if len(some) else WORLD
    return float(x), float(y), float(z)


def from_world(splats: Splats, positions: Float64[np.ndarray, "N 3"], origin: Origin | None = None) -> Splats:
    """Return the scene at positions of the world, as float32 relative to an origin.

    Without an origin it is that of :func:`origin_for`. A note says if float32 is too coarse for objects so far apart.
    """
    origin = origin_for(positions, splats.scales) if origin is None else origin
    relative = positions - np.array(origin)
    with np.errstate(over="ignore", invalid="ignore"):
        means = relative.astype(np.float32)
        share = _rounded_share(relative, splats.scales)
    notes = splats.notes
    if share > COARSE_SHARE:
        notes = (*notes, f"positions are rounded to float32, too coarsely for {share:.0%} of the Gaussians")
    return replace(splats, means=means, origin=origin, notes=notes)


def origin_for(positions: Float64[np.ndarray, "N 3"], scales: Float32[np.ndarray, "N 3"]) -> Origin:
    """Return the origin for positions as float32: that of the world unless they would be coarse, else their middle."""
    return middle_of([positions], len(positions)) if _rounded_share(positions, scales) > COARSE_SHARE else WORLD


def _rounded_share(positions: Float64[np.ndarray, "N 3"], scales: Float32[np.ndarray, "N 3"]) -> float:
    """Return the share of positions that are coarse as float32; those that overflow it are left out."""
    with np.errstate(over="ignore", invalid="ignore"):
        errors = np.abs(positions - positions.astype(np.float32)).max(axis=1, initial=0)
    finite = np.isfinite(errors)
    return coarse_share(errors[finite], scales[finite])


def relative_to(origin: Origin) -> str:
    """Return the clause that says where the positions of a scene are."""
    return "positions are relative to the point ({:,.0f}, {:,.0f}, {:,.0f})".format(*origin)


def recorded(origin: Origin) -> dict[str, list[float]]:
    """Return the entry of a container's metadata under the key "kissgs"; nothing for the origin of the world."""
    return {} if origin == WORLD else {"origin": list(origin)}


def read_origin(document: Mapping[str, Any], name: str) -> Origin:
    """Return the origin that the metadata ``document`` of the file ``name`` records."""
    own = document.get("kissgs")
    found = own.get("origin", WORLD) if isinstance(own, dict) else WORLD
    try:
        x, y, z = (float(value) if type(value) in (int, float) else math.nan for value in found)
    except (TypeError, ValueError, OverflowError):
        x = y = z = math.nan
    if not all(abs(value) <= MEAN_LIMIT for value in (x, y, z)):
        raise InvalidContainerError(f"{name}: kissgs.origin is not three numbers up to 1e15; export the scene again")
    return x, y, z
