"""Partition of a scene into chunks of nearby Gaussians, in two passes over blocks that fit into memory."""

from __future__ import annotations

import itertools
import os
from pathlib import Path

import numpy as np

from kissgs.core.array_types import Float32, Int64
from kissgs.core.errors import OutputError
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.io.files import atomic_file, reason_of

# Gaussians as rows of float32 numbers in scratch files, which can be appended to and read back bit by bit.


def row_bytes(sh_degree: int) -> int:
    """Return the bytes of one Gaussian."""
    return 4 * (14 + 3 * SH_REST_COUNTS[sh_degree])


def to_rows(splats: Splats) -> Float32[np.ndarray, "N F"]:
    """Return all numbers of each Gaussian in a row."""
    rest = splats.shN.reshape(len(splats), 3 * splats.shN.shape[1])
    return np.concatenate(
        [splats.means, splats.quats, splats.scales, splats.opacities[:, None], splats.sh0, rest], axis=1
    )


def from_rows(rows: Float32[np.ndarray, "N F"], *, antialiased: bool) -> Splats:
    """Return the Gaussians of rows, of a scene that is ``antialiased`` or not."""
    parts = (np.ascontiguousarray(part) for part in np.split(rows, (3, 7, 10, 11, 14), axis=1))
    means, quats, scales, opacities, sh0, rest = parts
    shN = rest.reshape(len(rows), rest.shape[1] // 3, 3)
    return Splats(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities[:, 0],
        sh0=sh0,
        shN=shN,
        antialiased=antialiased,
    )


def append_rows(path: Path, rows: Float32[np.ndarray, "N F"]) -> None:
    """Append rows to a file."""
    try:
        with path.open("ab") as file:
            file.write(np.ascontiguousarray(rows).data)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error


def write_rows(path: Path, rows: Float32[np.ndarray, "N F"]) -> None:
    """Write a file of rows, atomically; an existing file is replaced."""
    with atomic_file(path, overwrite=True) as file:
        file.write(np.ascontiguousarray(rows).data)


def sync(path: Path) -> None:
    """Wait until a file is on the disk."""
    try:
        with path.open("ab") as file:
            os.fsync(file.fileno())
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error


def read_rows(path: Path, sh_degree: int, count: int) -> Float32[np.ndarray, "N F"]:
    """Read a file of ``count`` rows."""
    try:
        values = np.fromfile(path, np.float32)
        size = path.stat().st_size
    except OSError as error:
        raise OutputError(f"cannot read {path}: {reason_of(error)}") from error
    if size != count * row_bytes(sh_degree):
        raise OutputError(f"{path} is not complete; delete {path.parent} and start again")
    return values.reshape(count, row_bytes(sh_degree) // 4)


def chunk_depth(count: int, chunk: int) -> int:
    """Return the number of cuts one after another until chunks of a scene have at most about ``chunk`` Gaussians."""
    return max(0, int(np.ceil(np.log2(max(count, 1) / chunk))))


def leaf_groups(
    means: Float32[np.ndarray, "n 3"], leaf: int
) -> tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " e"]]:
    """Split a chunk into leaves of at most ``leaf`` Gaussians: indices, ascending within each leaf, and its edges."""
    from kissgs.rendering.cpu.neighbours import leaves_of

    order, edges = leaves_of(means, leaf)
    for first, last in itertools.pairwise(edges):
        order[first:last].sort()
    return order.astype(np.int64), edges
