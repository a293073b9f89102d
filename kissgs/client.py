"""``Remote``: compression by a kissgs service over HTTP."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import re
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar
from urllib.parse import urlsplit

from kissgs.core.context import Progress, silent, with_seconds_left
from kissgs.core.errors import (
    Cancelled,
    InvalidSceneError,
    InvalidViewsError,
    KissgsError,
    RemoteError,
    UnsupportedError,
)
from kissgs.formats import ContainerName, named_container
from kissgs.io.files import atomic_file, open_scene_file, refuse_existing
from kissgs.settings import GROUPS, Settings

if TYPE_CHECKING:
    import httpx

BLOCK_BYTES = 1 << 18  # size of the blocks in which files are uploaded and downloaded
RETRY_SECONDS = 300.0  # time for which requests to an overloaded or restarting service are repeated
FIRST_RETRY_SECONDS = 8.0  # the same for a service that has never answered: its address may be wrong
ANSWER_SECONDS = 180.0  # for the answer to an upload: the service unpacks and checks a capture first
WAIT = "wait for server"  # stage in which a request is repeated after a while

T = TypeVar("T")


class Remote:
    """Client of a kissgs service.

    Args:
        server: address of the service, such as ``http://localhost:8000``.
        key: access key; None if the service needs none.

    Raises:
        UnsupportedError: httpx is not installed; the address or the key is malformed.
    """

    def __init__(self, server: str, *, key: str | None = None) -> None:
        try:
            import httpx
        except ModuleNotFoundError as error:
            raise UnsupportedError("a kissgs service needs httpx, which is missing: pip install httpx") from error
        try:
            parts = urlsplit(server)
            named = bool(parts.hostname) and parts.port != 0
        except ValueError:
            named = False
        if not named or parts.scheme not in ("http", "https") or parts.path not in ("", "/"):
            raise UnsupportedError(
                f"{server!r} is not the address of a service; write it as http://localhost:8000, without a path"
            )
        if key and not re.fullmatch(r"[!-~]+", key):
            raise UnsupportedError(
                "the key is malformed: a key has only printable ASCII characters without spaces; check it"
            )
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
        container: ContainerName | None = None,
        evaluate: bool = False,
        origin: Literal["auto"] | None = None,
        capture: str | PathLike[str] | None = None,
        force_views: bool = False,
        overwrite: bool = False,
        progress: Progress = silent,
    ) -> dict[str, Any]:
        """Compress a scene on the service, and write the container to a local file.

        Args:
            source: the scene: ``.ply``, ``.sog``, ``.spz``, ``.splat``, ``.ksplat`` or ``.glb``.
            destination: the ``.zip`` or ``.sog`` file to write, atomically.
            settings: None for the preset ``balanced``.
            container: ``"sogxt"`` or ``"sog"``; by default SOG if ``destination`` ends in ``.sog``, else SOG-XT.
            evaluate: whether the service also compares rendered images.
            origin: see :class:`kissgs.ReadOptions`.
            capture: zip or tar of photographs of the scene and their cameras, as :func:`kissgs.load_views` reads them;
                it is sent unless the service has kept it for an earlier job.
            force_views: accept a ``capture`` whose photographs do not show the scene.
            overwrite: whether to replace ``destination`` if it exists.
            progress: receives "upload", "queue", the stages of the service, "download", and "wait for server" with the
                reason as a note. An exception that it raises cancels the job.

        Returns:
            The status of the job: sizes, times and so on, see the API of the service.

        Raises:
            InvalidSceneError: the file cannot be read, or is not a scene.
            InvalidViewsError: the same of the capture, or it does not show the scene.
            UnsupportedError: a limit is exceeded, a setting is invalid, or the ending is that of another container.
            RemoteError: the service cannot be reached, refuses the job or fails.
            OutputError: ``destination`` cannot be written.
        """
        target = Path(destination)
        kind = named_container(container, destination)
        refuse_existing(target, overwrite=overwrite)
        status = self.submit(
            source,
            settings=settings,
            container=kind,
            evaluate=evaluate,
            origin=origin,
            capture=capture,
            force_views=force_views,
            progress=Share(progress, 0.0, 0.1),
        )
        try:
            status = self.follow(status["id"], Share(progress, 0.1, 0.95))
            self.download(status, target, overwrite=overwrite, progress=Share(progress, 0.95, 1.0))
        except BaseException as error:
            if not isinstance(error, KissgsError) or isinstance(error, Cancelled):
                with contextlib.suppress(KissgsError):  # the original error matters more
                    self.cancel(status["id"])
            if isinstance(error, KissgsError):
                raise _with_file_name(error, source) from error
            raise
        return status

    def submit(
        self,
        source: str | PathLike[str],
        *,
        settings: Settings | None = None,
        container: ContainerName = "sogxt",
        evaluate: bool = False,
        origin: Literal["auto"] | None = None,
        capture: str | PathLike[str] | None = None,
        force_views: bool = False,
        progress: Progress = silent,
    ) -> dict[str, Any]:
        """Upload a scene, and return the status of its job; retry if the connection breaks or the service is
        overloaded, without a second job. Arguments and errors are those of :meth:`compress`."""
        path, key, progress = Path(source), uuid.uuid4().hex, Share(progress)
        options = {**_given(settings or Settings()), "format": container, "evaluate": evaluate, "origin": origin}
        options |= {"capture": None, "force_views": force_views}
        if capture is not None:
            with open_scene_file(Path(capture), "; name an archive", InvalidViewsError) as opened:
                options["capture"] = f"sha256:{hashlib.file_digest(opened.file, 'sha256').hexdigest()}"
        params = {"options": json.dumps(options), "name": path.name}

        def send(kind: str, parts: Sequence[bytes | Path]) -> dict[str, Any]:
            size = 0
            for part in parts:
                with open_scene_file(part) as opened:
                    size += opened.size
            headers = {"Content-Type": kind, "Content-Length": str(size), "Idempotency-Key": key}
            body = _blocks(parts, size, progress)
            timeout = (10.0, ANSWER_SECONDS, 60.0, 60.0)
            answer = self._http.post("/v1/jobs", params=params, headers=headers, content=body, timeout=timeout)
            return _checked(answer).json()

        try:
            try:
                return self._with_retries(lambda: send("application/octet-stream", [path]), progress)
            except RemoteError as error:
                if capture is None or error.problem != "gone":
                    raise
            parts = _form(key, capture=Path(capture), file=path)
            return self._with_retries(lambda: send(f"multipart/form-data; boundary={key}", parts), progress)
        except KissgsError as error:
            raise _with_file_name(error, path) from error

    def follow(self, job: str, progress: Progress = silent) -> dict[str, Any]:
        """Wait until a job has succeeded, pass its progress on, and return its status.

        Raises:
            KissgsError: the job failed or was cancelled.
        """
        last, receive = "", Share(progress)

        def listen() -> None:
            nonlocal last
            headers = {"Last-Event-ID": last} if last else {}
            with self._http.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as response:
                for number, event, data in _events(_checked(response)):
                    last = number
                    if event == "progress":
                        receive(data["stage"], data["fraction"], data.get("note", ""), data.get("seconds_left"))
                    elif data["state"] == "queued":
                        receive("queue", 0.0)

        while True:
            self._with_retries(listen, receive)
            status = self._with_retries(lambda: self.status(job), receive)
            if status["state"] not in ("queued", "running"):
                break
            time.sleep(0.2)  # the stream ended early: the service is stopping
        if status["state"] == "succeeded":
            return status
        problem = status.get("problem", {"code": "cancelled", "detail": f"the job was {status['state']} on the server"})
        raise _error(problem["code"], problem["detail"])

    def download(
        self, status: dict[str, Any], destination: Path, *, overwrite: bool = False, progress: Progress = silent
    ) -> None:
        """Write the container of a job that has succeeded, and verify its checksum; for errors see :meth:`compress`."""
        progress = Share(progress)

        def fetch() -> None:
            with self._http.stream("GET", status["links"]["result"]) as response:
                _checked(response)
                size, digest, done = int(response.headers["Content-Length"]), hashlib.sha256(), 0
                with atomic_file(destination, overwrite=overwrite) as file:
                    for block in response.iter_bytes(BLOCK_BYTES):
                        progress("download", done / size)
                        file.write(block)
                        digest.update(block)
                        done += len(block)
                    expected = f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
                    if response.headers.get("Repr-Digest") != expected:
                        raise RemoteError("the container was damaged during the download; try again")

        self._with_retries(fetch, progress)
        with contextlib.suppress(Cancelled):  # the file is written
            progress("download", 1.0)

    def status(self, job: str, *, wait: float = 0.0) -> dict[str, Any]:
        """Return the status of a job, after waiting up to ``wait`` seconds (at most 30) for its end.

        Raises:
            RemoteError: the service cannot be reached, or there is no such job.
        """
        return self._json("GET", f"/v1/jobs/{job}", wait=wait)

    def cancel(self, job: str) -> dict[str, Any]:
        """Cancel a job, and return its status.

        Raises:
            RemoteError: the service cannot be reached, or there is no such job.
        """
        return self._json("POST", f"/v1/jobs/{job}/cancel")

    def jobs(self, limit: int = 20) -> list[dict[str, Any]]:
        """Return the status of the ``limit`` latest jobs, newest first.

        Raises:
            RemoteError: the service cannot be reached.
        """
        return self._json("GET", "/v1/jobs", limit=limit)["jobs"]

    def _json(self, method: str, path: str, **params: float) -> Any:  # noqa: ANN401
        return self._once(lambda: _checked(self._http.request(method, path, params=params)).json())

    def _once(self, request: Callable[[], T]) -> T:
        import httpx

        try:
            result = request()
        except httpx.HTTPError as error:
            reason = str(error).lower() or type(error).__name__
            remote_error = RemoteError(f"cannot reach {self._http.base_url}: {reason}; is kissgs-serve running there?")
            remote_error.unreachable = True
            raise remote_error from error
        self._has_answered = True
        return result

    def _with_retries(self, request: Callable[[], T], progress: Progress) -> T:
        """Repeat a request while the service is overloaded or unreachable, for :data:`RETRY_SECONDS`."""
        start, pause = time.monotonic(), 0.5
        while True:
            try:
                return self._once(request)
            except RemoteError as error:
                pause = min(30.0, 2 * pause)
                delay = pause if error.unreachable else error.retry_after
                limit = RETRY_SECONDS if self._has_answered or not error.unreachable else FIRST_RETRY_SECONDS
                if delay is None or time.monotonic() + delay > start + limit:
                    raise
                time_limit = f"{limit:.0f} seconds" if limit < 60 else f"{limit / 60:.0f} minutes"
                reason = str(error).replace(str(self._http.base_url), "it")  # the command prints the address before it
                end = time.monotonic() + delay
                while time.monotonic() < end:  # in short steps: progress may raise
                    progress(WAIT, 0.0, f"not ready ({reason}); trying again for {time_limit}")
                    time.sleep(min(0.5, delay))


class Share:
    """Receiver of a part of a job, from one fraction of the whole to another; a part that begins again waits."""

    def __init__(self, progress: Progress, start: float = 0.0, end: float = 1.0) -> None:
        self._receive, self._start, self._end, self._latest = with_seconds_left(progress), start, end, start

    def __call__(self, stage: str, fraction: float, note: str = "", seconds_left: float | None = None) -> None:
        """See :class:`kissgs.Progress`."""
        self._latest = max(self._latest, self._start + fraction * (self._end - self._start))
        self._receive(stage, self._latest, note, seconds_left)


def _given(settings: Settings) -> dict[str, Any]:
    """Return the settings as JSON without what belongs to the preset, which the server's version decides."""
    values = settings.model_dump(mode="json", exclude_unset=True)
    if not settings.for_research:
        for name, group in GROUPS.items():
            values[name] = {key: value for key, value in values.get(name, {}).items() if key in group.public()}
    return values


def _form(boundary: str, **files: Path) -> list[bytes | Path]:
    """Return the parts of a form with these files, in order."""
    parts: list[bytes | Path] = []
    for name, path in files.items():
        head = f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'
        parts += [head.encode(), path, b"\r\n"]
    return [*parts, f"--{boundary}--\r\n".encode()]


def _blocks(parts: Sequence[bytes | Path], size: int, progress: Progress) -> Iterator[bytes]:
    done = 0
    progress("upload", 0.0)
    for part in parts:
        with open_scene_file(part) as opened:
            while block := opened.file.read(BLOCK_BYTES):
                yield block
                done += len(block)
                progress("upload", min(1.0, done / max(size, 1)))


def _events(response: httpx.Response) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield id, event and data of each server-sent event; each field is on one line."""
    fields: dict[str, str] = {}
    for line in response.iter_lines():
        if line:
            name, _, value = line.partition(": ")
            fields[name] = value
        else:
            if "data" in fields:
                yield fields.get("id", ""), fields.get("event", "message"), json.loads(fields["data"])
            fields = {}


def _with_file_name(error: KissgsError, source: str | PathLike[str]) -> KissgsError:
    """Return the error with "the upload" replaced by the file name in its message."""
    text = str(error)
    renamed = type(error)(text.replace("the upload", str(source)))
    return renamed if text != str(renamed) else error


def _checked(response: httpx.Response) -> httpx.Response:
    if not response.is_error:
        return response
    response.read()
    try:
        problem = response.json()
        hint = "; set KISSGS_KEY (in Python key)" if problem["code"] == "unauthorized" else ""
        error = _error(problem["code"], problem["detail"] + hint)
    except (ValueError, KeyError, TypeError):
        error = RemoteError(
            f"{response.url.host} answered with status {response.status_code}; check that it is a kissgs service"
        )
    after = response.headers.get("Retry-After", "")
    if isinstance(error, RemoteError) and response.status_code in (429, 503) and after.isdigit():
        error.retry_after = float(after)
    raise error


def _error(code: str, detail: str) -> KissgsError:
    """Return the error of a problem of the scene or the settings that the library itself would raise, or another."""
    for kind in (InvalidSceneError, InvalidViewsError, UnsupportedError):
        if kind.code == code:
            return kind(detail)
    error = RemoteError(detail)
    error.problem = code
    return error
