"""Uploads: the body of a request, or the parts of a form, on their way to the disk."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import re
import unicodedata
import urllib.parse
from collections.abc import AsyncIterable, AsyncIterator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Self

from anyio.to_thread import run_sync
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect, Request

import kissgs
from kissgs.formats import DOUBLE_ENDINGS, FORMATS, UPLOADS, alternatives

from ..core.problems import ProblemError, disk_full, invalid
from ..core.settings import ServiceSettings
from ..jobs.admission import Admission

MAX_PART_HEADER_BYTES = 8192

MAX_PREAMBLE_BYTES = 8192  # maximum bytes before the first boundary, where RFC 2046 allows text, which is ignored


_PARAMETER = re.compile(rb';[ \t]*([^\s;="]+)[ \t]*=[ \t]*("(?:[^"\\]|\\.)*"|[^;"]*)')
"""Name and value of a parameter of a header."""

_EXTENDED = re.compile(rb"(utf-?8|iso-8859-1)'[A-Za-z0-9-]*'((?:[!#$&+.^_`|~A-Za-z0-9-]|%[0-9A-F]{2})+)", re.IGNORECASE)
"""Value of a parameter with an encoding and percent-escapes, as RFC 8187 permits it."""


@dataclass(frozen=True, slots=True)
class PartBegin:
    """Start of a part: name of its field, and file name if it is a file."""

    name: str
    filename: str | None


class _Parser:
    """Collects the events of the library's callbacks."""

    def __init__(self, boundary: bytes) -> None:
        self.found: list[PartBegin | bytes] = []
        self.begun, self.complete = False, False
        self._line = re.compile(rb"(?:^|\n)--" + re.escape(boundary) + rb"(?:[ \t]*(?=\r\n)|(?=--))")
        self._boundary, self._head = b"--" + boundary, b""
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

    def feed(self, chunk: bytes) -> list[PartBegin | bytes]:
        """Process the next bytes; those before the first boundary are removed, which the library does not."""
        self.found = []
        if not self.begun:
            self._head += chunk
            first = self._line.search(self._head)
            if (first.start() if first else len(self._head)) > MAX_PREAMBLE_BYTES + len(self._boundary):
                raise invalid(f"the form has more than {MAX_PREAMBLE_BYTES} bytes before its first boundary")
            if not first:
                return []
            self.begun, chunk = True, self._boundary + self._head[first.end() :]
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
            raise invalid(f"the headers of a part take more than {MAX_PART_HEADER_BYTES} bytes")
        return data

    def _end_header(self) -> None:
        self._headers[self._name.lower()] = self._value
        self._name, self._value = b"", b""

    def _headers_finished(self) -> None:
        disposition = self._headers.get(b"content-disposition", b"")
        _, options = parse_options_header(disposition)
        if b"name" not in options:
            raise invalid("a part of the form has no field name; send the fields 'file' and 'options'")
        filename = _extended_name(disposition)
        if filename is None and b"filename" in options:
            filename = options[b"filename"].decode("utf-8", "replace")
        self.found.append(PartBegin(options[b"name"].decode("utf-8", "replace"), filename))

    def _data(self, data: bytes, start: int, end: int) -> None:
        if end > start:
            self.found.append(bytes(data[start:end]))

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


async def parts(content_type: str, chunks: AsyncIterable[bytes]) -> AsyncIterator[PartBegin | bytes]:
    """Yield the parts of a form as they arrive: the beginning of each, then its bytes."""
    _, options = parse_options_header(content_type)
    boundary = options.get(b"boundary", b"")
    if not 1 <= len(boundary) <= 256:
        raise invalid("the Content-Type has no valid boundary; let your HTTP library generate the header")
    try:
        parser = _Parser(boundary)
        async for chunk in chunks:
            for event in parser.feed(chunk):
                yield event
    except FormParserError as error:
        raise invalid(f"the form cannot be read: {error}") from error
    if not parser.begun:
        raise invalid("the form has no line with its boundary; let your HTTP library generate the body")
    if not parser.complete:
        raise invalid("the form ends before its last boundary; send it again")


BLOCK_BYTES = 1 << 20  # bytes per write. Each write is one call to a thread; memory holds one or two blocks per upload.
LAST_LINE = re.compile(rb"\nend_header[ \t\r]*\n")  # of a header; a comment may end with end_header, too
HEAD_BYTES = 512  # bytes from which a format is recognised

GAUSSIANS_PER_BYTE = 2
"""Largest number of Gaussians per byte of an upload. Real files have up to 0.12 (``fast``), and 0.23 at the lowest
quality; a position alone takes more than 4 bits. Images of equal pixels hold millions in 4 kB, which keep a worker for
hours: all of them cover the same pixels, and each takes 2 ms. No setting, because no real file comes near it."""

FREE_GAUSSIANS = 1 << 16  # number of Gaussians that an upload of any size may have

CLOSE = {"Connection": "close"}

STEP_BYTES = 16 << 20  # reserved per step as bytes arrive: a large Content-Length alone reserves nothing


class Spool:
    """Writes an upload of at most ``most`` bytes to ``path``, of which ``at_most`` come according to the client; None
    if that is unknown. As a context manager, it removes the file unless a job has adopted it."""

    what, advice = "upload", "prune the scene first, or compress it with the command line"

    def __init__(self, admission: Admission, path: Path, most: int, at_most: int | None = None) -> None:
        self._admission, self.path, self._most, self._at_most = admission, path, most, at_most
        self.size = 0  # bytes received so far
        self._pending = bytearray()
        self._reserved, self._written = 0, 0
        self._hash = hashlib.sha256()
        self._file: BinaryIO | None = None

    async def __aenter__(self) -> Self:
        if self._at_most is not None:
            self._refuse_size(self._at_most)
            await run_sync(self._admission.check_space, self._at_most)
        return self

    async def __aexit__(self, *error: object) -> None:
        await asyncio.shield(asyncio.ensure_future(run_sync(self._leave)))

    async def write(self, data: bytes) -> None:
        """Process the next bytes, unless the scene is invalid, exceeds a limit, or does not fit on the disk."""
        self._pending += data
        self.size += len(data)
        self._refuse_size(self.size)
        if self.size > self._reserved:
            coming = STEP_BYTES if self._at_most is None else min(STEP_BYTES, self._at_most - self._reserved)
            coming = max(coming, self.size - self._reserved)
            await run_sync(self._admission.reserve, coming)
            self._reserved += coming
        self._check(len(data))
        if len(self._pending) >= BLOCK_BYTES:
            await run_sync(self._flush)

    async def close(self) -> str:
        """Write the remaining bytes to disk, and return the SHA-256 of all."""
        await run_sync(self._close)
        return self._hash.hexdigest()

    def _close(self) -> None:
        self._flush()
        with self._writing() as file:
            file.flush()
            os.fsync(file.fileno())
            file.close()

    def _leave(self) -> None:
        if self._file is not None:
            with contextlib.suppress(OSError):  # the file is removed anyway
                self._file.close()
        self.path.unlink(missing_ok=True)
        self._admission.release(self._reserved, self._written)

    def _flush(self) -> None:
        with self._writing() as file:
            file.write(self._pending)
        self._hash.update(self._pending)
        self._written += len(self._pending)
        self._admission.wrote(len(self._pending))
        self._pending.clear()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[BinaryIO]:
        try:
            if self._file is None:
                self._file = self.path.open("xb")
            yield self._file
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise disk_full(f"the upload cannot be written: {reason}; try again later") from error

    def _refuse_size(self, size: int) -> None:
        if size > self._most:
            limit = f"{self._most:,} bytes, which is the limit"
            raise ProblemError("too-large", f"the {self.what} exceeds {limit}; {self.advice}")

    def _check(self, new: int) -> None:
        """Check what has arrived, whose last ``new`` bytes are new."""


class SceneUpload(Spool):
    """Writes a scene to disk. The header of a ``.ply`` is checked while it arrives; other formats when they are
    complete."""

    def __init__(self, settings: ServiceSettings, admission: Admission, path: Path, at_most: int | None = None) -> None:
        super().__init__(admission, path, settings.max_upload_bytes, at_most)
        self._settings = settings
        self.name = ""  # of the file according to the client; set it before the first write
        self._checked = False

    async def finish(self) -> tuple[str, kissgs.SceneInfo]:
        """Write the remaining bytes to disk and validate the scene; return its SHA-256, and what its headers state."""
        sha256 = await self.close()
        async with self._admission.parsing:
            info = await run_sync(self._read_info)
        refuse_count(info.count, self.size, self._settings.max_gaussians)
        return sha256, info

    def _read_info(self) -> kissgs.SceneInfo:
        """Read the headers of the complete upload; refuse formats that are not one binary file."""
        name = f"upload{Path(self.name).suffix}"
        try:
            kind = kissgs.recognise(self.path, name=name)
            if kind not in UPLOADS:
                wanted = alternatives(tuple(UPLOADS.values()))
                what = "a checkpoint of a trainer" if FORMATS[kind].is_pickle else "a zip file, but not a .sog"
                raise ProblemError("unsupported", f"the upload is {what}; send a {wanted}")
            with self.path.open("rb") as file:  # JSON is as large as the upload, and would be parsed in this process
                if kind == "gltf" and file.read(4) != b"glTF":
                    raise ProblemError("unsupported", "the upload is JSON; send glTF as .glb")
            return kissgs.read_scene_info(self.path, name=name)
        except kissgs.KissgsError as error:
            raise self._named(error) from error

    def _check(self, new: int) -> None:
        """Validate the header as soon as it has arrived, long before the last byte of an invalid file."""
        if self._checked:
            return
        line = max(self._pending.rfind(b"\n", 0, len(self._pending) - new), 0)  # start of what was the last line
        limit = self._settings.max_header_bytes
        if self.size <= limit and not LAST_LINE.search(self._pending, line):
            return
        head, whole = bytes(self._pending), self._most if self._at_most is None else self._at_most
        self._checked = True
        if kissgs.recognise(head[:HEAD_BYTES], name=f"upload{Path(self.name).suffix}", size=whole) != "ply":
            return
        try:
            info = kissgs.read_ply_info(head[:limit], size=max(whole, self.size))
        except kissgs.KissgsError as error:
            raise self._named(error) from error
        refuse_count(info.count, max(whole, self.size), self._settings.max_gaussians)

    def _named(self, error: kissgs.KissgsError) -> ProblemError:
        """Convert an error of the library to a problem that names the upload instead of a path of the server."""
        text = str(error).replace(str(self.path), self.path.name).replace(self.path.name, "the upload")
        text = text.replace("the data", "the upload").replace("the input", "the upload")
        if "the upload" not in text:
            text = f"the upload cannot be read: {text}"
        return ProblemError("invalid-scene" if error.code == "invalid-container" else error.code, text)


def refuse_count(count: int, size: int, most: int) -> None:
    """Refuse a scene of more than ``most`` Gaussians, or of more than different ones take in ``size`` bytes."""
    if count > most:
        raise ProblemError(
            "unsupported",
            f"the scene has {count:,} Gaussians, and the limit is {most:,}; "
            "prune it first, or compress it with the command line",
        )
    if count > FREE_GAUSSIANS + GAUSSIANS_PER_BYTE * size:
        raise ProblemError(
            "unsupported",
            f"the scene has {count:,} Gaussians in {size:,} bytes, so that most of them are copies of others; "
            "remove the copies, or compress it with the command line",
        )


async def timed(request: Request, settings: ServiceSettings, stopping: asyncio.Event) -> AsyncIterator[bytes]:
    """Yield the body of a request, unless it stalls, is too slow or incomplete, or the service is ``stopping``."""
    clock = asyncio.get_running_loop().time
    idle, begun, received = settings.upload_idle_seconds, clock(), 0
    chunks = aiter(request.stream())
    stopped = asyncio.ensure_future(stopping.wait())
    try:
        while (chunk := await _next(chunks, stopped, idle)) is not None:
            received += len(chunk)
            spent = clock() - begun
            if spent > idle:  # the rate is measured anew in every interval of this length
                if received < settings.upload_min_rate * spent:
                    least = f"{settings.upload_min_rate:,} bytes per second"
                    text = f"the upload is slower than {least}, which is the limit; use a faster connection"
                    raise ProblemError("upload-timeout", text, headers=CLOSE)
                begun, received = clock(), 0
            yield chunk
    finally:
        stopped.cancel()


async def _next(chunks: AsyncIterator[bytes], stopped: asyncio.Future[Any], idle: float) -> bytes | None:
    """Return the next bytes; None after the last."""
    coming = asyncio.ensure_future(anext(chunks, None))
    try:
        await asyncio.wait((coming, stopped), timeout=idle, return_when=asyncio.FIRST_COMPLETED)
        if stopped.done():
            text = "the service is stopping; send the upload again in a minute"
            raise ProblemError("stopping", text, retry_after=60, headers=CLOSE)
        if not coming.done():
            text = f"no data arrived for {idle:g} s, which is the limit; send the upload again"
            raise ProblemError("upload-timeout", text, headers=CLOSE)
        return coming.result()
    except ClientDisconnect as error:
        text = "the connection closed before the upload was complete; send it again"
        raise ProblemError("upload-aborted", text) from error
    finally:
        coming.cancel()


def scene_name(given: str | None) -> str:
    """Return a scene name that is safe in listings and downloads: no path, no control characters, never empty."""
    name = re.split(r"[/\\]", unicodedata.normalize("NFC", given or ""))[-1]
    name = "".join(c for c in name if unicodedata.category(c)[0] != "C" and c not in '"<>|:*?')
    endings = (*DOUBLE_ENDINGS, *UPLOADS.values())
    ending = next((ending for ending in endings if name.lower().endswith(ending)), "")
    name = name[: len(name) - len(ending)]
    name = name.strip(" .")
    return name[:100] or "scene"
