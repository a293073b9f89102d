"""The capture of a submission: an archive in the form, which is unpacked, or the hash of an earlier one."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from anyio.to_thread import run_sync

from kissgs.runners import MEMORY_LIMIT, TIME_LIMIT

from ..core.problems import PROBLEM_TYPES, ProblemError, disk_full, invalid
from ..jobs.archive import FACTS
from ..jobs.container import ServiceContainer
from ..jobs.process import UNPACK, JobProcess
from ..storage.job_files import tree_bytes
from .uploads import Spool

UNPACKED_RATIO, UNPACKED_BYTES = 4, 16 << 20
"""Largest size of an unpacked capture, as a multiple of its archive and in addition: photographs are compressed, and
camera files as text shrink to a third. This much disk space is reserved."""


@dataclass(frozen=True, slots=True)
class Capture:
    """A capture in a folder of incoming files: its ``reference``, the SHA-256 of its archive, its size in bytes, and
    whether it has ``photographs`` to train on and others to evaluate with."""

    reference: str
    folder: Path
    size: int
    photographs: bool


class CaptureUpload:
    """Receives the capture of one submission of an ``owner``. As a context manager, removes what no job has adopted."""

    def __init__(self, context: ServiceContainer, owner: str) -> None:
        self._context, self._owner = context, owner
        self._archive, self._folder = context.storage.new_upload(), context.storage.new_upload()
        self._spool = Spool(context.settings, context.admission, self._archive, capture=True)
        self._reserved = 0

    async def __aenter__(self) -> Self:
        await self._spool.__aenter__()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self._spool.__aexit__(*error)
        await asyncio.shield(asyncio.ensure_future(run_sync(self._leave)))

    @property
    def size(self) -> int:
        """Number of bytes of the archive so far."""
        return self._spool.size

    async def write(self, data: bytes) -> None:
        """Process the next bytes of the archive."""
        await self._spool.write(data)

    async def check(self, reference: str | None) -> None:
        """Refuse the reference of a capture that no job of the owner has kept."""
        if reference is not None and not await run_sync(self._context.store.with_capture, self._owner, reference):
            raise _gone()

    async def finish(self, reference: str | None) -> Capture | None:
        """Return the capture, that of the archive or the one of this ``reference``; None if there is neither."""
        if self.size:
            found = f"sha256:{await self._spool.close()}"
            if reference not in (None, found):
                raise invalid(f"the option capture is not that of the archive, {found}; leave it out, or the archive")
            return await self._unpack(found)
        if reference is None:
            return None
        try:
            return await run_sync(self._link, reference)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise disk_full(f"the capture cannot be stored: {reason}; try again later") from error

    async def _unpack(self, reference: str) -> Capture:
        settings, storage = self._context.settings, self._context.storage
        most = min(int(settings.max_capture_bytes), UNPACKED_RATIO * self.size + UNPACKED_BYTES)
        await run_sync(self._context.admission.reserve, most)
        self._reserved = most
        self._folder.mkdir()
        task: dict[str, Any] = {"function": UNPACK, "folder": str(storage.incoming), "files": []}
        task |= {"source": self._archive.name, "work": self._folder.name}
        task |= {"most_bytes": most, "most_files": settings.max_capture_files}

        async def ignore(stage: str, fraction: float, note: str) -> None:
            pass

        async with self._context.admission.unpacking:
            outcome = await JobProcess(self._context.worker.runners).run(task, ignore)
        if outcome.code in (TIME_LIMIT, MEMORY_LIMIT):
            takes = f"more than {settings.capture_seconds:g} s or {settings.job_memory:,} bytes of memory"
            text = f"the capture takes {takes} to unpack and check, which is the limit; send fewer photographs"
            raise ProblemError("invalid-views", text)
        if outcome.code == "output":
            raise disk_full(outcome.message)
        if outcome.kind == "cancelled":
            raise ProblemError("stopping", "the service is stopping; send the upload again in a minute", retry_after=60)
        if outcome.kind != "done":
            code = outcome.code if outcome.code in PROBLEM_TYPES else "internal"
            raise ProblemError(code, outcome.message or "the capture could not be unpacked; send it again")
        return Capture(reference, self._folder, outcome.result["bytes"], outcome.result["photographs"])

    def _link(self, reference: str) -> Capture:
        """Return the capture of an earlier job, whose files are linked."""
        for job_id in self._context.store.with_capture(self._owner, reference):
            with contextlib.suppress(FileNotFoundError):  # the job is being removed
                self._context.storage.link_capture(job_id, self._folder)
                described = (self._folder / FACTS).read_bytes()
                facts = json.loads(described)
                if tree_bytes(self._folder) == facts["bytes"] + len(described):  # else files are missing
                    return Capture(reference, self._folder, facts["bytes"], facts["photographs"])
            self._context.storage.discard(self._folder)
        raise _gone()

    def _leave(self) -> None:
        self._context.storage.discard(self._folder)  # moved to the job, or not needed
        self._context.admission.release(self._reserved, 0)


def _gone() -> ProblemError:
    text = "the service does not have this capture, or not any more; send its archive in the field 'capture'"
    return ProblemError("gone", text)
