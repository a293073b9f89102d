"""The 3DGS ``.ply``: read scenes of INRIA's trainer and other tools, write INRIA's layout."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import BLOCK, SH_C0, SH_REST_COUNTS, Splats, concatenate, empty_splats
from kissgs.io.compressed_ply import check_compressed, is_compressed, read_compressed
from kissgs.io.ply_body import check_complete, rows
from kissgs.io.ply_header import MIP_COMMENT, Element, Encoding, PlyFile, open_ply, sh_degree
from kissgs.io.scene_file import BinaryWriter, refuse_more_than

_POSITION = ("x", "y", "z")
_NORMAL = ("nx", "ny", "nz")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
_SCALE = ("scale_0", "scale_1", "scale_2")
_OPACITY = ("opacity",)
_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
_RGB = ("red", "green", "blue")

_WRITE_ROWS = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class PlyInfo:
    """Properties of a scene that the header of its file states."""

    count: int
    """Number of Gaussians."""
    sh_degree: int
    """SH degree, 0 to 3."""
    encoding: Encoding
    """Encoding of the body, as the header names it."""
    compressed: bool
    """Whether it is PlayCanvas' compressed ``.ply``."""
    antialiased: bool = False
    """Whether a comment of Brush or Postshot says that the scene was trained with antialiasing."""


def read_ply_info(source: Path | bytes, *, size: int | None = None) -> PlyInfo:
    """Read the header of a ``.ply`` and check it against the file's size, without reading the body.

    Args:
        source: A file, or the bytes of one; the beginning with the whole header is enough.
        size: Bytes of the whole file if ``source`` is only its beginning.

    Raises:
        InvalidSceneError: as for :func:`read_ply`, except for errors in the body.
        UnsupportedError: as for :func:`read_ply`.
    """
    with open_ply(source, size=size) as ply:
        return _check(ply)


def read_ply(source: Path | bytes, *, max_gaussians: int | None = None, progress: Progress = silent) -> Splats:
    """Read a scene without cleaning it: NaN, infinities and quaternions of any length are kept.

    Reads binary and ascii files, with properties in any order and of any type, and PlayCanvas' compressed ``.ply``.
    Elements and properties that Gaussians do not need are ignored, as are bytes after the end. 8-bit ``red``,
    ``green``, ``blue``, which nerfstudio may write instead of ``f_dc_*``, become the constant SH coefficients.
    Needs some megabytes of memory besides the scene itself.

    Args:
        source: A file, or the bytes of one.
        max_gaussians: Largest number of Gaussians; more are refused before memory is allocated. None: no limit.
        progress: Receives events of stage ``read``.

    Raises:
        InvalidSceneError: the file cannot be read, is not a PLY file, is damaged or cut short, or has no Gaussians.
        UnsupportedError: 2D Gaussians, an SH degree above 3, lists before or among the Gaussians, or more Gaussians
            than ``max_gaussians``.
    """
    with open_ply(source) as ply:
        info = _check(ply)
        refuse_more_than(max_gaussians, info.count, ply.name)
        progress("read", 0.0)
        if info.compressed:
            return read_compressed(ply, info.sh_degree, progress)
        return replace(_read_columns(ply, info.sh_degree, progress), antialiased=info.antialiased)


def read_ply_blocks(source: Path, *, progress: Progress = silent) -> Iterator[Splats]:
    """Yield a scene as :func:`read_ply` reads it, some 65,536 Gaussians at a time.

    PlayCanvas' compressed ``.ply`` comes as one block. Arguments and errors are those of :func:`read_ply`; errors of
    the body are raised when its block is reached.
    """
    with open_ply(source) as ply:
        info = _check(ply)
        progress("read", 0.0)
        if info.compressed:
            yield read_compressed(ply, info.sh_degree, progress)
            return
        columns, waiting, done = _Columns(ply.header.elements["vertex"], info.sh_degree), [], 0
        for block in rows(ply, columns.vertex):
            waiting.append(columns.splats(block))
            done += len(block)
            if sum(map(len, waiting)) >= BLOCK or done == info.count:
                yield replace(concatenate(waiting), antialiased=info.antialiased)
                waiting = []
                progress("read", done / info.count)


def write_ply(file: BinaryWriter, splats: Splats, *, progress: Progress = silent) -> None:
    """Write ``splats`` in INRIA's layout: float32, little-endian, normals zero, the ``f_rest_*`` of the SH degree.

    An antialiased scene is marked by a comment, :data:`kissgs.io.ply_header.MIP_COMMENT`.

    Args:
        file: The stream; it is not flushed or closed, and its OSErrors are not caught.
        splats: The scene; its float32 values are written bit-identically.
        progress: Receives events of stage ``write``.
    """
    n, k = len(splats), splats.shN.shape[1]
    names = (*_POSITION, *_NORMAL, *_COLOUR, *_rest(k), *_OPACITY, *_SCALE, *_ROTATION)
    header = ["ply", "format binary_little_endian 1.0", *[MIP_COMMENT] * splats.antialiased, f"element vertex {n}"]
    header += [f"property float {name}" for name in names]
    file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
    for start in range(0, n, _WRITE_ROWS):
        part = splats.select(slice(start, start + _WRITE_ROWS))
        rest = part.shN.transpose(0, 2, 1).reshape(len(part), 3 * k)  # all of R, then G, then B
        normals, opacities = np.zeros_like(part.means), part.opacities[:, None]
        table = np.concatenate([part.means, normals, part.sh0, rest, opacities, part.scales, part.quats], axis=1)
        file.write(table.astype("<f4", copy=False).data)
        progress("write", min(1.0, (start + _WRITE_ROWS) / n))


def _check(ply: PlyFile) -> PlyInfo:
    """Check everything that does not need the body."""
    vertex = ply.header.elements.get("vertex")
    if vertex is None:
        raise InvalidSceneError(f"{ply.name} has no element 'vertex', so no Gaussians; name a trained 3DGS scene")
    compressed = is_compressed(ply.header)
    if compressed:
        degree = check_compressed(ply)
    else:
        _require_gaussians(vertex, ply.name)
        degree = sh_degree(vertex, ply.name)
        check_complete(ply, vertex)
    return PlyInfo(
        count=vertex.count,
        sh_degree=degree,
        encoding=ply.header.encoding,
        compressed=compressed,
        antialiased=ply.header.antialiased,
    )


def _require_gaussians(vertex: Element, name: str) -> None:
    present = {p.name for p in vertex.properties}
    colour = () if _has_rgb(vertex) else _COLOUR
    missing = [p for p in (*_POSITION, *_OPACITY, *_SCALE, *_ROTATION, *colour) if p not in present]
    if not missing:
        return
    if present.isdisjoint({*_OPACITY, *_SCALE, *_ROTATION}):
        raise InvalidSceneError(
            f"{name} is a point cloud or a mesh, not a trained 3DGS scene: it has no {', '.join(missing)}; "
            "name the output of a 3DGS trainer"
        )
    if missing == ["scale_2"]:
        raise UnsupportedError(f"{name} holds 2D Gaussians (no scale_2), which are not supported; train 3D Gaussians")
    raise InvalidSceneError(f"{name} has no {', '.join(missing)}; export the scene with all its properties")


def _has_rgb(vertex: Element) -> bool:
    """Whether the colour is given only by 8-bit red, green, blue."""
    codes = {p.name: p.code for p in vertex.properties}
    return codes.keys().isdisjoint(_COLOUR) and all(codes.get(name) == "u1" for name in _RGB)


def _rest(k: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(3 * k))


def _read_columns(ply: PlyFile, degree: int, progress: Progress) -> Splats:
    columns = _Columns(ply.header.elements["vertex"], degree)
    count, start = columns.vertex.count, 0
    splats = empty_splats(count, SH_REST_COUNTS[degree])
    for block in rows(ply, columns.vertex):
        columns.copy(block, splats.select(slice(start, start + len(block))))
        start += len(block)
        progress("read", start / count)
    return splats


class _Columns:
    """The properties of a ``.ply`` that each array of a scene is read from."""

    def __init__(self, vertex: Element, degree: int) -> None:
        self.vertex = vertex
        self._k = SH_REST_COUNTS[degree]
        self._rgb = _has_rgb(vertex)

    def splats(self, block: np.ndarray) -> Splats:
        """Return the Gaussians of some rows."""
        splats = empty_splats(len(block), self._k)
        self.copy(block, splats)
        return splats

    def copy(self, block: np.ndarray, out: Splats) -> None:
        """Copy rows to the arrays of ``out``, of the same length."""
        k, n = self._k, len(block)
        # f_rest_* has all coefficients of R, then G, then B; shN has R, G, B of the first, then of the second…
        rest = tuple(f"f_rest_{channel * k + i}" for i in range(k) for channel in range(3))
        groups = {
            _POSITION: out.means,
            _ROTATION: out.quats,
            _SCALE: out.scales,
            _OPACITY: out.opacities[:, None],
            (_RGB if self._rgb else _COLOUR): out.sh0,
            rest: out.shN.reshape(n, 3 * k),
        }
        with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes infinite, as it should
            for names, array in groups.items():
                for i, name in enumerate(names):
                    array[:, i] = block[name]
        if self._rgb:
            _colour_to_sh(out.sh0)


def _colour_to_sh(colour: Float32[np.ndarray, "N 3"]) -> None:
    """Convert 8-bit colour to the constant SH coefficient, in place."""
    colour /= 255
    colour -= 0.5
    colour /= np.float32(SH_C0)
