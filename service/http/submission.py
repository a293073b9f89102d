"""Conversion of a request with a scene to a queued job."""

from __future__ import annotations

import hashlib
import ipaddress
import json
import logging
import uuid
from collections.abc import AsyncIterator
from pathlib import Path

from anyio.to_thread import run_sync
from pydantic import ValidationError
from starlette.requests import Request

import kissgs
from kissgs.formats import CONTAINERS, UPLOADS, alternatives

from ..core.files import checkpoint_bytes
from ..core.models import Job
from ..core.presets import can_train
from ..core.problems import ProblemError, disk_full, field_errors, invalid, unusable_database
from ..core.schemas import JobOptions
from ..core.settings import ServiceSettings
from ..jobs.container import ServiceContainer
from ..jobs.worker import QUEUE
from ..storage.job_records import LimitExceeded
from .captures import CaptureUpload
from .uploads import PartBegin, Received, Spool, parts, scene_name, timed

RAW_TYPES = ("", "application/octet-stream", "application/ply", "application/x-ply", "model/ply")
FORM_TYPE, FIELDS = "multipart/form-data", ("file", "capture", "options")
log = logging.getLogger("kissgs.service")

STOPPING = "stopping"  # subscription that only the closing of the notifier wakes

MAX_OPTIONS_BYTES = 64 << 10
MAX_FORM_BYTES = MAX_OPTIONS_BYTES + (32 << 10)  # maximum bytes of a form in addition to the scene


def _fingerprint(received: Received, options: JobOptions) -> str:
    """Return a hash of the scene and the options, with the capture; equal for equivalent requests."""
    asked = json.dumps([received.sha256, options.model_dump(mode="json")], sort_keys=True)
    return hashlib.sha256(asked.encode()).hexdigest()


async def submit(
    context: ServiceContainer, request: Request, owner: str, *, options: str | None, name: str | None, key: str | None
) -> Job:
    """Receive a scene and queue a job for it; a repeated key with an identical scene and options gives its job."""
    if context.worker.draining:
        raise ProblemError("stopping", "the service is stopping; try again in a minute", retry_after=60)
    if health_problem := await run_sync(context.store.monitor.health_problem):
        log.error("a submission was refused: the job database cannot be used: %s", health_problem)
        raise unusable_database()
    known = await run_sync(context.store.by_idempotency_key, owner, key) if key is not None else None
    if known is None:
        await run_sync(context.admission.check, owner)
    parsed = parse_options(options) if options is not None else JobOptions()
    with context.admission.slot(owner or address_of(request.client)):
        path = context.storage.new_upload()
        kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        _check_headers(request, kind)
        at_most = _scene_bytes(request, kind, context.settings)
        async with (
            CaptureUpload(context, owner) as capture,
            Spool(context.settings, context.admission, path, at_most) as spool,
        ):
            text: str | bytes = options or "{}"
            spool.name = name or ""
            if kind == FORM_TYPE:
                text, name = await _receive_form(context, request, spool, capture, options, name)
            else:
                if known is None:
                    await capture.check(parsed.capture)  # before the body
                async for chunk in _body(context, request):
                    await spool.write(chunk)
            try:
                job, new = await _checked(context, spool, capture, owner, text, scene_name(name), key)
            finally:
                await run_sync(context.storage.discard, path)  # already moved to the job, or not needed
    if new:
        context.metrics.submitted.labels(job.preset).inc()
        context.metrics.bytes_in.inc(job.upload_bytes)
        context.notifier.notify(QUEUE)
        asked = request.state.request_id
        log.info("job %s submitted by %s: %d bytes (request %s)", job.id, owner or "anyone", job.upload_bytes, asked)
    return job


async def _checked(
    context: ServiceContainer,
    spool: Spool,
    capture: CaptureUpload,
    owner: str,
    text: str | bytes,
    name: str,
    key: str | None,
) -> tuple[Job, bool]:
    """Check the options, the complete scene and the capture, and queue a job. A repeated request gives its job even if
    its capture has been removed meanwhile. Return the job, and whether it is new."""
    options = parse_options(text)
    received = await spool.finish()
    reference = {"capture": await capture.close(options.capture)}
    fingerprint = _fingerprint(received, options.model_copy(update=reference))
    if (known := await run_sync(_known, context, owner, key, fingerprint)) is not None:
        return known, False
    await capture.finish()
    options = parse_options(text, photographs=capture.photographs).model_copy(update=reference)
    job = Job(
        id=uuid.uuid4().hex,
        owner=owner,
        name=name,
        options=options.model_dump(mode="json"),
        preset=options.kind,
        evaluate=options.evaluate,
        gaussians=received.info.count,
        sh_degree=received.info.sh_degree,
        upload_bytes=received.size,
        disk_bytes=received.size + capture.bytes,
        work_bytes=capture.bytes
        + checkpoint_bytes(
            received.info.count,
            received.info.sh_degree,
            compact=options.resumable and options.retrains,
            finetune=options.resumable and bool(options.finetune.enabled),
        ),
        upload_sha256=received.sha256,
        fingerprint=fingerprint,
        idempotency_key=key,
    )
    return await run_sync(_queue, context, job, received, capture.folder)


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


def _body(context: ServiceContainer, request: Request) -> AsyncIterator[bytes]:
    return timed(request, context.settings, context.notifier.subscribe(STOPPING))


async def _form_bytes(
    context: ServiceContainer, request: Request, spool: Spool, capture: CaptureUpload
) -> AsyncIterator[bytes]:
    """Yield the body of a form; raise an error if it exceeds the limit for bytes other than scene and capture."""
    received = 0
    async for chunk in _body(context, request):
        yield chunk
        received += len(chunk)
        if received - spool.size - capture.size > MAX_FORM_BYTES + len(chunk):
            beside = f"{MAX_FORM_BYTES} bytes beside the scene and the capture"
            raise invalid(f"the form has more than {beside}, which is the limit; send less")


async def _receive_form(
    context: ServiceContainer,
    request: Request,
    spool: Spool,
    capture: CaptureUpload,
    options: str | None,
    name: str | None,
) -> tuple[str | bytes, str | None]:
    """Receive a form with the fields ``file``, ``capture`` and ``options``, in any order; return the options, perhaps
    those of the URL, and the name."""
    seen: list[str] = []
    text = bytearray()
    async for event in parts(request.headers["content-type"], _form_bytes(context, request, spool, capture)):
        match event:
            case PartBegin(field, filename):
                if field not in FIELDS:
                    known = alternatives([repr(name) for name in FIELDS])
                    raise invalid(f"the form has an unknown field {field[:40]!r}; send {known}")
                if field in seen:
                    raise invalid(f"the form has the field {field!r} twice; send each field once")
                seen.append(field)
                name = name or filename if field == "file" else name
                spool.name = filename or name or "" if field == "file" else spool.name
            case bytes() if seen[-1] == "file":
                await spool.write(event)
            case bytes() if seen[-1] == "capture":
                await capture.write(event)
            case bytes():
                text += event
                if len(text) > MAX_OPTIONS_BYTES:
                    raise invalid(f"the options exceed {MAX_OPTIONS_BYTES} bytes, which is the limit; send less")
    if "file" not in seen:
        raise invalid("the form has no field 'file'; send the scene in it")
    if "options" in seen and options is not None:
        raise invalid("the options are both in the form and in the URL; send them once")
    if "capture" in seen and not capture.size:
        raise invalid("the field 'capture' is empty; send the archive in it, or leave it out")
    return bytes(text) if "options" in seen else options or "{}", name


def _queue(context: ServiceContainer, job: Job, received: Received, capture: Path) -> tuple[Job, bool]:
    """Queue a job with its upload and the folder of its capture; return it, or that of a request with the same key that
    was faster, and whether it is new."""
    owner, key, fingerprint = job.owner, job.idempotency_key, job.fingerprint
    if (known := _known(context, owner, key, fingerprint)) is not None:
        return known, False
    try:
        context.storage.adopt(received.path, job.id, f"scene{UPLOADS[received.info.format]}", capture)
        return context.admission.add(job), True
    except BaseException as error:
        context.storage.remove_job(job.id)
        if isinstance(error, LimitExceeded) and (known := _known(context, owner, key, fingerprint)) is not None:
            return known, False
        if isinstance(error, OSError):
            text = f"the upload cannot be stored: {(error.strerror or str(error)).lower()}; try again later"
            raise disk_full(text) from error
        raise


def _known(context: ServiceContainer, owner: str, key: str | None, fingerprint: str) -> Job | None:
    if key is None:
        return None
    job = context.store.by_idempotency_key(owner, key)
    if job is not None and job.fingerprint != fingerprint:
        raise ProblemError(
            "key-reused",
            "this Idempotency-Key was used with another scene or other options; use a new key for a new job",
        )
    return job
