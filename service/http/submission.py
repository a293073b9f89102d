"""Conversion of a request with a scene, and perhaps a capture, to a queued job."""

from __future__ import annotations

import hashlib
import ipaddress
import json
import logging
import uuid
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anyio.to_thread import run_sync
from pydantic import ValidationError
from starlette.requests import Request

import kissgs
from kissgs.formats import CONTAINERS, UPLOADS, alternatives
from kissgs.runners import MEMORY_LIMIT, TIME_LIMIT

from ..core.files import checkpoint_bytes
from ..core.models import Job
from ..core.presets import can_train
from ..core.problems import ProblemError, disk_full, field_errors, invalid, unusable_database
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings
from ..jobs.container import ServiceContainer
from ..jobs.process import UNPACK, JobProcess
from ..jobs.worker import QUEUE
from ..storage.job_records import LimitExceeded
from .uploads import PartBegin, SceneUpload, Spool, parts, scene_name, timed

RAW_TYPES = ("", "application/octet-stream", "application/ply", "application/x-ply", "model/ply")
FORM_TYPE, FIELDS = "multipart/form-data", ("file", "capture", "options")
log = logging.getLogger("kissgs.service")

MAX_OPTIONS_BYTES = 64 << 10
MAX_FORM_BYTES = MAX_OPTIONS_BYTES + (32 << 10)  # maximum bytes of a form in addition to the scene

UNPACKED_RATIO, UNPACKED_BYTES = 4, 16 << 20
"""Largest size of an unpacked capture, as a multiple of its archive and in addition: photographs are compressed, and
camera files as text shrink to a third. This much disk space is reserved."""


@dataclass
class Submission:
    """A request with a scene, of an owner, on its way to a job: options and name are those in the URL."""

    context: ServiceContainer
    request: Request
    owner: str
    options: str | bytes | None
    name: str | None
    key: str | None  # Idempotency-Key

    async def job(self) -> Job:
        """Receive the scene and queue a job; a repeated key with an identical scene and options gives its job."""
        context, request = self.context, self.request
        if context.worker.draining:
            raise ProblemError("stopping", "the service is stopping; try again in a minute", retry_after=60)
        if health_problem := await run_sync(context.store.monitor.health_problem):
            log.error("a submission was refused: the job database cannot be used: %s", health_problem)
            raise unusable_database()
        known = None if self.key is None else await run_sync(context.store.by_idempotency_key, self.owner, self.key)
        if known is None:
            await run_sync(context.admission.check, self.owner)
        parsed = parse_options(self.options) if self.options is not None else JobOptions()
        with context.admission.slot(self.owner or address_of(request.client)):
            kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
            _check_headers(request, kind)
            at_most = _scene_bytes(request, kind, context.settings)
            async with (
                CaptureUpload(context, self.owner) as capture,
                SceneUpload(context.settings, context.admission, context.storage.new_upload(), at_most) as scene,
            ):
                if kind == FORM_TYPE:
                    await self._receive_form(scene, capture)
                else:
                    scene.name = self.name or ""
                    if known is None:
                        await capture.check(parsed.capture)  # before the body
                    async for chunk in self._body():
                        await scene.write(chunk)
                job, new = await self._checked(scene, capture)
        if new:
            context.metrics.submitted.labels(job.preset).inc()
            context.metrics.bytes_in.inc(job.upload_bytes)
            context.notifier.notify(QUEUE)
            by, asked = self.owner or "anyone", request.state.request_id
            log.info("job %s submitted by %s: %d bytes (request %s)", job.id, by, job.upload_bytes, asked)
        return job

    def _body(self) -> AsyncIterator[bytes]:
        closing = self.context.notifier.subscribe("closing")  # which nothing else wakes
        return timed(self.request, self.context.settings, closing)

    async def _form_bytes(self, scene: SceneUpload, capture: CaptureUpload) -> AsyncIterator[bytes]:
        """Yield the body of a form; raise an error if it exceeds the limit for bytes other than scene and capture."""
        received = 0
        async for chunk in self._body():
            yield chunk
            received += len(chunk)
            if received - scene.size - capture.size > MAX_FORM_BYTES + len(chunk):
                beside = f"{MAX_FORM_BYTES} bytes beside the scene and the capture"
                raise invalid(f"the form has more than {beside}, which is the limit; send less")

    async def _receive_form(self, scene: SceneUpload, capture: CaptureUpload) -> None:
        """Receive a form with the fields ``file``, ``capture`` and ``options``, in any order, and set the options and
        the name, which may be those of the URL."""
        seen: list[str] = []
        text = bytearray()
        scene.name = self.name or ""
        async for event in parts(self.request.headers["content-type"], self._form_bytes(scene, capture)):
            match event:
                case PartBegin(field, filename):
                    if field not in FIELDS:
                        known = alternatives([repr(name) for name in FIELDS])
                        raise invalid(f"the form has an unknown field {field[:40]!r}; send {known}")
                    if field in seen:
                        raise invalid(f"the form has the field {field!r} twice; send each field once")
                    seen.append(field)
                    if field == "file":
                        scene.name = filename or self.name or ""
                        self.name = self.name or filename
                case bytes() if seen[-1] == "file":
                    await scene.write(event)
                case bytes() if seen[-1] == "capture":
                    await capture.write(event)
                case bytes():
                    text += event
                    if len(text) > MAX_OPTIONS_BYTES:
                        raise invalid(f"the options exceed {MAX_OPTIONS_BYTES} bytes, which is the limit; send less")
        if "file" not in seen:
            raise invalid("the form has no field 'file'; send the scene in it")
        if "options" in seen and self.options is not None:
            raise invalid("the options are both in the form and in the URL; send them once")
        if "capture" in seen and not capture.size:
            raise invalid("the field 'capture' is empty; send the archive in it, or leave it out")
        if "options" in seen:
            self.options = bytes(text)

    async def _checked(self, scene: SceneUpload, capture: CaptureUpload) -> tuple[Job, bool]:
        """Check the options, the complete scene and the capture, and queue a job. A repeated request gives its job even
        if its capture has been removed meanwhile. Return the job, and whether it is new."""
        text = "{}" if self.options is None else self.options
        options = parse_options(text)
        sha256, info = await scene.finish()
        reference = {"capture": await capture.finish_archive(options.capture)}
        asked = options.model_copy(update=reference).model_dump(mode="json")
        equal = json.dumps([sha256, asked], sort_keys=True)  # of equivalent requests
        fingerprint = hashlib.sha256(equal.encode()).hexdigest()
        if (known := await run_sync(self._known, fingerprint)) is not None:
            return known, False
        await capture.finish()
        options = parse_options(text, photographs=capture.photographs).model_copy(update=reference)
        checkpoints = checkpoint_bytes(
            info.count,
            info.sh_degree,
            compact=options.resumable and options.retrains,
            finetune=options.resumable and bool(options.finetune.enabled),
        )
        job = Job(
            id=uuid.uuid4().hex,
            owner=self.owner,
            name=scene_name(self.name),
            options=options.model_dump(mode="json"),
            preset=options.kind,
            evaluate=options.evaluate,
            gaussians=info.count,
            sh_degree=info.sh_degree,
            upload_bytes=scene.size,
            disk_bytes=scene.size + capture.bytes,
            work_bytes=capture.bytes + checkpoints,
            upload_sha256=sha256,
            fingerprint=fingerprint,
            idempotency_key=self.key,
        )
        return await run_sync(self._queue, job, scene.path, UPLOADS[info.format], capture.folder)

    def _queue(self, job: Job, upload: Path, ending: str, capture: Path) -> tuple[Job, bool]:
        """Queue a job with its upload and the folder of its capture; return it, or that of a request with the same key
        that was faster, and whether it is new."""
        context = self.context
        try:
            context.storage.adopt(upload, job.id, f"scene{ending}", capture)
            return context.admission.add(job), True
        except BaseException as error:
            context.storage.remove_job(job.id)
            refused = isinstance(error, LimitExceeded | ProblemError)
            if refused and (known := self._known(job.fingerprint)) is not None:
                return known, False
            if isinstance(error, OSError):
                text = f"the upload cannot be stored: {(error.strerror or str(error)).lower()}; try again later"
                raise disk_full(text) from error
            raise

    def _known(self, fingerprint: str) -> Job | None:
        """Return the job that an earlier request with this key made."""
        job = None if self.key is None else self.context.store.by_idempotency_key(self.owner, self.key)
        if job is not None and job.fingerprint != fingerprint:
            raise ProblemError(
                "key-reused",
                "this Idempotency-Key was used with another scene or other options; use a new key for a new job",
            )
        return job


def parse_options(text: str | bytes, *, photographs: bool | None = None) -> JobOptions:
    """Parse options from JSON; the problem of invalid ones lists every invalid field. ``photographs`` says whether a
    capture has them, see :meth:`kissgs.Settings.resolved`."""
    try:
        options = JobOptions.model_validate_json(text).resolved(photographs=photographs, torch=can_train())
    except ValidationError as error:
        named, found = field_errors(error.errors())
        raise ProblemError(
            "invalid-request",
            f"the options are invalid: {named}; JobOptions in /openapi.json lists all settings",
            errors=found,
        ) from error
    encodes = options.encode != kissgs.Settings.from_preset(options.preset).encode
    changes = encodes, options.compact.enabled, options.finetune.enabled, options.time_limit
    if options.format not in CONTAINERS and any(changes):
        raise invalid(
            f"format {options.format} holds the scene as it is; leave out goals and other settings of the encoder, the "
            "time limit, compaction and fine-tuning, or choose format sogxt or sog"
        )
    if options.trains and not can_train():
        raise invalid(
            "these options need torch, which this server does not have; use preset fast without fine-tuning, or "
            "compact with method merge, or ask the operator to install the extra train"
        )
    return options


def address_of(client: tuple[str, int] | None) -> str:
    """Return the address of a client, given with its port; of IPv6 the network, of which a client has all addresses."""
    host = client[0] if client else ""
    try:
        return str(ipaddress.ip_network(f"{host.partition('%')[0]}/64", strict=False)) if ":" in host else host
    except ValueError:
        return host


def _check_headers(request: Request, kind: str) -> None:
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding != "identity":
        text = f"the content encoding {encoding[:40]!r} is not supported; send the scene without it"
        raise ProblemError("media-type", text)
    if kind != FORM_TYPE and kind not in RAW_TYPES:
        raise ProblemError(
            "media-type",
            f"the media type {kind[:80]!r} is not supported; send a form with the field 'file' (curl -F file=@x.ply) "
            "or the scene itself as application/octet-stream",
        )


def _scene_bytes(request: Request, kind: str, settings: ServiceSettings) -> int | None:
    """Return the maximum size of the scene according to Content-Length; None if that is unknown."""
    text = request.headers.get("content-length", "")
    if not (text.isascii() and text.isdigit()):
        return None
    length = int(text) if len(text) < 19 else 10**18
    limit, beside = settings.max_upload_bytes, settings.max_capture_bytes + MAX_FORM_BYTES
    return limit if kind == FORM_TYPE and limit < length <= limit + beside else length


class CaptureUpload(Spool):
    """The capture of a submission, if it has one: an archive in the form, which is unpacked, or the hash of an earlier
    job's. As a context manager, it removes what no job has adopted. Finished, it has a ``reference``, the ``folder``
    and ``bytes`` of its files, and whether there are ``photographs`` to train on and others to evaluate with."""

    what, advice = "capture", "send fewer or smaller photographs"

    def __init__(self, context: ServiceContainer, owner: str) -> None:
        super().__init__(context.admission, context.storage.new_upload(), context.settings.max_capture_bytes)
        self._context, self._owner = context, owner
        self.folder = context.storage.new_upload()
        self._unpacked = 0  # bytes that are reserved
        self.reference: str | None = None
        self.photographs: bool | None = None
        self.bytes = 0

    def _leave(self) -> None:
        try:
            super()._leave()
        finally:
            self._context.storage.discard(self.folder)  # moved to the job, or not needed
            self._admission.release(self._unpacked, 0)

    async def check(self, reference: str | None) -> None:
        """Refuse the reference of a capture that no job of the owner has kept."""
        if reference is not None and not await run_sync(self._context.store.with_capture, self._owner, reference):
            raise _gone()

    async def finish_archive(self, reference: str | None) -> str | None:
        """Return the reference of the archive, or of an earlier job's capture without one."""
        if self.size:
            found = f"sha256:{await self.close()}"
            if reference not in (None, found):
                raise invalid(f"the option capture is not that of the archive, {found}; leave it out, or the archive")
            reference = found
        self.reference = reference
        return reference

    async def finish(self) -> None:
        """Unpack the archive, or find the capture of the reference, and check it; after :meth:`finish_archive`."""
        most = min(int(self._context.settings.max_capture_bytes), UNPACKED_RATIO * self.size + UNPACKED_BYTES)
        if self.size:
            await run_sync(self._admission.reserve, most)
            self._unpacked = most
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
        task: dict[str, Any] = {"function": UNPACK, "folder": str(self.path.parent), "files": []}
        task |= {"source": self.path.name if self.size else "", "work": self.folder.name}
        task |= {"most_bytes": most, "most_files": settings.max_capture_files}
        async with self._admission.unpacking:
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
        raise ProblemError(outcome.code, outcome.message or "the capture could not be unpacked; send it again")


def _gone() -> ProblemError:
    text = "the service does not have this capture, or not any more; send its archive in the field 'capture'"
    return ProblemError("gone", text)
