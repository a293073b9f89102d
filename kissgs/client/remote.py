"""A kissgs service elsewhere, used as if it were here: upload, follow, download."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import time
import uuid
from collections.abc import Callable, Iterator
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar
from urllib.parse import urlsplit

from kissgs.core.errors import Cancelled, InvalidSceneError, KissgsError, RemoteError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing
from kissgs.settings import Settings

if TYPE_CHECKING:
    import httpx

BLOCK_BYTES = 1 << 18
PATIENCE_SECONDS = 300.0
"""How long a crowded or restarting service is asked again."""

FIRST_SECONDS = 8.0
"""How long one is that has never answered: its address may be wrong."""

_ERRORS: dict[str, type[KissgsError]] = {kind.code: kind for kind in (InvalidSceneError, UnsupportedError)}
"""Problems that are the scene's or the settings': raised as the library itself would."""

T = TypeVar("T")


class Remote:
    """A kissgs service.

    Args:
        server: its address, such as ``http://localhost:8000``.
        key: where it asks for one.

    Raises:
        UnsupportedError: httpx is not installed, or this is no address.
    """

    def __init__(self, server: str, *, key: str | None = None) -> None:
        try:
            import httpx
        except ModuleNotFoundError as error:
            raise UnsupportedError("talking to a service needs httpx; install kissgs[remote]") from error
        if not _is_address(server):
            raise UnsupportedError(
                f"{server!r} is no address of a service; write it as http://localhost:8000, without a path"
            )
        if key and not re.fullmatch(r"[!-~]+", key):
            raise UnsupportedError("this is no key: keys have no spaces and no letters beyond ASCII")
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        timeout = httpx.Timeout(60.0, connect=10.0)
        self._http = httpx.Client(base_url=server.rstrip("/"), headers=headers, timeout=timeout)
        self._has_answered = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._http.close()

    def compress(
        self,
        source: str | PathLike[str],
        destination: str | PathLike[str],
        *,
        settings: Settings | None = None,
        evaluate: bool = False,
        overwrite: bool = False,
        progress: Progress = silent,
    ) -> dict[str, Any]:
        """Have a ``.ply`` compressed there, and write the container here.

        Args:
            source: the ``.ply``.
            destination: the ``.zip`` to write, whole or not at all.
            settings: by default those of the preset ``balanced``.
            evaluate: also have the pictures compared.
            overwrite: replace ``destination`` if it exists.
            progress: hears of ``upload``, ``queue``, the service's own stages, and ``download``. Whatever it raises
                cancels the job.

        Returns:
            What the service knows of the job: sizes, timings and so on, see its API.

        Raises:
            InvalidSceneError: the ``.ply`` cannot be read, or the service finds it is no scene.
            UnsupportedError: a limit or a setting that is not possible.
            RemoteError: the service cannot be reached, or refuses or fails.
            OutputError: ``destination`` cannot be written.
        """
        target = Path(destination)
        refuse_existing(target, overwrite=overwrite)
        status = self.submit(source, settings=settings, evaluate=evaluate, progress=progress)
        try:
            status = self.follow(status["id"], progress)
            self.download(status, target, overwrite=overwrite, progress=progress)
        except KissgsError as error:
            if isinstance(error, Cancelled):
                self._forget(status["id"])
            raise _about(error, source) from error
        except BaseException:
            self._forget(status["id"])
            raise
        return status

    def _forget(self, job: str) -> None:
        with contextlib.suppress(KissgsError):  # what brought us here matters more
            self.cancel(job)

    def submit(
        self,
        source: str | PathLike[str],
        *,
        settings: Settings | None = None,
        evaluate: bool = False,
        progress: Progress = silent,
    ) -> dict[str, Any]:
        """Upload a ``.ply``. A broken connection or a crowded service is tried again, without making a second job.

        Returns:
            The status of the job.

        Raises:
            KissgsError: see :meth:`compress`.
        """
        path = Path(source)
        options = {**(settings or Settings()).model_dump(mode="json", exclude_unset=True), "evaluate": evaluate}
        size = _size(path)
        headers = {
            "Content-Type": "application/octet-stream",
            "Content-Length": str(size),
            "Idempotency-Key": uuid.uuid4().hex,
        }

        def send() -> dict[str, Any]:
            body = _blocks(path, size, progress)
            params = {"options": json.dumps(options), "name": path.name}
            answer = self._http.post("/v1/jobs", params=params, headers=headers, content=body)
            return _checked(answer).json()

        try:
            return self._patiently(send, progress)
        except KissgsError as error:
            raise _about(error, path) from error

    def follow(self, job: str, progress: Progress = silent) -> dict[str, Any]:
        """Wait until a job has ended.

        Returns:
            Its status.

        Raises:
            KissgsError: it failed, or was cancelled.
        """
        last = ""

        def listen() -> None:
            nonlocal last
            headers = {"Last-Event-ID": last} if last else {}
            with self._http.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as answer:
                if answer.is_error:
                    answer.read()
                for number, event, data in _events(_checked(answer)):
                    last = number
                    if event == "progress":
                        # Receivers that know nothing of notes can follow all else.
                        progress(data["stage"], data["fraction"], *([data["note"]] if "note" in data else []))
                    elif data["state"] == "queued":
                        progress("queue", 0.0)

        while True:
            self._patiently(listen, progress)
            status = self._patiently(lambda: self.status(job), progress)
            if status["state"] not in ("queued", "running"):
                break
            time.sleep(0.2)  # the stream broke off: the service is stopping
        if status["state"] == "succeeded":
            return status
        problem = status.get("problem", {"code": "cancelled", "detail": f"the job was {status['state']} on the server"})
        raise _error(problem)

    def download(
        self, status: dict[str, Any], destination: Path, *, overwrite: bool = False, progress: Progress = silent
    ) -> None:
        """Write the container of a job that has succeeded, its checksum verified.

        Raises:
            KissgsError: see :meth:`compress`.
        """

        def fetch() -> None:
            with self._http.stream("GET", status["links"]["result"]) as answer:
                if answer.is_error:
                    answer.read()
                _checked(answer)
                size, digest, done = int(answer.headers["Content-Length"]), hashlib.sha256(), 0
                with atomic_file(destination, overwrite=overwrite) as file:
                    for block in answer.iter_bytes(BLOCK_BYTES):
                        file.write(block)
                        digest.update(block)
                        done += len(block)
                        progress("download", done / size)
                    expected = f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
                    if answer.headers.get("Repr-Digest") != expected:
                        raise RemoteError("the container was damaged on its way; try again")

        self._patiently(fetch, progress)

    def status(self, job: str, *, wait: float = 0.0) -> dict[str, Any]:
        """What is known of a job; waits up to ``wait`` seconds (30 at most) for its end.

        Raises:
            RemoteError: the service cannot be reached, or knows no such job.
        """
        return self._once(lambda: _checked(self._http.get(f"/v1/jobs/{job}", params={"wait": wait})).json())

    def cancel(self, job: str) -> dict[str, Any]:
        """Stop a job's work.

        Raises:
            RemoteError: the service cannot be reached, or knows no such job.
        """
        return self._once(lambda: _checked(self._http.post(f"/v1/jobs/{job}/cancel")).json())

    def jobs(self, limit: int = 20) -> list[dict[str, Any]]:
        """The latest jobs, newest first: the status of each.

        Raises:
            RemoteError: the service cannot be reached.
        """
        return self._once(lambda: _checked(self._http.get("/v1/jobs", params={"limit": limit})).json()["jobs"])

    def _once(self, ask: Callable[[], T]) -> T:
        import httpx

        try:
            answer = ask()
        except httpx.HTTPError as error:
            reason = str(error).lower() or type(error).__name__
            failed = RemoteError(f"cannot reach {self._http.base_url}: {reason}; is kissgs-serve running there?")
            failed.unreachable = True
            raise failed from error
        self._has_answered = True
        return answer

    def _patiently(self, ask: Callable[[], T], progress: Progress) -> T:
        """Ask again while the service is crowded or away, for a few minutes."""
        begun, pause = time.monotonic(), 0.5
        while True:
            try:
                return self._once(ask)
            except RemoteError as error:
                pause = min(30.0, 2 * pause)
                delay = pause if error.unreachable else error.retry_after
                patience = PATIENCE_SECONDS if self._has_answered or not error.unreachable else FIRST_SECONDS
                if delay is None or time.monotonic() + delay > begun + patience:
                    raise
                _sleep(delay, progress)


def _is_address(server: str) -> bool:
    try:
        parts = urlsplit(server)
        return (
            parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0 and parts.path in ("", "/")
        )
    except ValueError:
        return False


def _sleep(seconds: float, progress: Progress) -> None:
    """In steps, so that who follows can stop it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        progress("wait for server", 0.0)
        time.sleep(min(0.5, seconds))


def _size(path: Path) -> int:
    try:
        if not path.is_file():
            reason = "it is a folder or a device" if path.exists() else "there is no such file"
            raise InvalidSceneError(f"cannot read {path}: {reason}; name a .ply file")
        return path.stat().st_size
    except OSError as error:
        raise InvalidSceneError(f"cannot read {path}: {reason_of(error)}") from error


def _blocks(path: Path, size: int, progress: Progress) -> Iterator[bytes]:
    done = 0
    progress("upload", 0.0)
    try:
        with path.open("rb") as file:
            while block := file.read(BLOCK_BYTES):
                yield block
                done += len(block)
                progress("upload", min(1.0, done / max(size, 1)))
    except OSError as error:
        raise InvalidSceneError(f"cannot read {path}: {reason_of(error)}") from error


def _events(answer: httpx.Response) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Id, kind and data of each server-sent event; the service writes each on lines of its own."""
    fields: dict[str, str] = {}
    for line in answer.iter_lines():
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
        else:
            if "data" in fields:
                yield fields.get("id", ""), fields.get("event", "message"), json.loads(fields["data"])
            fields = {}


def _about(error: KissgsError, source: str | PathLike[str]) -> KissgsError:
    """The same error, about the file rather than the upload that it has become."""
    text = str(error)
    named = type(error)(text.replace("the upload", str(source)))
    return named if text != str(named) else error


def _checked(answer: httpx.Response) -> httpx.Response:
    if not answer.is_error:
        return answer
    try:
        problem = answer.json()
        hint = "; set KISSGS_KEY or give --key" if problem["code"] == "unauthorized" else ""
        error = _error({"code": problem["code"], "detail": problem["detail"] + hint})
    except (ValueError, KeyError, TypeError):
        error = RemoteError(f"{answer.url.host} answered {answer.status_code}; is it a kissgs service?")
    after = answer.headers.get("Retry-After", "")
    if isinstance(error, RemoteError) and answer.status_code in (429, 503) and after.isdigit():
        error.retry_after = float(after)
    raise error


def _error(problem: dict[str, str]) -> KissgsError:
    kind = _ERRORS.get(problem["code"], RemoteError)
    return kind(problem["detail"])
