"""The ``.splat`` format: 32 bytes per Gaussian, without a header, without view-dependent colour. Position and linear
standard deviations are floats; colour and opacity, after their activations, and the rotation w, x, y, z are bytes. The
axes are those of a ``.ply``. Nothing in a file says that it is one: its name's ending must."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from kissgs.core.array_types import Shaped
from kissgs.core.context import Progress, silent
from kissgs.core.splats import Splats, blocks, empty_splats
from kissgs.io.conventions import (
    OPACITY_OF_BYTE,
    SH0_OF_BYTE,
    byte_quats,
    clamped,
    colors_of,
    log_scales,
    marks_left_out,
    opacities_of,
    to_bytes,
)
from kissgs.io.files import BinaryWriter, SceneFile, open_scene_file, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, Notes, ReadOptions

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])  # one Gaussian


def read_splat(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene."""
    with open_scene_file(source) as opened:
        count = _count(opened)
        refuse_more_than(reading.max_gaussians, count, opened.name)
        progress("read", 0.0)
        splats = empty_splats(count, 0)
        for part, rows in opened.rows(0, ROW, count):
            _decode(rows, splats.select(part))
            progress("read", part.stop / count)
        return splats


def write_splat(file: BinaryWriter, splats: Splats, raw_axes: bool = False, progress: Progress = silent) -> Notes:
    """Write a scene, large and opaque Gaussians first, as viewers that draw while they load expect."""
    logits = splats.opacities.astype(np.float64)
    log_weight = splats.scales.sum(axis=1, dtype=np.float64) - np.logaddexp(0, -logits)
    order = np.argsort(-log_weight, kind="stable")  # by volume times opacity; equal ones keep their order
    for part in blocks(len(splats)):
        file.write(_encode(splats.select(order[part])).tobytes())
        progress("write", part.stop / len(splats))
    notes = [f"view-dependent colour (SH degree {splats.sh_degree}) is left out"] * (splats.sh_degree > 0)
    notes += marks_left_out(splats)
    edge = 0.5 / 255
    return (*notes, *clamped("colours", colors_of(splats.sh0), -edge, 1 + edge, "0 to 1"))


def _encode(splats: Splats) -> Shaped[np.ndarray, " B"]:
    rows = np.empty(len(splats), ROW)
    rows["means"] = splats.means
    rows["scales"] = np.exp(splats.scales.astype(np.float64))
    rows["rgba"][:, :3] = to_bytes(255 * colors_of(splats.sh0))
    rows["rgba"][:, 3] = to_bytes(255 * opacities_of(splats.opacities))
    rows["quats"] = to_bytes(128 * splats.quats.astype(np.float64) + 128)
    return rows


def _count(opened: SceneFile) -> int:
    if opened.size % ROW.itemsize:
        raise opened.invalid(f"is no .splat file or is cut short: its {opened.size:,} bytes are no multiple of 32")
    return opened.size // ROW.itemsize


def _decode(rows: Shaped[np.ndarray, " B"], out: Splats) -> None:
    """Decode rows into the arrays of ``out``, which has as many Gaussians."""
    out.means[:] = rows["means"]
    out.scales[:] = log_scales(rows["scales"])
    out.quats[:] = byte_quats(rows["quats"])
    out.sh0[:] = SH0_OF_BYTE[rows["rgba"][:, :3]]
    out.opacities[:] = OPACITY_OF_BYTE[rows["rgba"][:, 3]]


def _describe(path: Path | bytes, level: int) -> Facts:
    with open_scene_file(path) as opened:
        return Facts(title=".splat scene", count=_count(opened), sh_degree=0)


FORMAT = Codec(info=_describe, read=read_splat, write={".splat": write_splat})
