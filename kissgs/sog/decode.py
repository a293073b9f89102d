"""SOG files -> ``Splats``; and the formats of single containers and of streamed scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.context import Progress, Workers, silent
from kissgs.core.errors import InvalidContainerError
from kissgs.core.positions import recorded, signed_exp
from kissgs.core.splats import Splats, blocks, empty_splats
from kissgs.formats import LOD_NAME
from kissgs.io.containers import META_NAME, Source, open_source, stored_size
from kissgs.io.conventions import insert_largest, look_up
from kissgs.io.files import refuse_more_than
from kissgs.io.images import decode_plane, decode_png, is_png, probe_png, probe_webp
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, ReadOptions, SceneSource, titled
from kissgs.io.streamed import Container, StreamedFormat
from kissgs.sog import ENTRIES_PER_ROW, FIRST_TAG
from kissgs.sog.metadata import MAX_SH_ENTRIES, Rest, SogLayout, read_layout

_FREE_PIXELS = 1 << 20  # beyond four per Gaussian: encoders may round sides up to powers of two


def describe(path: Path | bytes, level: int) -> Facts:
    """Return the facts of a SOG container."""
    with open_source(path) as files:
        layout = read_layout(files)
        parts = {name: stored_size(files, name) for name in (META_NAME, *layout.images)}
    return Facts(
        title=titled("SOG container", f"version {layout.version}", layout.model, layout.generator),
        count=layout.count,
        sh_degree=layout.sh_degree,
        parts=parts,
        ranges=layout.value_ranges(),
        notes=layout.notes,
        details={
            **recorded(layout.origin),
            "version": layout.version,
            "antialiased": layout.antialiased,
            "model": layout.model,
            "generator": layout.generator,
            "codebook_entries": layout.rest.entries if layout.rest else 0,
        },
    )


def decode(
    source: SceneSource, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Decode a container of version 1 or 2."""
    with open_source(source) as files, Workers(threads) as pool:
        layout = read_layout(files)
        refuse_more_than(reading.max_compressed, layout.count, "the container")
        progress("decode", 0.0)
        splats = empty_splats(layout.count, layout.rest.coefficients if layout.rest else 0)
        decode_files(files, layout, splats, pool)
        progress("decode", 1.0)
        return replace(splats, origin=layout.origin, antialiased=layout.antialiased, notes=layout.notes)


def decode_files(files: Source, layout: SogLayout, out: Splats, pool: Workers, folder: str = "") -> None:
    """Decode all images in parallel into ``out``, which has the container's number of Gaussians. SH coefficients above
    the container's degree are left as they are. ``folder`` is the prefix of file names."""
    images = _Images(files, layout, folder)
    jobs: tuple[Callable[[_Images, Splats], None], ...] = (
        *(_decode_quats, _decode_means, _decode_rest, _decode_scales, _decode_colors),
    )
    pool.map(lambda job: job(images, out), jobs)


class _Images:
    """Images of one container: read, checked, decompressed."""

    def __init__(self, files: Source, layout: SogLayout, folder: str) -> None:
        self.layout = layout
        self._files, self._folder = files, folder

    def plane(self, name: str, channels: int) -> UInt8[np.ndarray, "N C"]:
        """Return the image of a per-Gaussian attribute as one row per Gaussian."""
        count = self.layout.count
        most = 4 * count + _FREE_PIXELS
        data, width, height = self._open(name, most)
        if not count <= width * height <= most:
            raise InvalidContainerError(
                f"{name} is {width} x {height} pixels, which does not fit {count:,} Gaussians; export the scene again"
            )
        return _decode_image(data, name, width, height, channels)[:count]

    def codebook(self, rest: Rest) -> UInt8[np.ndarray, "entries D"]:
        """Return the SH codebook's levels, one row per entry."""
        name, most = rest.centroids, MAX_SH_ENTRIES * rest.coefficients
        data, width, height = self._open(name, most)
        entries = rest.entries or height * ENTRIES_PER_ROW
        rows = -(-entries // ENTRIES_PER_ROW)
        if width != ENTRIES_PER_ROW * rest.coefficients or not rows <= height <= MAX_SH_ENTRIES // ENTRIES_PER_ROW:
            raise InvalidContainerError(
                f"{name} is {width} x {height} pixels; {entries:,} entries of {rest.coefficients} coefficients need "
                f"{ENTRIES_PER_ROW * rest.coefficients} x {rows}: export the scene again"
            )
        image = _decode_image(data, name, width, height, 3)
        return image.reshape(height * ENTRIES_PER_ROW, rest.coefficients * 3)[:entries]

    def _open(self, name: str, most_pixels: int) -> tuple[bytes, int, int]:
        # Lossless WebP and PNG never need more than 4 bytes a pixel, and some for headers.
        data = self._files.read(self._folder + name, 4096 + 5 * most_pixels)
        return data, *(probe_png if is_png(data) else probe_webp)(data, name)


def _decode_image(data: bytes, name: str, width: int, height: int, channels: int) -> UInt8[np.ndarray, "pixels C"]:
    if is_png(data):
        return decode_png(data, name, channels)
    return decode_plane(data, name, width=width, height=height, channels=channels)


def _decode_means(images: _Images, out: Splats) -> None:
    layout = images.layout
    levels = images.plane(layout.files["means_high"], 3).astype(np.uint16)
    levels <<= 8
    levels |= images.plane(layout.files["means_low"], 3)
    position = np.arange(65536) / 65535
    for axis in range(3):
        logs = layout.low[axis] + (layout.high[axis] - layout.low[axis]) * position
        table = signed_exp(logs).astype(np.float32)
        for part in blocks(len(out)):
            out.means[part, axis] = table[levels[part, axis]]


def _decode_quats(images: _Images, out: Splats) -> None:
    name = images.layout.files["quats"]
    pixels = images.plane(name, 4)
    if len(pixels) and int(pixels[:, 3].min()) < FIRST_TAG:
        raise InvalidContainerError(
            f"{name} has a rotation whose alpha is {pixels[:, 3].min()}; {FIRST_TAG} to 255 are valid: "
            "export the scene again"
        )
    for part in blocks(len(out)):
        small = (pixels[part, :3] / 255 - 0.5) * np.sqrt(2)
        out.quats[part] = insert_largest(small, pixels[part, 3].astype(np.int64) - FIRST_TAG)


def _decode_scales(images: _Images, out: Splats) -> None:
    name = images.layout.files["scales"]
    _decode_levels(name, images.plane(name, 3), images.layout.scales, out.scales)


def _decode_colors(images: _Images, out: Splats) -> None:
    name = images.layout.files["sh0"]
    pixels = images.plane(name, 4)
    _decode_levels(name, pixels[:, :3], images.layout.sh0, out.sh0)
    look_up(images.layout.opacities, pixels[:, 3], out.opacities)


def _decode_levels(
    name: str, levels: UInt8[np.ndarray, "N 3"], table: Float32[np.ndarray, "3 256"], out: Float32[np.ndarray, "N 3"]
) -> None:
    for channel in range(3):
        _check_levels(name, levels[:, channel], table[channel])
        for part in blocks(len(out)):
            out[part, channel] = table[channel][levels[part, channel]]


def _decode_rest(images: _Images, out: Splats) -> None:
    rest = images.layout.rest
    if rest is None:
        return
    shN = out.shN[:, : rest.coefficients]
    codes = images.codebook(rest)
    _check_levels(rest.centroids, codes, rest.table)
    codebook = rest.table[codes].reshape(len(codes), rest.coefficients, 3)
    labels = images.plane(rest.labels, 3)
    for part in blocks(len(shN)):
        entry = labels[part, 0] | labels[part, 1].astype(np.int64) << 8
        if int(entry.max()) >= len(codebook):
            raise InvalidContainerError(
                f"{rest.labels} points outside the codebook of {len(codebook):,} entries; export the scene again"
            )
        np.take(codebook, entry, axis=0, out=shN[part], mode="clip")


def _check_levels(name: str, levels: UInt8[np.ndarray, "..."], table: Float32[np.ndarray, " 256"]) -> None:
    """Refuse levels for which the codebook has no value."""
    missing = np.isnan(table)
    if missing.any() and missing[levels].any():
        raise InvalidContainerError(f"{name} uses a level for which its codebook has no number; export the scene again")


FORMAT = Codec(info=describe, read=decode)


def _opened(files: Source, name: str) -> Container:
    layout, folder = read_layout(files, name), name[: name.rfind("/") + 1]

    def stored() -> tuple[str, int]:
        return folder or META_NAME, sum(stored_size(files, folder + each) for each in (META_NAME, *layout.images))

    return Container(
        count=layout.count,
        sh_degree=layout.sh_degree,
        antialiased=layout.antialiased,
        notes=layout.notes,
        ranges=layout.value_ranges,
        stored=stored,
        decode=lambda out, pool: decode_files(files, layout, out, pool, folder),
    )


STREAMED = StreamedFormat("streamed SOG scene", LOD_NAME, None, _opened)
