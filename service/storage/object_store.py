"""``ObjectStore``: files by key in a bucket of Amazon S3 or of a server with its interface, by obstore.

A key is seen only when its file is complete. Files above :data:`PART_BYTES` are sent in parts. Credentials come from
the variables that other programs use, too (``AWS_ACCESS_KEY_ID`` and others), or from the machine's role; no message
has any.
"""

from __future__ import annotations

import os
import re
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar
from urllib.parse import urlsplit

from ..core.settings import SettingsError

if TYPE_CHECKING:
    from obstore.store import S3Store

PART_BYTES = 16 << 20
"""Bytes of a part; at most four are in memory for each file that is being sent."""

PARTS_AT_ONCE = 4

FILES_AT_ONCE = 8
"""Number of small files that are sent simultaneously."""

BLOCK_BYTES = 4 << 20
"""Bytes of a block that is passed on to a client."""

CONNECT_SECONDS = 5
REQUEST_SECONDS = 300
RETRY_SECONDS = 30
"""Seconds for which a failed request is repeated."""

HASTY_SECONDS = 3
"""Seconds for which it is repeated at the start and by checks of the health, whose messages should come soon."""

_T = TypeVar("_T")


class ObjectStoreError(OSError):
    """A request to the bucket failed; the message is one clause without credentials."""


@dataclass(frozen=True, slots=True)
class ObjectInfo:
    """Key, size in bytes, and time of the last change (seconds since 1970) of a file."""

    key: str
    size: int
    modified: float


class ObjectStore:
    """Files by key in a bucket, below a prefix. Methods block and are safe in any thread.

    Args:
        url: ``s3://BUCKET`` or ``s3://BUCKET/PREFIX``.

    Raises:
        SettingsError: obstore is not installed, or the address or the credentials are of no valid form.
    """

    def __init__(self, url: str) -> None:
        self.url = url.rstrip("/")
        self._bucket, _, self._prefix = self.url.removeprefix("s3://").partition("/")
        self._endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        address = urlsplit(self._endpoint)
        if self._endpoint and (address.scheme not in ("http", "https") or not address.hostname):
            raise SettingsError("AWS_ENDPOINT_URL: it is no address such as https://s3.example.org; correct it")
        try:
            import obstore
            import obstore.exceptions
        except ModuleNotFoundError as error:
            raise SettingsError(
                f"KISSGS_STORAGE: the package {error.name} is missing: pip install 'kissgs[s3]'"
            ) from error
        self._api, self._errors = obstore, (obstore.exceptions.BaseError, OSError, ValueError)
        self._store, self._hasty = self._connect(RETRY_SECONDS), self._connect(HASTY_SECONDS)

    def _connect(self, retry_seconds: float) -> S3Store:
        from obstore.store import S3Store

        options: dict[str, Any] = {"endpoint": self._endpoint} if self._endpoint else {}
        try:
            return S3Store(
                self._bucket,
                prefix=self._prefix or None,
                client_options={
                    "allow_http": self._endpoint.startswith("http://"),
                    "connect_timeout": timedelta(seconds=CONNECT_SECONDS),
                    "timeout": timedelta(seconds=REQUEST_SECONDS),
                },
                retry_config={"max_retries": 6, "retry_timeout": timedelta(seconds=retry_seconds)},
                **options,
            )
        except self._errors as error:
            raise SettingsError(f"KISSGS_STORAGE: {self._explain(error)}") from None

    def check_usable(self, key: str) -> None:
        """Write, list, read and remove a key, to find wrong settings at the start.

        Raises:
            SettingsError: that is not possible; the message says why.
        """
        api, store = self._api, self._hasty
        try:
            api.put(store, key, b"kissgs")
            found = bytes(api.get(store, key).bytes())
            listed = [entry["path"] for batch in api.list(store, key) for entry in batch]
            api.delete(store, [key])
        except self._errors as error:
            raise SettingsError(f"KISSGS_STORAGE: {self._explain(error)}") from None
        if found != b"kissgs" or len(listed) > 1:
            raise SettingsError(f"KISSGS_STORAGE: {self.url} does not give back what was written; use another bucket")

    # Requests -------------------------------------------------------------------------------------------------------

    def put(self, path: Path, key: str) -> None:
        """Store a file of this machine."""
        small = path.stat().st_size <= PART_BYTES
        self._try(
            lambda: self._api.put(
                self._store,
                key,
                path.read_bytes() if small else path,
                use_multipart=not small,
                chunk_size=PART_BYTES,
                max_concurrency=PARTS_AT_ONCE,
            )
        )

    def put_all(self, files: Iterable[tuple[Path, str]]) -> None:
        """Store files of this machine, several at a time."""
        with ThreadPoolExecutor(FILES_AT_ONCE) as pool:
            for _ in pool.map(lambda pair: self.put(*pair), files):
                pass

    def put_bytes(self, data: bytes, key: str) -> None:
        """Store a few bytes."""
        self._try(lambda: self._api.put(self._store, key, data))

    def get_bytes(self, key: str, *, hasty: bool = False) -> bytes:
        """Return a small file; with ``hasty``, fail soon if the bucket cannot be reached.

        Raises:
            FileNotFoundError: it does not exist.
        """
        store = self._hasty if hasty else self._store
        return self._try(lambda: bytes(self._api.get(store, key).bytes()))

    def fetch(self, key: str, path: Path) -> None:
        """Copy a file to this machine.

        Raises:
            FileNotFoundError: it does not exist.
        """

        size = self.info(key).size
        with path.open("wb") as file:
            for first in range(0, size, PART_BYTES):
                end = min(first + PART_BYTES, size)
                file.write(self._try(partial(self._get_range, key, first, end)))

    def _get_range(self, key: str, first: int, end: int) -> bytes:
        return bytes(self._api.get_range(self._store, key, start=first, end=end))

    async def stream(self, key: str, first: int, end: int) -> AsyncIterator[bytes]:
        """Yield the bytes of a file from ``first`` to before ``end``; at least one block, which may be empty.

        Each block is a request of its own, so that a slow client holds none open.

        Raises:
            FileNotFoundError: it does not exist.
        """
        try:
            if end <= first:
                await self._api.head_async(self._store, key)
                yield b""
                return
            for start in range(first, end, BLOCK_BYTES):
                stop = min(start + BLOCK_BYTES, end)
                yield bytes(await self._api.get_range_async(self._store, key, start=start, end=stop))
        except self._errors as error:
            raise self._converted(error) from None  # its text may have an access key

    def info(self, key: str) -> ObjectInfo:
        """Return size and time of a file.

        Raises:
            FileNotFoundError: it does not exist.
        """
        found = self._try(lambda: self._api.head(self._store, key))
        return ObjectInfo(key, found["size"], found["last_modified"].timestamp())

    def files(self, folder: str) -> list[ObjectInfo]:
        """Return all files whose key begins with ``folder`` and a slash."""
        found = self._try(lambda: [entry for batch in self._api.list(self._store, f"{folder}/") for entry in batch])
        return [ObjectInfo(entry["path"], entry["size"], entry["last_modified"].timestamp()) for entry in found]

    def folders(self, folder: str) -> list[str]:
        """Return the names that follow ``folder`` and a slash in keys, up to the next slash."""
        found = self._try(lambda: self._api.list_with_delimiter(self._store, folder))
        return [path.rsplit("/", 1)[-1] for path in found["common_prefixes"]]

    def delete(self, keys: Iterable[str]) -> None:
        """Remove files; those that do not exist are no error."""
        if chosen := list(keys):
            self._try(lambda: self._api.delete(self._store, chosen))

    def sign(self, method: str, keys: list[str], valid: timedelta) -> list[str]:
        """Return addresses with which anybody can make a request of this method for these files; each is a secret."""
        return self._try(lambda: self._api.sign(self._store, method, keys, valid))

    # Errors ---------------------------------------------------------------------------------------------------------

    def _try(self, request: Callable[[], _T]) -> _T:
        try:
            return request()
        except ObjectStoreError:
            raise
        except self._errors as error:
            raise self._converted(error) from None  # its text may have an access key

    def _converted(self, error: BaseException) -> OSError:
        if isinstance(error, OSError) and (error.errno is not None or isinstance(error, ObjectStoreError)):
            return error  # of this machine's disk
        if isinstance(error, FileNotFoundError) and "NoSuchBucket" not in str(error):
            return FileNotFoundError(2, "no such file in the storage")
        return ObjectStoreError(self._explain(error))

    def _explain(self, error: BaseException) -> str:
        """Return one clause with cause and remedy; the messages of the library have keys, addresses and XML."""
        text = str(error)
        where = self._endpoint or "Amazon S3"
        code = re.search(r"<Code>(\w+)</Code>", text)
        reason = code[1] if code else ""
        if reason == "NoSuchBucket":
            return f"there is no bucket {self._bucket!r} at {where}; create it, or correct the name"
        if reason in ("InvalidAccessKeyId", "SignatureDoesNotMatch", "InvalidToken", "ExpiredToken"):
            return f"{where} does not accept the credentials ({reason}); check AWS_ACCESS_KEY_ID and others"
        if reason == "RequestTimeTooSkewed":
            return f"{where} refuses requests because the clock of this machine is wrong ({reason}); set the clock"
        if reason in ("AccessDenied", "AllAccessDisabled") or "403 Forbidden" in text or "401 Unauthorized" in text:
            return (
                f"access to the bucket {self._bucket!r} at {where} is denied; check AWS_ACCESS_KEY_ID and others, and "
                "their rights to read, write, list and delete"
            )
        if reason in (
            "PermanentRedirect",
            "AuthorizationHeaderMalformed",
            "InvalidRegion",
            "IllegalLocationConstraint",
        ):
            return f"the bucket {self._bucket!r} is in another region ({reason}); set AWS_REGION"
        if reason in ("InvalidBucketName",):
            return f"{self._bucket!r} is no valid name of a bucket; correct it"
        if "169.254.169.254" in text or re.search("credential|access_?key", text, re.IGNORECASE):
            return (
                "there are no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or give the machine a role"
            )
        if "error sending request" in text or "timed out" in text.lower() or "connect" in text.lower():
            return f"{where} cannot be reached; check AWS_ENDPOINT_URL and the network"
        status = re.search(r"status code: (\d{3}[^:<\n]*)", text)
        detail = reason or (status[1].strip() if status else type(error).__name__)
        return f"{where} refused a request for the bucket {self._bucket!r}: {detail}; check KISSGS_STORAGE"
