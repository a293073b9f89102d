"""Streaming parser of ``multipart/form-data`` that buffers no part."""

from __future__ import annotations

import re
import urllib.parse
from collections.abc import AsyncIterable, AsyncIterator
from dataclasses import dataclass

from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from ..core.problems import ProblemError

MAX_PART_HEADER_BYTES = 8192

MAX_PREAMBLE_BYTES = 8192
"""Maximum bytes before the first boundary, where RFC 2046 allows text, which is ignored."""


_PARAMETER = re.compile(rb';[ \t]*([^\s;="]+)[ \t]*=[ \t]*("(?:[^"\\]|\\.)*"|[^;"]*)')
"""Name and value of a parameter of a header."""

_EXTENDED = re.compile(rb"(utf-?8|iso-8859-1)'[A-Za-z0-9-]*'((?:[!#$&+.^_`|~A-Za-z0-9-]|%[0-9A-F]{2})+)", re.IGNORECASE)
"""Value of a parameter with an encoding and percent-escapes, as RFC 8187 permits it."""


@dataclass(frozen=True, slots=True)
class PartBegin:
    """Start of a part: name of its field, and file name if it is a file."""

    name: str
    filename: str | None


@dataclass(frozen=True, slots=True)
class PartData:
    """Next bytes of the current part."""

    data: bytes


class _Parser:
    """Collects the events of the library's callbacks."""

    def __init__(self, boundary: bytes) -> None:
        self.found: list[PartBegin | PartData] = []
        self.complete = False
        self._name, self._value, self._size = b"", b"", 0
        self._headers: dict[bytes, bytes] = {}
        self._parser = MultipartParser(
            boundary,
            {
                "on_part_begin": self._begin,
                "on_header_field": self._field,
                "on_header_value": self._text,
                "on_header_end": self._end_header,
                "on_headers_finished": self._headers_finished,
                "on_part_data": self._data,
                "on_end": self._end,
            },
        )

    def feed(self, chunk: bytes) -> list[PartBegin | PartData]:
        self.found = []
        self._parser.write(chunk)
        return self.found

    def _begin(self) -> None:
        self._headers, self._size = {}, 0

    def _field(self, data: bytes, start: int, end: int) -> None:
        self._name += self._counted(data[start:end])

    def _text(self, data: bytes, start: int, end: int) -> None:
        self._value += self._counted(data[start:end])

    def _counted(self, data: bytes) -> bytes:
        self._size += len(data)
        if self._size > MAX_PART_HEADER_BYTES:
            raise ProblemError("invalid-request", f"the headers of a part take more than {MAX_PART_HEADER_BYTES} bytes")
        return data

    def _end_header(self) -> None:
        self._headers[self._name.lower()] = self._value
        self._name, self._value = b"", b""

    def _headers_finished(self) -> None:
        disposition = self._headers.get(b"content-disposition", b"")
        _, options = parse_options_header(disposition)
        if b"name" not in options:
            raise ProblemError(
                "invalid-request", "a part of the form has no field name; send the fields 'file' and 'options'"
            )
        filename = _extended_name(disposition)
        if filename is None and b"filename" in options:
            filename = options[b"filename"].decode("utf-8", "replace")
        self.found.append(PartBegin(options[b"name"].decode("utf-8", "replace"), filename))

    def _data(self, data: bytes, start: int, end: int) -> None:
        if end > start:
            self.found.append(PartData(bytes(data[start:end])))

    def _end(self) -> None:
        self.complete = True


def _extended_name(disposition: bytes) -> str | None:
    """Return the file name in ``filename*`` (RFC 8187), which the library ignores; None without a valid one."""
    for name, value in _PARAMETER.findall(disposition):
        found = _EXTENDED.fullmatch(value.strip(b' \t"'))  # some clients quote it
        if name.lower() == b"filename*" and found:
            try:
                return urllib.parse.unquote_to_bytes(found[2]).decode(found[1].decode("ascii"))
            except UnicodeDecodeError:
                return None
    return None


class _Preamble:
    """Removes the bytes before the first boundary, which the library does not."""

    def __init__(self, boundary: bytes) -> None:
        self._line = re.compile(rb"(?:^|\n)--" + re.escape(boundary) + rb"(?:[ \t]*(?=\r\n)|(?=--))")
        self._boundary, self._head = b"--" + boundary, b""
        self.over = False

    def feed(self, chunk: bytes) -> bytes:
        """Process the next bytes; return those that belong to parts."""
        if self.over:
            return chunk
        self._head += chunk
        found = self._line.search(self._head)
        if (found.start() if found else len(self._head)) > MAX_PREAMBLE_BYTES + len(self._boundary):
            raise ProblemError(
                "invalid-request", f"the form has more than {MAX_PREAMBLE_BYTES} bytes before its first boundary"
            )
        if not found:
            return b""
        self.over = True
        return self._boundary + self._head[found.end() :]


async def parts(content_type: str, chunks: AsyncIterable[bytes]) -> AsyncIterator[PartBegin | PartData]:
    """Yield the parts of a form in the order in which they arrive.

    Raises:
        ProblemError: the form is invalid or incomplete.
    """
    _, options = parse_options_header(content_type)
    boundary = options.get(b"boundary", b"")
    if not 1 <= len(boundary) <= 256:
        raise ProblemError(
            "invalid-request", "the Content-Type has no valid boundary; let your HTTP library generate the header"
        )
    try:
        parser, preamble = _Parser(boundary), _Preamble(boundary)
        async for chunk in chunks:
            for event in parser.feed(preamble.feed(chunk)):
                yield event
    except FormParserError as error:
        raise ProblemError("invalid-request", f"the form cannot be read: {error}") from error
    if not preamble.over:
        raise ProblemError(
            "invalid-request", "the form has no line with its boundary; let your HTTP library generate the body"
        )
    if not parser.complete:
        raise ProblemError("invalid-request", "the form ends before its last boundary; send it again")
