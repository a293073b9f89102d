"""The capture of a submission: an archive in the form, which is unpacked, or the hash of an earlier job's."""

from __future__ import annotations

import asyncio
from typing import Any, Self

from anyio.to_thread import run_sync

from kissgs.runners import MEMORY_LIMIT, TIME_LIMIT

from ..core.problems import PROBLEM_TYPES, ProblemError, disk_full, invalid
from ..jobs.container import ServiceContainer
from ..jobs.process import UNPACK, JobProcess
from .uploads import Spool

UNPACKED_RATIO, UNPACKED_BYTES = 4, 16 << 20
"""Largest size of an unpacked capture, as a multiple of its archive and in addition: photographs are compressed, and
camera files as text shrink to a third. This much disk space is reserved."""


class CaptureUpload:
    """Receives the capture of a submission, if it has one. As a context manager, removes what no job has adopted.
    Finished, it has a ``reference``, the ``folder`` and ``bytes`` of its files, and whether there are ``photographs``
    to train on and others to evaluate with."""

    def __init__(self, context: ServiceContainer, owner: str) -> None:
        self._context, self._owner = context, owner
        self._archive, self.folder = context.storage.new_upload(), context.storage.new_upload()
        self._spool = Spool(context.settings, context.admission, self._archive, capture=True)
        self._reserved = 0
        self.write = self._spool.write
        self.reference: str | None = None
        self.photographs: bool | None = None
        self.bytes = 0

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        try:
            await self._spool.__aexit__(*error)
        finally:
            await asyncio.shield(asyncio.ensure_future(run_sync(self._leave)))

    def _leave(self) -> None:
        self._context.storage.discard(self.folder)  # moved to the job, or not needed
        self._context.admission.release(self._reserved, 0)

    @property
    def size(self) -> int:
        """Number of bytes of the archive so far."""
        return self._spool.size

    async def check(self, reference: str | None) -> None:
        """Refuse the reference of a capture that no job of the owner has kept."""
        if reference is not None and not await run_sync(self._context.store.with_capture, self._owner, reference):
            raise _gone()

    async def close(self, reference: str | None) -> str | None:
        """Return the reference of the archive, or of an earlier job's capture without one."""
        if self.size:
            found = f"sha256:{await self._spool.close()}"
            if reference not in (None, found):
                raise invalid(f"the option capture is not that of the archive, {found}; leave it out, or the archive")
            reference = found
        self.reference = reference
        return reference

    async def finish(self) -> None:
        """Unpack the archive, or find the capture of the reference, and check it; after :meth:`close`."""
        most = min(int(self._context.settings.max_capture_bytes), UNPACKED_RATIO * self.size + UNPACKED_BYTES)
        if self.size:
            await run_sync(self._context.admission.reserve, most)
            self._reserved = most
            self.folder.mkdir()
        elif self.reference is not None:
            await run_sync(self._link, self.reference)
        else:
            return
        facts = await self._unpack(most)
        if facts["bytes"] is None:
            raise _gone()
        self.bytes, self.photographs = facts["bytes"], facts["photographs"]

    def _link(self, reference: str) -> None:
        for job_id in self._context.store.with_capture(self._owner, reference):
            try:
                return self._context.storage.link_capture(job_id, self.folder)
            except OSError:  # the job is being removed, or this file system has no links
                self._context.storage.discard(self.folder)
        raise _gone()

    async def _unpack(self, most: int) -> dict[str, Any]:
        """Unpack the archive, if there is one, and check the capture, in a process; return its facts."""
        settings = self._context.settings
        task: dict[str, Any] = {"function": UNPACK, "folder": str(self._archive.parent), "files": []}
        task |= {"source": self._archive.name if self.size else "", "work": self.folder.name}
        task |= {"most_bytes": most, "most_files": settings.max_capture_files}
        async with self._context.admission.unpacking:
            outcome = await JobProcess(self._context.worker.runners).run(task)
        if outcome.kind == "done":
            return outcome.result
        if outcome.code in (TIME_LIMIT, MEMORY_LIMIT):
            takes = f"more than {settings.capture_seconds:g} s or {settings.job_memory:,} bytes of memory"
            text = f"the capture takes {takes} to unpack and check, which is the limit; send fewer photographs"
            raise ProblemError("invalid-views", text)
        if outcome.code == "output":
            raise disk_full(outcome.message)
        if outcome.kind == "cancelled":
            raise ProblemError("stopping", "the service is stopping; send the upload again in a minute", retry_after=60)
        code = outcome.code if outcome.code in PROBLEM_TYPES else "internal"
        raise ProblemError(code, outcome.message or "the capture could not be unpacked; send it again")


def _gone() -> ProblemError:
    text = "the service does not have this capture, or not any more; send its archive in the field 'capture'"
    return ProblemError("gone", text)
