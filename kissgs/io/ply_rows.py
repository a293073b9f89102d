"""PLY files: the header, and the rows of an element, binary or ascii, block by block."""

from __future__ import annotations

import codecs
import contextlib
import io
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.io.files import SceneFile, open_scene_file, refuse_degree

# PLY headers: opening a file, parsing its header, and the SH degree that the header declares.

Encoding = Literal["ascii", "binary_little_endian", "binary_big_endian"]

MAX_HEADER_BYTES = 1 << 20  # one of degree 3 takes 1.5 kB; a megabyte leaves room for metadata in comments
MAX_PROPERTIES = 4096  # per element; a degree-3 scene has 62, one with feature vectors some hundred more

_CODES = ("i1", "u1", "i2", "u2", "i4", "u4", "f2", "f4", "f8")
_TYPES = dict(zip(("char", "uchar", "short", "ushort", "int", "uint", "half", "float", "double"), _CODES, strict=True))
_TYPES |= {np.dtype(code).name: code for code in _CODES}
"""NumPy's code of every type name: both families of PLY names, and the half floats that some 3DGS tools write."""

_LOOKALIKES = {
    b"version https://git-lfs.github.com/spec/": "this is a Git LFS pointer, fetch the real file (git lfs pull)",
    b"<!doctype": "this is an HTML page, download the file that it links to",
    b"<html": "this is an HTML page, download the file that it links to",
    b"\x1f\x8b": "this is compressed with gzip, unpack it first",
    codecs.BOM_UTF16_LE: "this is text in UTF-16, save it as ASCII or UTF-8",
    codecs.BOM_UTF16_BE: "this is text in UTF-16, save it as ASCII or UTF-8",
    b"pk\x03\x04": "this is a ZIP archive, unpack it or name the scene by its real extension",
}
"""Hints for other files that are often given as a scene, by their first bytes in lower case."""

_MARK = re.compile(
    r"(?:(?:splat_?render_?mode|rasteri[sz]e[-_ ]?mode)\s*[:=]?\s*([\w-]+)|"
    r"(?:trained with )?(?:anti[-_ ]?alias(?:ed|ing)?|mip[-_ ]?splatting)\s*(?:[:=]?\s*([\w.]+))?)\s*",
    re.IGNORECASE,
)
"""Comments that say whether a scene is antialiased: Brush's or gsplat's mode, and Postshot's flag."""


@dataclass(frozen=True, slots=True)
class Property:
    """Property of an element; ``code`` is its NumPy type without byte order, such as ``f4``."""

    name: str
    code: str
    is_list: bool = False


@dataclass(frozen=True, slots=True)
class Element:
    """Element: ``count`` rows of ``properties``, whose names are all different."""

    name: str
    count: int
    properties: tuple[Property, ...]

    def dtype(self, encoding: Encoding) -> np.dtype:
        """Return the dtype of a row: that of a binary file, or all float64 for ascii."""
        if encoding == "ascii":
            return np.dtype([(p.name, "f8") for p in self.properties])
        order = ">" if encoding == "binary_big_endian" else "<"
        return np.dtype([(p.name, order + p.code) for p in self.properties])


@dataclass(frozen=True, slots=True)
class Header:
    """Parsed header; ``nbytes`` and ``lines`` are its size, after which the body begins."""

    encoding: Encoding
    elements: dict[str, Element]
    nbytes: int
    lines: int
    antialiased: bool  # whether a comment says that the scene was trained with antialiasing


@dataclass(frozen=True, slots=True)
class PlyFile(SceneFile):
    """Open PLY file and its header."""

    header: Header


@contextlib.contextmanager
def open_ply(source: Path | bytes, *, size: int | None = None) -> Iterator[PlyFile]:
    """Open a file, or the bytes of one, and parse the header. The body is not read. ``size`` is that of the whole file
    if ``source`` is only its beginning."""
    with open_scene_file(source) as opened:
        header = _read_header(opened)
        yield PlyFile(opened.name, opened.file, opened.size if size is None else size, header)


def header_bytes(lines: Sequence[str], antialiased: bool) -> bytes:
    """Return the header of elements and properties; a scene is marked as Brush and splat-transform mark it."""
    mark = ["comment SplatRenderMode: mip"] * antialiased
    return "\n".join(["ply", "format binary_little_endian 1.0", *mark, *lines, "end_header\n"]).encode("ascii")


def sh_degree(element: Element, name: str) -> int:
    """Return the SH degree of the ``f_rest_*`` properties of ``element``; ``name`` is the file's, for messages."""
    rest = {p.name for p in element.properties if re.fullmatch(r"f_rest_[0-9]+", p.name)}
    count = len(rest)
    missing = [f"f_rest_{i}" for i in range(count) if f"f_rest_{i}" not in rest]
    if missing:
        raise InvalidSceneError(f"{name} has {count} f_rest properties but no {missing[0]}; export the scene again")
    if count % 3 == 0 and count // 3 in SH_REST_COUNTS:
        return SH_REST_COUNTS.index(count // 3)
    degree = round((count / 3 + 1) ** 0.5) - 1
    if 3 * ((degree + 1) ** 2 - 1) == count:
        refuse_degree(degree, name)
    raise InvalidSceneError(f"{name} has {count} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45")


def _read_header(opened: SceneFile) -> Header:
    file, name = opened.file, opened.name
    start = file.read(64)
    mark = len(codecs.BOM_UTF8) if start.startswith(codecs.BOM_UTF8) else 0
    _recognise(start[mark:], name)
    file.seek(mark)
    encoding: Encoding | None = None
    counts: dict[str, int] = {}
    properties: dict[str, dict[str, Property]] = {}
    antialiased = False
    for number, words in _header_lines(file, name):
        where = f"{name}, header line {number}"
        match words:
            case ["ply"] if number == 1:
                continue
            case ["comment" | "obj_info", *text]:
                antialiased = _marked(" ".join(text), antialiased)
            case []:
                continue
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as named, *_]:
                if encoding not in (None, named):
                    raise InvalidSceneError(
                        f"{where}: the format is {named}, and before it was {encoding}; delete the line that is wrong"
                    )
                encoding = named
            case ["format", other, *_]:
                raise InvalidSceneError(
                    f"{where}: unknown format {_quote(other)}; it is ascii, binary_little_endian or binary_big_endian"
                )
            case ["element", element, count]:
                if element in counts:
                    raise InvalidSceneError(f"{where}: a second element {_quote(element)}; each may occur once")
                if not re.fullmatch(r"[0-9]{1,18}", count):  # 64 bits; it is checked against the file's size later
                    raise InvalidSceneError(
                        f"{where}: the count is {_quote(count)}, not a whole number from 0 to 10^18"
                    )
                counts[element] = int(count)
                properties[element] = {}
            case ["property", *definition] if counts:
                _add_property(properties[next(reversed(counts))], definition, where)
            case ["end_header"]:
                if encoding is None:
                    raise InvalidSceneError(f"{name} has no format line in its header; export the scene again")
                elements = {key: Element(key, counts[key], tuple(properties[key].values())) for key in counts}
                return Header(encoding, elements, file.tell(), number, antialiased)
            case _:
                raise InvalidSceneError(f"{where}: {_quote(' '.join(words))} is not a line of a PLY header")
    raise InvalidSceneError(f"{name} has no end_header line; it is cut short or not a PLY file")


def _marked(comment: str, before: bool) -> bool:
    """Return whether a scene is antialiased after one more comment; the last one that says whether it is counts."""
    found = _MARK.fullmatch(comment)
    if found is None:
        return before
    mode, flag = (group and group.lower() for group in found.groups())
    if mode:
        return mode in ("mip", "mip-splatting", "antialiased")
    return flag in (None, "1", "1.0", "true", "yes", "on", "enabled")


def _recognise(head: bytes, name: str) -> None:
    """Refuse a file that is not PLY, with a hint to its actual format."""
    if not head:
        raise InvalidSceneError(f"{name} is empty; export or download it again")
    start = head.lstrip().lower()
    for magic, hint in _LOOKALIKES.items():
        if start.startswith(magic):
            raise InvalidSceneError(f"{name} is not a PLY file: {hint}")
    if re.match(rb"ply[ \t]*\r[^\n]", head):
        raise InvalidSceneError(f"{name} has lines that end in CR alone; save it with the line ends LF or CRLF")
    if not re.match(rb"ply[ \t]*\r?\n", head):
        raise InvalidSceneError(
            f"{name} is not a PLY file: its first line is not 'ply', and no other format is recognised; a .splat needs "
            "this ending"
        )


def _header_lines(file: io.BufferedIOBase, name: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines as words, numbered from 1; an incomplete last line ends the iteration."""
    left = MAX_HEADER_BYTES
    for number in itertools.count(1):
        line = file.readline(left + 1)
        left -= len(line)
        if left < 0:
            raise InvalidSceneError(f"{name} has no end_header line within {MAX_HEADER_BYTES} bytes; it is damaged")
        if not line.endswith(b"\n") and line.strip() != b"end_header":
            return
        yield number, line.decode("utf-8", errors="replace").split()


def _add_property(properties: dict[str, Property], definition: list[str], where: str) -> None:
    match definition:
        case ["list", length_type, item_type, name]:
            types = [length_type, item_type]
        case [scalar_type, name]:
            types = [scalar_type]
        case _:
            raise InvalidSceneError(f"{where}: a property needs a type and a name")
    unknown = next((kind for kind in types if kind not in _TYPES), None)
    if unknown is not None:
        raise InvalidSceneError(f"{where}: unknown type {_quote(unknown)}; known are {', '.join(_TYPES)}")
    if name in properties:
        raise InvalidSceneError(f"{where}: a second property {_quote(name)}; each may occur once")
    if len(properties) == MAX_PROPERTIES:
        raise UnsupportedError(f"{where}: more than {MAX_PROPERTIES} properties in one element; remove some")
    properties[name] = Property(name, _TYPES[types[-1]], is_list=len(types) == 2)


def _quote(word: str) -> str:
    """Return ``word`` in quotes, unprintable characters escaped, cut to 40 characters."""
    return repr(word if len(word) <= 40 else word[:39] + "…")


# Rows of a PLY element, binary or ascii, block by block.

BLOCK_BYTES = 1 << 20  # bytes per block: small enough to stay in the processor's cache until all columns are copied
BLOCK_ALIGNMENT = 256  # row count that the blocks of rows, except the last, are multiples of in binary files

_INFINITY = re.compile(r"(?<!\S)([+-]?)1\.#inf\d*(e[+-]?\d+)?(?!\S)", re.IGNORECASE)
_NAN = re.compile(r"(?<!\S)[+-]?(nan(\([^\s()]*\)|[qs])|[qs]nan|1\.#[a-z]+\d*(e[+-]?\d+)?|1\.\$)(?!\S)", re.IGNORECASE)
"""Infinity and NaN as C libraries print them, and Python does not read them.

``nan(snan)``, ``-nan(ind)``, ``nan(0x7fc00000)``, ``nanq``; of Visual C++ before 2015 ``1.#INF``, ``-1.#IND``,
``1.#QNAN0``, and rounded to few digits ``1.#J``, ``1.#R``, ``1.$``, which may have been either.
"""


def check_complete(ply: PlyFile, element: Element) -> None:
    """Check that the file is large enough for all rows of ``element``, before memory for them is allocated."""
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
    """Yield all rows of ``element``, in order, as structured arrays with one field per property. The fields have the
    types of the file; in ascii files all are float64. Each block is overwritten by the next."""
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
    """Yield the non-blank lines of an ascii body with their line numbers, one block at a time. A last line without a
    line end and with fewer than ``width`` values is skipped: the file was cut there."""
    ply.file.seek(ply.header.nbytes)
    number = ply.header.lines
    rest = b""
    while block := ply.file.read(BLOCK_BYTES):
        *complete, rest = (rest + block).split(b"\n")
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
    return ply.invalid(f"is cut short: it declares {element.count:,} {what} but has room for {found:,}")
