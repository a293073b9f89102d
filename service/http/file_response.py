"""Answers that are files on disk: ranges, conditions, checksums."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import FileResponse, Response
from starlette.types import Message, Receive, Scope, Send

from service.core.problems import ProblemError


class StoredFile(FileResponse):
    """A file that never changes: strong ETag, digests, ranges, ``If-None-Match``; HEAD answers what GET would.

    Args:
        path: of the file.
        sha256: of its bytes, as hexadecimal.
        media_type: of its bytes.
        download: the name under which a browser saves it; by default it shows it.
        headers: further ones.
    """

    def __init__(
        self,
        path: Path,
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
        try:
            stat = path.stat()
        except FileNotFoundError as error:  # it expired, or made room, a moment ago
            raise ProblemError("gone", "the file has just been removed; submit the scene again") from error
        super().__init__(path, media_type=media_type, headers=fixed, stat_result=stat)
        self._size = stat.st_size

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer 304 if the client has it; else let the file go out, or the range of it that was asked for."""
        asked = Headers(scope=scope)
        conditions = scope["method"] in ("GET", "HEAD")
        if conditions and _names(", ".join(asked.getlist("if-none-match")), self.headers["etag"]):
            kept = ("etag", "cache-control", "content-location")
            same = {name: value for name, value in self.headers.items() if name in kept}
            await Response(status_code=304, headers=same)(scope, receive, send)
            return

        async def corrected(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] != 200:
                del MutableHeaders(raw=message["headers"])["content-digest"]  # of these bytes, which are not the whole
            await send(message)

        wanted = asked.getlist("range") if conditions and self._is_same(asked) else []
        if len(wanted) == 1 and _is_range(wanted[0]):
            if _is_outside(wanted[0], self._size):
                text = f"the file has {self._size} bytes; ask for a range within it"
                raise ProblemError("range", text, headers={"Content-Range": f"bytes */{self._size}"})
            answered = {b"if-range"}
        else:
            answered = {b"if-range", b"range"}
        headers = [(name, value) for name, value in scope["headers"] if name not in answered]
        await super().__call__({**scope, "headers": headers}, receive, corrected)

    def _is_same(self, asked: Headers) -> bool:
        """Whether a range may be taken from this version of the file."""
        versions = asked.getlist("if-range")
        return not versions or versions == [self.headers["etag"]]


def described(summary: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    """The entry at the end of a path of names in a job's summary.

    Raises:
        ProblemError: there is none.
    """
    entry: Any = summary
    for name in names:
        if not isinstance(entry, dict) or name not in entry:
            raise ProblemError("not-found", f"there is no file {name[:80]!r}; sizes.files of the job names all")
        entry = entry[name]
    return dict(entry)


def _attachment(name: str) -> str:
    """RFC 6266: the name in plain letters for old clients, and as it is for all others."""
    plain = name.encode("ascii", "replace").decode().replace("?", "_").replace('"', "_").replace("\\", "_")
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"


def _names(header: str, etag: str) -> bool:
    tags = [tag.strip().removeprefix("W/") for tag in header.split(",")]
    return header.strip() == "*" or etag in tags


def _is_range(header: str) -> bool:
    """Whether this is one range of bytes. Others may be ignored, says RFC 9110, and are."""
    found = re.fullmatch(r"\s*bytes\s*=\s*([0-9]{0,18})\s*-\s*([0-9]{0,18})\s*", header, re.IGNORECASE)
    if not found or not (found[1] or found[2]):
        return False
    return not (found[1] and found[2] and int(found[1]) > int(found[2]))


def _is_outside(header: str, size: int) -> bool:
    """Whether nothing of a file of this size lies in the range."""
    first, _, last = header.partition("=")[2].strip().partition("-")
    return int(first) >= size if first.strip() else int(last) == 0 or size == 0
