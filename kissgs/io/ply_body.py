"""Rows of a PLY element, binary or ascii, block by block."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.io.ply_header import Element, PlyFile

BLOCK_BYTES = 1 << 20
"""Bytes per block: small enough to stay in the processor's cache until all columns are copied."""

BLOCK_ALIGNMENT = 256
"""Row count that the blocks of :func:`rows`, except the last, are multiples of in binary files."""

_INFINITY = re.compile(r"(?<!\S)([+-]?)1\.#inf\d*(e[+-]?\d+)?(?!\S)", re.IGNORECASE)
_NAN = re.compile(r"(?<!\S)[+-]?(nan(\([^\s()]*\)|[qs])|[qs]nan|1\.#[a-z]+\d*(e[+-]?\d+)?|1\.\$)(?!\S)", re.IGNORECASE)
"""Infinity and NaN as C libraries print them, and Python does not read them.

``nan(snan)``, ``-nan(ind)``, ``nan(0x7fc00000)``, ``nanq``; of Visual C++ before 2015 ``1.#INF``, ``-1.#IND``,
``1.#QNAN0``, and rounded to few digits ``1.#J``, ``1.#R``, ``1.$``, which may have been either.
"""


def check_complete(ply: PlyFile, element: Element) -> None:
    """Check that the file is large enough for all rows of ``element``, before memory for them is allocated.

    Raises:
        InvalidSceneError: the file ends before the last row does.
        UnsupportedError: a list property makes the positions of the rows unknown.
    """
    if any(p.is_list for p in element.properties):
        raise UnsupportedError(f"{ply.name} has a list property in element {element.name!r}; export it without")
    if ply.header.encoding == "ascii":
        # A value takes at least two bytes, a digit and a separator; the last separator may be missing.
        row_bytes, available = 2 * len(element.properties), ply.size - ply.header.nbytes + 1
    else:
        row_bytes, available = element.dtype(ply.header.encoding).itemsize, ply.size - _offset(ply, element)
    if element.count * row_bytes > available:
        raise _cut_short(ply, element, max(0, available // row_bytes))


def rows(ply: PlyFile, element: Element) -> Iterator[np.ndarray]:
    """Yield all rows of ``element``, in order, as structured arrays with one field per property.

    The fields have the types of the file; in ascii files all are float64. Each block is overwritten by the next.

    Raises:
        InvalidSceneError: the file ends too soon, or a line of an ascii file is not a row of numbers.
    """
    return _ascii_rows(ply, element) if ply.header.encoding == "ascii" else _binary_rows(ply, element)


def _binary_rows(ply: PlyFile, element: Element) -> Iterator[np.ndarray]:
    dtype = element.dtype(ply.header.encoding)
    length = BLOCK_BYTES // (dtype.itemsize * BLOCK_ALIGNMENT) * BLOCK_ALIGNMENT
    # Read into one buffer, not mapped: mapped pages would count as memory of this process, and a file that is truncated
    # meanwhile would kill it instead of giving a short read.
    buffer = np.empty(min(max(length, BLOCK_ALIGNMENT), element.count), dtype)
    ply.file.seek(_offset(ply, element))
    for start in range(0, element.count, max(1, len(buffer))):
        block = buffer[: element.count - start]
        read = ply.file.readinto(block.view(np.uint8).data)
        if read < block.nbytes:
            raise _cut_short(ply, element, start + read // dtype.itemsize)
        yield block


def _offset(ply: PlyFile, element: Element) -> int:
    """Return the offset of the first row of ``element`` in a binary file, bytes."""
    offset = ply.header.nbytes
    for other in ply.header.elements.values():
        if other is element:
            break
        if other.count and any(p.is_list for p in other.properties):  # no known tool writes Gaussians after lists
            raise UnsupportedError(
                f"{ply.name} has element {other.name!r} with a list property before {element.name!r}; "
                f"export it with {element.name!r} first"
            )
        offset += other.count * other.dtype(ply.header.encoding).itemsize
    return offset


def _ascii_rows(ply: PlyFile, element: Element) -> Iterator[np.ndarray]:
    dtype = element.dtype("ascii")
    elements = list(ply.header.elements.values())
    skip = sum(other.count for other in elements[: elements.index(element)])
    left = element.count
    for lines in _numbered_lines(ply, len(element.properties)):
        if not left:
            return
        wanted = lines[skip : skip + left]
        skip -= min(skip, len(lines))
        left -= len(wanted)
        if wanted:
            yield _parse(wanted, dtype, ply.name)
    if left:
        raise _cut_short(ply, element, element.count - left)


def _numbered_lines(ply: PlyFile, width: int) -> Iterator[list[tuple[int, str]]]:
    """Yield the non-blank lines of an ascii body with their line numbers, one block at a time.

    A last line without a line end and with fewer than ``width`` values is skipped: the file was cut there.
    """
    ply.file.seek(ply.header.nbytes)
    number = ply.header.lines
    rest = b""
    while block := ply.file.read(BLOCK_BYTES):
        *complete, rest = (rest + block).split(ply.header.newline)
        if len(rest) > BLOCK_BYTES:
            raise InvalidSceneError(f"{ply.name}, line {number + 1}: longer than {BLOCK_BYTES} bytes; it is damaged")
        yield [(number + i, text) for i, line in enumerate(complete, 1) if (text := line.decode("latin-1").strip())]
        number += len(complete)
    if len(rest.split()) >= width:
        yield [(number + 1, rest.decode("latin-1").strip())]


def _parse(lines: list[tuple[int, str]], dtype: np.dtype, name: str) -> np.ndarray:
    try:
        return np.loadtxt([text for _, text in lines], dtype, comments=None, ndmin=1)
    except ValueError as error:
        plain = [(number, _NAN.sub("nan", _INFINITY.sub(r"\1inf", text))) for number, text in lines]
        if plain != lines:
            return _parse(plain, dtype, name)
        for number, text in lines:
            _check_line(text.split(), dtype.names or (), f"{name}, line {number}")
        first, last = lines[0][0], lines[-1][0]
        raise InvalidSceneError(f"{name}, lines {first} to {last}: not all are rows of numbers") from error


def _check_line(words: list[str], names: tuple[str, ...], where: str) -> None:
    """Raise an error if the line is wrong; the fast parser reports only that its block has an error."""
    if len(words) != len(names):
        raise InvalidSceneError(f"{where}: {len(words)} values where the header declares {len(names)} properties")
    for word, name in zip(words, names, strict=True):
        try:
            float(word)
        except ValueError:
            raise InvalidSceneError(f"{where}: {word[:40]!r} for {name} is not a number") from None


def _cut_short(ply: PlyFile, element: Element, found: int) -> InvalidSceneError:
    what = "Gaussians" if element.name == "vertex" else f"rows of element {element.name!r}"
    return InvalidSceneError(
        f"{ply.name} is cut short: it declares {element.count:,} {what} but has room for {found:,}; "
        "export or download it again"
    )
