"""SOG-XT files -> ``Splats``: a small table per channel, one lookup per value, written where it belongs.

The arithmetic is that of the paper's reference decoder (docs/format.md), with tables in float64 and without its detour
through activated opacities and scales.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int, UInt8

from kissgs.errors import InvalidContainerError
from kissgs.progress import Progress, silent
from kissgs.sogxt.container import Source, open_source
from kissgs.sogxt.metadata import TILE_COLUMNS, TILE_ROWS, Layout, read_layout
from kissgs.sogxt.parallel import Workers, workers
from kissgs.sogxt.planes import decode_plane
from kissgs.sogxt.quantize import signed_exp
from kissgs.splats import SH_REST_COUNTS, Splats

CHUNK = 1 << 14
"""Gaussians per lookup: small enough that indices stay in the processor's cache."""


def decode(source: Path | bytes | Mapping[str, bytes], *, threads: int = 0, progress: Progress = silent) -> Splats:
    """Decode a container.

    Args:
        source: a folder, a zip file, the bytes of one, or files in memory.
        threads: to use; 0 means one per processor.
        progress: receives "decode" events.

    Returns:
        The Gaussians in the order of the grid. Quaternions are as stored, their length within a few per cent of 1.

    Raises:
        InvalidContainerError: something in it is missing, damaged or impossible.
        UnsupportedError: it uses images other than WebP.
    """
    with open_source(source) as files, workers(threads) as pool:
        return _Decoder(files, read_layout(files), pool, progress).run()


class _Decoder:
    """One container being decoded: what all steps need."""

    def __init__(self, files: Source, layout: Layout, pool: Workers, progress: Progress) -> None:
        self.files, self.layout, self.pool, self.progress = files, layout, pool, progress
        mask = self.grid_plane("active_mask", 1)[:, 0] > 0
        self.count = int(np.count_nonzero(mask))
        prefix = bool(mask[: self.count].all())  # no cell number is needed where all padding is at the end
        self.cells: Int[np.ndarray, " N"] | None = None if prefix else np.flatnonzero(mask)

    def run(self) -> Splats:
        """All planes in parallel."""
        n, coefficients = self.count, SH_REST_COUNTS[self.layout.sh_degree]
        declared = self.layout.provenance
        if declared and declared.count != n:
            raise InvalidContainerError(f"active_mask.webp marks {n} Gaussians; the metadata declares {declared.count}")
        splats = Splats(
            means=np.empty((n, 3), np.float32),
            quats=np.empty((n, 4), np.float32),
            scales=np.empty((n, 3), np.float32),
            opacities=np.empty(n, np.float32),
            sh0=np.empty((n, 3), np.float32),
            shN=np.empty((n, coefficients, 3), np.float32),
        )
        jobs: list[Callable[[], None]] = [
            lambda: self.means(splats.means),
            lambda: self.shN(splats.shN),
            lambda: self.plain("quaternions", splats.quats),
            lambda: self.plain("scales", splats.scales),
            lambda: self.plain("f_dc", splats.sh0),
            lambda: self.plain("opacities", splats.opacities[:, None]),
        ]
        self.progress("decode", 0.0)
        self.pool.map(lambda job: job(), jobs)
        self.progress("decode", 1.0)
        return splats

    def plain(self, field: str, out: Float32[np.ndarray, "N C"]) -> None:
        """An attribute of one 8-bit image."""
        levels = self.grid_plane(field, out.shape[1])
        lookup = _Lookup(levels, *self.layout.limits(field))
        for rows, some in self.chunks(levels):
            lookup(some, out[rows])

    def means(self, out: Float32[np.ndarray, "N 3"]) -> None:
        """Positions: two images, one table for all axes."""
        levels = self.grid_plane("means_bytes_1", 3).astype(np.uint16)
        levels <<= 8
        levels |= self.grid_plane("means_bytes_0", 3)
        low, high = self.layout.limits("means")
        table = signed_exp(_table(levels, low, high)[0]).astype(np.float32)
        for rows, some in self.chunks(levels):
            np.take(table, some, out=out[rows], mode="clip")

    def shN(self, out: Float32[np.ndarray, "N K 3"]) -> None:
        """SH: a codebook, and the index into it of every Gaussian."""
        side = self.layout.codebook_side
        labels = self.grid_plane("f_rest_labels", 2)
        if int(labels.max()) >= side and int(self.index(labels).max()) >= side * side:
            raise InvalidContainerError(f"f_rest_labels.webp points outside the codebook of {side} x {side} entries")
        codebook = self.codebook()[:, : out.shape[1]]
        flat = np.ascontiguousarray(codebook.reshape(side * side, out.shape[1] * 3))
        for rows, some in self.chunks(labels):
            target = out[rows].reshape(len(some), out.shape[1] * 3)
            np.take(flat, self.index(some), axis=0, out=target, mode="clip")

    def codebook(self) -> Float32[np.ndarray, "S*S 15 3"]:
        """The entries: 15 tiles of S × S pixels, three rows of five; tile = coefficient, pixel = entry."""
        side = self.layout.codebook_side
        image = self.plane("f_rest_centroids", TILE_COLUMNS * side, TILE_ROWS * side, 3)
        tiles = (
            image.reshape(TILE_ROWS, side, TILE_COLUMNS, side, 3).transpose(1, 3, 0, 2, 4).reshape(side * side, 15, 3)
        )
        low, high = (limit.reshape(3, 15).T.reshape(45) for limit in self.layout.limits("f_rest_centroids"))
        entries = np.empty((side * side, 45), dtype=np.float32)
        _Lookup(tiles, low, high)(tiles.reshape(side * side, 45), entries)
        return entries.reshape(side * side, 15, 3)

    def index(self, labels: UInt8[np.ndarray, "N 2"]) -> Int[np.ndarray, " N"]:
        """Number of the codebook entry: row (green) × S + column (red)."""
        return labels[:, 1].astype(np.int64) * self.layout.codebook_side + labels[:, 0]

    def chunks(self, levels: np.ndarray) -> list[tuple[slice, np.ndarray]]:
        """The active cells' levels in pieces, with the rows of the output that they belong to."""
        pieces = []
        for first in range(0, self.count, CHUNK):
            rows = slice(first, min(first + CHUNK, self.count))
            pieces.append((rows, levels[rows] if self.cells is None else levels[self.cells[rows]]))
        return pieces

    def grid_plane(self, name: str, channels: int) -> UInt8[np.ndarray, "G*G C"]:
        """An image on the grid, as one row per cell."""
        side = self.layout.grid_side
        return self.plane(name, side, side, channels).reshape(side * side, -1)[:, :channels]

    def plane(self, name: str, width: int, height: int, channels: int) -> UInt8[np.ndarray, "H W C"]:
        """An image, its checksum compared with the metadata if that has one."""
        file = f"{name}.webp"
        data = self.files.read(file, 4096 + 5 * width * height)  # lossless WebP never needs more than about 4 bytes
        expected = self.layout.provenance.sha256.get(file) if self.layout.provenance else None
        if expected and hashlib.sha256(data).hexdigest() != expected:
            raise InvalidContainerError(f"{file} is damaged: its SHA-256 is not the one in the metadata")
        return decode_plane(data, file, width=width, height=height, channels=channels)


class _Lookup:
    """Values of 8-bit levels, one table per channel, all in one array."""

    def __init__(self, image: UInt8[np.ndarray, "..."], low: np.ndarray, high: np.ndarray) -> None:
        table = _table(image, low, high).astype(np.float32)
        self._table = table.reshape(-1)
        self._offsets = np.arange(len(table), dtype=np.int64) * table.shape[1]

    def __call__(self, levels: UInt8[np.ndarray, "N C"], out: Float32[np.ndarray, "N C"]) -> None:
        np.take(self._table, levels + self._offsets, out=out, mode="clip")


def _table(image: np.ndarray, low: np.ndarray, high: np.ndarray) -> Float64[np.ndarray, "C levels"]:
    """Per channel, the value of every level up to the largest that occurs.

    The smallest and the largest level of the image, over all channels and cells, stand for ``low`` and ``high``.
    """
    first, last = int(image.min()), int(image.max())
    position = (np.arange(last + 1, dtype=np.float64) - first) / max(last - first, 1)
    return np.asarray(low[:, None] + np.maximum(position, 0) * (high - low)[:, None])
