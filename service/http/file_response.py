"""Responses that send stored files, with ranges, conditional requests and checksums."""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Iterable
from typing import Any
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse, Response
from starlette.types import Message, Receive, Scope, Send

from ..core.problems import ProblemError
from ..storage.job_storage import StoredObject


class StoredFile(FileResponse):
    """Immutable file with strong ETag, digests, ranges and ``If-None-Match``, for GET and HEAD.

    Args:
        file: the file.
        sha256: SHA-256 of the file, as hexadecimal digits.
        media_type: media type of the file.
        download: file name for saving in a browser; None lets the browser show the file.
        headers: additional response headers.
    """

    def __init__(
        self,
        file: StoredObject,
        *,
        sha256: str,
        media_type: str,
        download: str | None = None,
        headers: dict[str, str] | None = None,
    ) -> None:
        digest = f"sha-256=:{base64.b64encode(bytes.fromhex(sha256)).decode()}:"
        fixed = {"ETag": f'"{sha256}"', "Content-Digest": digest, "Repr-Digest": digest, **(headers or {})}
        if download is not None:
            fixed["Content-Disposition"] = _attachment(download)
        facts = os.stat_result((0, 0, 0, 0, 0, 0, file.size, *[file.modified] * 3))
        super().__init__(file.path or os.devnull, media_type=media_type, headers=fixed, stat_result=facts)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send 304 if the client has the current file, else the file or the requested range of it."""
        asked = Headers(scope=scope)
        conditions = scope["method"] in ("GET", "HEAD")
        if conditions and _names(", ".join(asked.getlist("if-none-match")), self.headers["etag"]):
            kept = ("etag", "cache-control", "content-location")
            same = {name: value for name, value in self.headers.items() if name in kept}
            await Response(status_code=304, headers=same)(scope, receive, send)
            return

        async def corrected(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] != 200:
                del MutableHeaders(raw=message["headers"])["content-digest"]  # it would be that of the whole file
            await send(message)

        wanted = asked.getlist("range") if conditions and self._is_same(asked) else []
        if len(wanted) == 1 and _is_range(wanted[0]):
            if _is_outside(wanted[0], self._file.size):
                text = f"the range is outside the file, which has {self._file.size} bytes; request a range within it"
                raise ProblemError("range", text, headers={"Content-Range": f"bytes */{self._file.size}"})
            answered = {b"if-range"}
        else:
            answered = {b"if-range", b"range"}
        if self._file.stream is not None:
            await self._send_stream(scope, corrected, wanted[0] if b"range" not in answered else None)
            return
        headers = [(name, value) for name, value in scope["headers"] if name not in answered]
        await super().__call__({**scope, "headers": headers}, receive, corrected)

    async def _send_stream(self, scope: Scope, send: Send, wanted: str | None) -> None:
        """Send a file that does not lie on this machine, or one valid range of it."""
        size, headers, status = self._file.size, MutableHeaders(raw=list(self.raw_headers)), 200
        first, end = 0, size
        if wanted is not None:
            first, end = _bounds(wanted, size)
            headers["content-range"], status = f"bytes {first}-{end - 1}/{size}", 206
            headers["content-length"] = str(end - first)
        start: Message = {"type": "http.response.start", "status": status, "headers": headers.raw}
        if scope["method"] != "HEAD" and self._file.stream is not None:
            try:
                async for block in self._file.stream(first, end):
                    if start:  # only now, because opening the stream may fail
                        await send(start)
                        start = {}
                    await send({"type": "http.response.body", "body": block, "more_body": True})
            except FileNotFoundError as error:
                raise removed() from error
        if start:
            await send(start)
        await send({"type": "http.response.body", "body": b"", "more_body": False})

    def _is_same(self, asked: Headers) -> bool:
        """Return whether ``If-Range`` allows a range of this version of the file."""
        versions = asked.getlist("if-range")
        return not versions or versions == [self.headers["etag"]]


def described(summary: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """Return the entry of a job's summary at a path of names.

    Raises:
        ProblemError: it does not exist.
    """
    entry: Any = summary
    for name in names:
        if not isinstance(entry, dict) or name not in entry:
            raise ProblemError(
                "not-found", f"the job has no file {name[:80]!r}; sizes.files of its status lists all files"
            )
        entry = entry[name]
    return dict(entry)


def removed() -> ProblemError:
    """Return the problem of a file that has expired or was reclaimed since the job was read."""
    return ProblemError("gone", "the file was removed during the request; submit the scene again")


def _attachment(name: str) -> str:
    """Format a Content-Disposition header (RFC 6266) with an ASCII fallback of the name."""
    plain = name.encode("ascii", "replace").decode().replace("?", "_").replace('"', "_").replace("\\", "_")
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"


def _names(header: str, etag: str) -> bool:
    tags = [tag.strip().removeprefix("W/") for tag in header.split(",")]
    return header.strip() == "*" or etag in tags


def _is_range(header: str) -> bool:
    """Return whether this is a single range of bytes; all others are ignored, as RFC 9110 permits."""
    found = re.fullmatch(r"\s*bytes\s*=\s*([0-9]{0,18})\s*-\s*([0-9]{0,18})\s*", header, re.IGNORECASE)
    if not found or not (found[1] or found[2]):
        return False
    return not (found[1] and found[2] and int(found[1]) > int(found[2]))


def _is_outside(header: str, size: int) -> bool:
    """Return whether the range contains no byte of a file of this size."""
    first, _, last = header.partition("=")[2].strip().partition("-")
    return int(first) >= size if first.strip() else int(last) == 0 or size == 0


def _bounds(header: str, size: int) -> tuple[int, int]:
    """Return the first byte of a valid range within a file, and the byte after its last one."""
    first, _, last = header.partition("=")[2].strip().partition("-")
    if not first.strip():
        return max(0, size - int(last)), size
    return int(first), min(int(last) + 1, size) if last.strip() else size
