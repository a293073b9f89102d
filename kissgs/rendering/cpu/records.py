"""Tuples of arrays, with names, that kernels take and give, up to a whole image; and their numba types."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import boolean, float32, float64, int32, int64, types, uint32

from kissgs.core.array_types import Float32, Float64, Int32, Int64, UInt32
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera


class Gaussians(NamedTuple):
    """Stored parameters of Gaussians as in :class:`kissgs.Splats`, or the gradients by them."""

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    sh0: Float32[np.ndarray, "N 3"]
    shN: Float32[np.ndarray, "N K 3"]

    @classmethod
    def of(cls, splats: Splats) -> Gaussians:
        """Return the parameters of a scene, without copies."""
        return cls(*(getattr(splats, name) for name in ATTRIBUTES))


class Projection(NamedTuple):
    """A camera and the constants of :mod:`kissgs.rendering.constants` by which it shows a scene."""

    viewmat: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]
    eye: Float64[np.ndarray, "3"]
    width: int
    height: int
    near: float
    far: float
    dilation: float
    margin: float
    alpha_min: float
    antialiased: bool

    @classmethod
    def of(cls, splats: Splats, camera: Camera) -> Projection:
        """Return the projection of a scene into the image of a camera."""
        pose = camera.viewmat, camera.K, np.ascontiguousarray(camera.position), int(camera.width), int(camera.height)
        depths, dilation = (constants.NEAR, constants.FAR), float(camera.dilation)
        antialiased = bool(splats.antialiased)
        return cls(*pose, *depths, dilation, constants.FRUSTUM_MARGIN, constants.ALPHA_MIN, antialiased)


class Footprints(NamedTuple):
    """The M Gaussians that touch an image, in the order of the scene, in some rows of arrays for all N."""

    visible: Int32[np.ndarray, " N"]  # the Gaussian of each row
    depths: Float32[np.ndarray, " N"]  # z in the camera
    records: Float32[np.ndarray, "N 11"]
    """Centre x, y; l0, l1, l2 of :mod:`kissgs.rendering.cpu.blending`; opacity, compensated in an antialiased scene; R,
    G, B; the largest exponent whose alpha reaches ALPHA_MIN; half height in pixels."""


class TileLists(NamedTuple):
    """Lists of the footprints that touch each tile."""

    columns: int  # number of tiles in a row of tiles
    starts: Int64[np.ndarray, " tiles_1"]  # index of the first member of each tile
    members: Int32[np.ndarray, " P"]  # rows of the footprints, tile after tile, front to back
    spans: UInt32[np.ndarray, " P"]
    """Rows of pixels that each member touches in the tile, as ``32 * first + last``, last exclusive: those in its left
    half in the lower 16 bits, those in its right half in the upper ones."""


class Blended(NamedTuple):
    """An image, and what it was blended with."""

    image: Float32[np.ndarray, "H W 3"]  # RGB, 0 and up, not clamped to 1
    transmittance: Float32[np.ndarray, "H W"]  # share of the background that is visible, 1 - alpha
    stops: Int32[np.ndarray, "tiles 256"]  # index of the first member that is not drawn at the pixel; left half first
    background: Float32[np.ndarray, "3"]
    limits: Float32[np.ndarray, "3"]  # ALPHA_MIN, ALPHA_MAX, and the transmittance at which the list of a pixel ends


class Frame(NamedTuple):
    """A rendered image, with the intermediate results that its derivatives and scores need."""

    gaussians: Gaussians
    projection: Projection
    footprints: Footprints
    parts: Int64[np.ndarray, "parts 2"]  # first and last (exclusive) row of ranges with footprints; others are not set
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


class Slots(NamedTuple):
    """Numbers of the members of some tiles, footprint by footprint, so that sums over tiles have a fixed order. A tile
    writes to its own slots, and the slots of a footprint are added in order."""

    begin: int  # index of the first member of these tiles
    of: Int32[np.ndarray, " S"]  # slot of each member
    rows: Int32[np.ndarray, " T"]  # rows of the footprints that are members, ascending
    first: Int32[np.ndarray, " N_1"]  # first slot of each row; a row's slots end where the next one's begin


named_tuple: Any = types.NamedTuple  # type of a named tuple; numba has no annotations

GAUSSIANS = named_tuple((*[float32[:, ::1]] * 3, float32[::1], float32[:, ::1], float32[:, :, ::1]), Gaussians)
PROJECTION = named_tuple(
    (float64[:, ::1], float64[:, ::1], float64[::1], int64, int64, *[float64] * 5, boolean), Projection
)
FOOTPRINTS = named_tuple((int32[::1], float32[::1], float32[:, ::1]), Footprints)
TILE_LISTS = named_tuple((int64, int64[::1], int32[::1], uint32[::1]), TileLists)
BLENDED = named_tuple((float32[:, :, ::1], float32[:, ::1], int32[:, ::1], float32[::1], float32[::1]), Blended)
FRAME = named_tuple((GAUSSIANS, PROJECTION, FOOTPRINTS, int64[:, ::1], TILE_LISTS, BLENDED), Frame)
SLOTS = named_tuple((int64, int32[::1], int32[::1], int32[::1]), Slots)
