"""SOG-XT files -> ``Splats``, by one lookup table per channel. The arithmetic is that of the paper's reference decoder
(docs/reference/format.md), with tables in float64 and without its activation of opacities and scales and their
inverse."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, UInt8, UInt16
from kissgs.core.context import Progress, Workers, silent
from kissgs.core.errors import InvalidContainerError, UnsupportedError
from kissgs.core.positions import recorded, signed_exp
from kissgs.core.splats import BLOCK, SH_REST_COUNTS, Splats, blocks, empty_splats
from kissgs.formats import LEVELS_NAME
from kissgs.io.containers import Source, ZipSource, open_source, stored_size
from kissgs.io.files import refuse_more_than
from kissgs.io.images import decode_plane
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sogxt import FILES, FORMAT_NAME, PLANES
from kissgs.sogxt.metadata import TILE_COLUMNS, TILE_ROWS, Layout, read_layout, read_provenance

CHANNELS_OF_PLAIN = {"quaternions": 4, "scales": 3, "f_dc": 3, "opacities": 1}
"""Number of channels of the attributes that are one image of 8-bit levels each."""


MAX_PLANE_BYTES = 1 << 30  # largest size of the mask, bytes
MAX_FILE_BYTES = 1 << 28  # largest size of a zip in a streamed scene, bytes; one of 400,000 Gaussians takes about 5 MB


def describe(path: Path | bytes, level: int) -> Facts:
    """Return the facts of a SOG-XT container; the mask is decoded if the metadata does not state the count."""
    with open_source(path) as files:
        layout, made = read_layout(files), read_provenance(files)
        present = files.names()
        missing = [name for name in PLANES if name not in present]
        if missing:
            name = "the container" if isinstance(path, bytes) else path
            raise InvalidContainerError(f"{name} is incomplete: missing {', '.join(missing)}")
        parts = {name: files.size(name) for name in FILES if name in present}
        count = layout.count
        if count is None:
            name, side = "active_mask.webp", layout.grid_side
            mask = decode_plane(files.read(name, MAX_PLANE_BYTES), name, width=side, height=side, channels=1)
            count = int(np.count_nonzero(mask))
    origin = f"kissgs {made.version} from {made.source_count:,} Gaussians" if made else "unknown"
    grid, codebook = layout.grid_side, layout.codebook_side
    return Facts(
        title=titled("SOG-XT container", "antialiased" if layout.antialiased else ""),
        count=count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=layout.value_ranges(),
        changed=made.changed if made else {},
        details={
            **recorded(layout.origin),
            "grid_side": grid,
            "codebook_side": codebook,
            "version": made.version if made else None,
            "source_count": made.source_count if made else None,
            "antialiased": layout.antialiased,
            "settings": made.settings if made else {},
        },
        lines=(f"grid {grid} x {grid}, codebook {codebook} x {codebook}; encoder: {origin}",),
    )


def decode(
    source: SceneSource, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Decode a container in the order of its grid; quaternions are as stored, of length about 1."""
    with open_source(source) as files, Workers(threads) as pool:
        progress("decode", 0.0)
        planes = _Planes(files, read_layout(files), reading.max_compressed)
        planes.load(pool)
        progress("decode", 0.5)
        splats = planes.look_up(pool)
        progress("decode", 1.0)
        return replace(splats, origin=planes.layout.origin, antialiased=planes.layout.antialiased)


def decode_files(files: Source, layout: Layout, out: Splats, pool: Workers) -> None:
    """Decode a container whose metadata states the number of Gaussians into ``out``, which has as many. SH coefficients
    of ``out`` above the container's degree are left as they are."""
    planes = _Planes(files, layout, len(out))
    planes.load(pool)
    planes.look_up(pool, out)


class _Planes:
    """Images of a container as rows of levels, and their tables of values."""

    mask: UInt8[np.ndarray, "cells 1"]
    means: UInt16[np.ndarray, "cells 3"]
    means_table: Float32[np.ndarray, " levels"]
    labels: UInt8[np.ndarray, "cells 2"]
    codebook: Float32[np.ndarray, "entries K 3"]

    def __init__(self, files: Source, layout: Layout, max_gaussians: int) -> None:
        self.files, self.layout, self.max_gaussians = files, layout, max_gaussians
        if layout.grid_side**2 > 2 * max_gaussians + 128:  # padding is less than half of any grid but the smallest
            raise UnsupportedError(
                f"the container has {layout.grid_side**2:,} cells, too many for a limit of {max_gaussians:,} "
                "Gaussians: raise it (--max-gaussians) if you trust the file"
            )
        refuse_more_than(max_gaussians, layout.count or 0, "the container")
        self.coefficients = SH_REST_COUNTS[layout.sh_degree]
        self.plain: dict[str, tuple[UInt8[np.ndarray, "cells C"], _Lookup]] = {}

    def load(self, pool: Workers) -> None:
        """Decode all images in parallel, the slowest first."""
        plain = (lambda field=field: self.load_plain(*field) for field in CHANNELS_OF_PLAIN.items())
        pool.map(lambda job: job(), [self.load_means, self.load_codebook, self.load_labels, *plain, self.load_mask])

    def load_mask(self) -> None:
        self.mask = self.grid_plane("active_mask", 1)

    def load_plain(self, field: str, channels: int) -> None:
        """Load an attribute of one 8-bit image."""
        levels = self.grid_plane(field, channels)
        self.plain[field] = levels, _Lookup(levels, *self.layout.limits(field))

    def load_means(self) -> None:
        """Load positions: two images, one table for all axes."""
        self.means = self.grid_plane("means_bytes_1", 3).astype(np.uint16)
        self.means <<= 8
        self.means |= self.grid_plane("means_bytes_0", 3)
        logs = _table(self.means, *self.layout.limits("means"))[0]
        self.means_table = signed_exp(logs).astype(np.float32)

    def load_labels(self) -> None:
        """Load the codebook entry of every cell, as its column and row."""
        self.labels, side = self.grid_plane("f_rest_labels", 2), self.layout.codebook_side
        if int(self.labels.max()) >= side and int(_entry(self.labels, side).max()) >= side * side:
            raise InvalidContainerError(f"f_rest_labels.webp points outside the codebook of {side} x {side} entries")

    def load_codebook(self) -> None:
        """Load the codebook's entries, coefficient by coefficient, R, G and B of each. The image has 15 tiles of S × S
        pixels, three rows of five; tile = coefficient, pixel = entry."""
        side = self.layout.codebook_side
        image = self.plane("f_rest_centroids", TILE_COLUMNS * side, TILE_ROWS * side, 3)
        tiles = image.reshape(TILE_ROWS, side, TILE_COLUMNS, side, 3).transpose(1, 3, 0, 2, 4).reshape(side * side, 45)
        low, high = (limit.reshape(3, 15).T.reshape(45) for limit in self.layout.limits("f_rest_centroids"))
        entries = np.empty((side * side, 45), dtype=np.float32)
        _Lookup(tiles, low, high)(tiles, entries)
        self.codebook = np.ascontiguousarray(entries.reshape(-1, 15, 3)[:, : self.coefficients])

    def grid_plane(self, name: str, channels: int) -> UInt8[np.ndarray, "cells C"]:
        """Return an image of the grid's size, as one row per cell."""
        return self.plane(name, self.layout.grid_side, self.layout.grid_side, channels)

    def plane(self, name: str, width: int, height: int, channels: int) -> UInt8[np.ndarray, "pixels C"]:
        """Return an image as one row per pixel; its checksum is compared if the metadata has one."""
        file = f"{name}.webp"
        data = self.files.read(file, 4096 + 5 * width * height)  # lossless WebP never needs more than 4 bytes a pixel
        checksum = self.layout.crc32.get(file)
        return decode_plane(data, file, width=width, height=height, channels=channels, crc32=checksum)

    def look_up(self, pool: Workers, out: Splats | None = None) -> Splats:
        """Convert levels to values, some thousand Gaussians at a time, so that temporaries stay in the cache. They are
        written to ``out`` if it is given."""
        mask = self.mask[:, 0] > 0
        count = int(np.count_nonzero(mask))
        declared = self.layout.count
        if declared not in (None, count):
            raise InvalidContainerError(f"active_mask.webp marks {count} Gaussians; the metadata declares {declared}")
        refuse_more_than(self.max_gaussians, count, "the container")
        # No cell indices are needed if all padding is at the end.
        cells = None if mask[:count].all() else np.flatnonzero(mask)
        splats = empty_splats(count, self.coefficients) if out is None else out
        outputs = (splats.quats, splats.scales, splats.sh0, splats.opacities[:, None])
        plain = [(*self.plain[field], out) for field, out in zip(CHANNELS_OF_PLAIN, outputs, strict=True)]
        shN = splats.shN[:, : self.coefficients]

        def work(rows: slice) -> None:
            source = rows if cells is None else cells[rows]
            np.take(self.means_table, self.means[source], out=splats.means[rows], mode="clip")
            for levels, lookup, out in plain:
                lookup(levels[source], out[rows])
            if shN.shape[1]:
                entries = _entry(self.labels[source], self.layout.codebook_side)
                np.take(self.codebook, entries, axis=0, out=shN[rows], mode="clip")

        pool.map(work, blocks(count))
        return splats


def _entry(labels: UInt8[np.ndarray, "N C"], side: int) -> Int[np.ndarray, " N"]:
    """Return the index of the codebook entry: row (green) × S + column (red)."""
    return labels[:, 1].astype(np.int64) * side + labels[:, 0]


class _Lookup:
    """Lookup tables of 8-bit levels, one per channel, in one array."""

    def __init__(self, image: UInt8[np.ndarray, "..."], low: np.ndarray, high: np.ndarray) -> None:
        table = _table(image, low, high).astype(np.float32)
        self._table = table.reshape(-1)
        # One row of offsets per Gaussian of a step: NumPy adds equal shapes faster than it broadcasts short rows.
        self._offsets = np.tile(np.arange(len(table), dtype=np.uint16) * table.shape[1], (BLOCK, 1))

    def __call__(self, levels: UInt8[np.ndarray, "N C"], out: Float32[np.ndarray, "N C"]) -> None:
        for part in blocks(len(levels)):
            some = levels[part]
            np.take(self._table, some + self._offsets[: len(some)], out=out[part], mode="clip")


def _table(image: np.ndarray, low: np.ndarray, high: np.ndarray) -> Float64[np.ndarray, "C levels"]:
    """Return each channel's values of all levels up to the largest that occurs. The smallest and the largest level of
    the image, over all channels and cells, stand for ``low`` and ``high``."""
    first, last = int(image.min()), int(image.max())
    position = (np.arange(last + 1, dtype=np.float64) - first) / max(last - first, 1)
    return np.asarray(low[:, None] + np.maximum(position, 0) * (high - low)[:, None])


FORMAT = Codec(info=describe, read=decode)


def _opened(files: Source, name: str) -> Container:
    """Read the metadata of a zip, whose bytes are not kept until its images are decoded."""

    def opened() -> Source:
        return ZipSource(io.BytesIO(files.read(name, MAX_FILE_BYTES)), name)

    layout = read_layout(opened())
    if layout.count is None:
        raise InvalidContainerError(f"{name} does not state its number of Gaussians; compress the scene again")
    return Container(
        count=layout.count,
        sh_degree=layout.sh_degree,
        antialiased=layout.antialiased,
        ranges=layout.value_ranges,
        stored=lambda: (name, stored_size(files, name)),
        decode=lambda out, pool: decode_files(opened(), layout, out, pool),
    )


STREAMED = StreamedFormat("streamed SOG-XT scene", LEVELS_NAME, FORMAT_NAME, _opened)
