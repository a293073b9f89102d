"""Files to and from a bucket by signed addresses, without credentials: the requests of a node.

Addresses are secrets until they expire, so no message has one. Connection errors, 429 and 5xx are tried again with
growing pauses, half a minute in all; a download goes on where it stopped.
"""

from __future__ import annotations

import errno
import logging
import re
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import httpx

import kissgs
from kissgs.runners import NODE_UNUSABLE

PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0, 14.0)
"""Seconds before each repetition of a request; of a download, since the last bytes that have come."""

CONNECT_SECONDS, IDLE_SECONDS = 10.0, 60.0
"""Maximum seconds for a connection, and without any bytes."""

MAX_PUT_BYTES = 5 << 30
"""Largest file that S3 stores by one request; there is no other kind of request here."""

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk without space."""

_AGAIN = (408, 429, 500, 502, 503, 504)


class StorageAccessError(kissgs.KissgsError):
    """The storage cannot be reached from this machine, or does not accept the signed addresses any more."""

    code = "storage"


class NodeDiskError(kissgs.KissgsError):
    """This machine has no space for the files of a job."""

    code = "disk-full"


class NodeError(kissgs.KissgsError):
    """This machine cannot work on a job, and another one may."""

    code = NODE_UNUSABLE


class _TryAgainError(Exception):
    """A request failed in a way that may pass."""


def client() -> httpx.Client:
    """Return a client for all requests of a job."""
    logging.getLogger("httpx").setLevel(logging.WARNING)  # at its level INFO, it logs addresses
    timeout = httpx.Timeout(IDLE_SECONDS, connect=CONNECT_SECONDS)
    return httpx.Client(timeout=timeout, headers={"Accept-Encoding": "identity"})


def fetch(http: httpx.Client, url: str, path: Path, size: int) -> None:
    """Copy a file of ``size`` bytes to this machine.

    Raises:
        StorageAccessError: the storage cannot be reached, refuses the address, or has a file of another size.
        NodeDiskError: the disk is full.
        NodeError: the file cannot be written.
    """
    try:
        with path.open("wb") as file:
            _repeat(lambda: _fetch_rest(http, url, file, size), file.tell)
    except OSError as error:
        raise disk_error(error) from error


def _fetch_rest(http: httpx.Client, url: str, file: BinaryIO, size: int) -> None:
    """Append the bytes that ``file`` does not have yet."""
    first = file.tell()
    if first == size > 0:
        return
    headers = {"Range": f"bytes={first}-"} if first else {}
    try:
        with http.stream("GET", url, headers=headers) as answer:
            _check(answer)
            if first and answer.status_code != httpx.codes.PARTIAL_CONTENT:  # all of it once more
                file.seek(0)
                file.truncate()
            for block in answer.iter_raw():  # as they come: blocks of a fixed size would be lost by an error
                file.write(block)
                if file.tell() > size:
                    raise StorageAccessError(f"a file in the storage has more than its {size} bytes")
    except httpx.HTTPError as error:
        raise _TryAgainError(_reason(error)) from None
    if file.tell() != size:
        raise _TryAgainError(f"it sent {file.tell()} of {size} bytes")


def store(http: httpx.Client, path: Path, url: str) -> None:
    """Store a file of this machine.

    Raises:
        kissgs.UnsupportedError: it is larger than :data:`MAX_PUT_BYTES`.
        StorageAccessError: the storage cannot be reached, or refuses the address.
    """
    if path.stat().st_size > MAX_PUT_BYTES:
        raise kissgs.UnsupportedError(
            f"{path.name} has more than {MAX_PUT_BYTES >> 30} GiB, the most that the storage takes in one request; "
            "submit a scene with fewer Gaussians"
        )
    _repeat(lambda: _store(http, path, url))


def _store(http: httpx.Client, path: Path, url: str) -> None:
    try:
        with path.open("rb") as file, http.stream("PUT", url, content=file) as answer:  # its size is announced
            _check(answer)
    except httpx.HTTPError as error:
        raise _TryAgainError(_reason(error)) from None


def _repeat(request: Callable[[], None], progress: Callable[[], int] = lambda: 0) -> None:
    """Make a request until it succeeds; ``progress`` grows whenever the pauses may begin anew."""
    pauses, reached = list(PAUSES), progress()
    while True:
        try:
            request()
            return
        except _TryAgainError as error:
            if progress() > reached:
                pauses, reached = list(PAUSES), progress()
            if not pauses:
                machine = socket.gethostname()
                raise StorageAccessError(f"the machine {machine} cannot use the storage: {error}") from None
            time.sleep(pauses.pop(0))


def _check(answer: httpx.Response) -> None:
    """Raise an error unless the answer is one of success."""
    if answer.is_success:
        return
    try:
        found = re.search(rb"<Code>(\w+)</Code>", next(answer.iter_raw(4096), b""))
    except httpx.HTTPError:
        found = None
    code = found[1].decode() if found else ""
    what = f"{answer.status_code} {code}".strip()
    if answer.status_code in _AGAIN or code in ("RequestTimeout", "SlowDown", "InternalError"):
        raise _TryAgainError(f"it answers {what}")
    if answer.status_code in (401, 403) or code in ("ExpiredToken", "InvalidToken", "TokenRefreshRequired"):
        raise StorageAccessError(f"the storage does not accept the signed addresses of the job any more: {what}")
    raise StorageAccessError(f"the storage refused a request: {what}")


def _reason(error: httpx.HTTPError) -> str:
    """Return the cause of a failed connection; messages of the library have no addresses, but may be empty."""
    return str(error).lower() or type(error).__name__


def disk_error(error: OSError) -> kissgs.KissgsError:
    """Return the error for a file of this machine that cannot be written."""
    reason, machine = (error.strerror or str(error)).lower(), socket.gethostname()
    if error.errno in FULL:
        return NodeDiskError(f"the disk of the machine {machine} is full: {reason}")
    return NodeError(f"the machine {machine} cannot write the job's files: {reason}")
