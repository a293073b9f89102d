"""Settings of the service: environment variables ``KISSGS_*``."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import BeforeValidator, ByteSize, Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

PREFIX = "KISSGS_"

CLIENT_NAMES = {"KISSGS_SERVER", "KISSGS_KEY"}  # of `kissgs remote`: the same shell may run both

LOOPBACK = ("127.0.0.1", "localhost", "::1")

OWNER = r"[A-Za-z0-9._@-]{1,64}"  # valid names of key owners

Seconds = Annotated[float, Field(gt=0, le=10 * 365 * 86400)]


_LOWER = BeforeValidator(lambda value: _words(value.lower()) if isinstance(value, str) else value)
Words = Annotated[tuple[str, ...], _LOWER]  # of a text, in lower case, as browsers send them


class SettingsError(Exception):
    """Invalid settings; the message names every problem, one per line."""


class ServiceSettings(BaseSettings):
    """All settings of the service. Sizes may be written as ``2GB`` or ``512MiB``, lists with spaces or commas."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, hide_input_in_errors=True)

    host: str = Field("127.0.0.1", description="Address to listen on; 0.0.0.0 listens on all interfaces.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 chooses a free port.")
    data_dir: Path = Field(
        Path("kissgs-data"), description="Folder of jobs, results and their database; created if missing."
    )
    keys: Annotated[tuple[tuple[str, str], ...], NoDecode] = Field(
        (),
        description="Keys as owner:sha256 (created by `kissgs-serve key`); without keys, everyone may use the service.",
    )
    names: Annotated[Words, NoDecode] = Field(
        (), description="Accepted host names; by default localhost if the service listens there without keys, else all."
    )
    cors_origins: Annotated[Words, NoDecode] = Field(
        (), description="Origins whose web pages may use the service (CORS); none by default."
    )

    max_upload_bytes: ByteSize = Field(ByteSize(2 << 30), gt=0, description="Maximum bytes of one upload.")
    max_capture_bytes: ByteSize = Field(
        ByteSize(2 << 30), gt=0, description="Maximum bytes of a capture, the photographs of a scene, also unpacked."
    )
    max_gaussians: int = Field(5_000_000, gt=0, le=20_000_000, description="Maximum number of Gaussians of one scene.")
    max_uploads: int = Field(
        16,
        gt=0,
        description="Maximum number of simultaneous uploads. One key (without keys, one address) has a quarter.",
    )
    max_queue: int = Field(100, gt=0, description="Maximum number of waiting jobs.")
    max_jobs_per_key: int = Field(20, gt=0, description="Maximum number of waiting and running jobs of one key owner.")
    max_disk_bytes: ByteSize = Field(
        ByteSize(50 << 30), gt=0, description="Maximum bytes on disk of all jobs together."
    )
    min_free_bytes: ByteSize = Field(ByteSize(1 << 30), ge=0, description="Bytes that must stay free on the disk.")

    runner: str = Field(
        "local",
        description="Where jobs run: local, on this machine; HOST:PORT of a Ray cluster's head, on its nodes; or ray, "
        "on the cluster of this machine, which is started if there is none.",
    )
    workers: int = Field(
        1, gt=0, le=64, description="Number of jobs that run simultaneously, on all machines together."
    )
    job_threads: int = Field(
        0, ge=0, description="Threads of one job; 0 uses one per processor, on a cluster those of its smallest node."
    )
    job_gpus: float = Field(
        0, ge=0, le=64, description="GPUs of a job with training, which then runs on CUDA; 0 trains on processors."
    )
    job_seconds: Seconds = Field(3600, description="Wall-clock seconds after which a job is stopped.")
    job_memory: ByteSize = Field(
        ByteSize(8 << 30), ge=256 << 20, description="Maximum bytes of memory of one job (Linux only)."
    )

    keep_seconds: Seconds = Field(86400, description="Seconds for which results are kept after a job has ended.")

    # What no operator needs to choose.
    drain_seconds: ClassVar[float] = 20
    """Seconds that a stopping service waits for running jobs, before it puts them back into the queue."""
    max_header_bytes: ClassVar[int] = 64 << 10
    """Maximum bytes of a .ply header: one with all known properties has three thousand."""
    max_capture_files: ClassVar[int] = 20_000
    """Maximum number of files in the archive of a capture, used or not; large captures have a few thousand."""
    capture_seconds: ClassVar[float] = 120
    """Seconds in which a capture must be unpacked and checked; two gigabytes take twenty."""
    upload_idle_seconds: ClassVar[float] = 30
    """Seconds without data after which an upload is aborted: TCP recovers from a lost packet in fewer."""
    upload_min_rate: ClassVar[int] = 32 << 10
    """Average bytes per second below which an upload is aborted: slower clients would keep their slots for days."""
    job_starts: ClassVar[int] = 3
    """Maximum number of starts of a job, including restarts of the service: the job may be what ends it."""
    sweep_seconds: ClassVar[float] = 30
    """Seconds between two removals of expired jobs, which are kept for hours."""
    sync_seconds: ClassVar[float] = 30
    """Seconds that POST /v1/compress waits for its job before it answers 202 or 409: many proxies give up after 60."""

    @field_validator("runner")
    @classmethod
    def _check_runner(cls, value: str) -> str:
        if value not in ("local", "ray") and ":" not in value:
            raise ValueError("it is not local, ray, or HOST:PORT of a Ray cluster's head")
        return value

    @field_validator("keys", mode="before")
    @classmethod
    def _split_keys(cls, value: Any) -> Any:  # noqa: ANN401
        if not isinstance(value, str):
            return value
        keys = []
        for number, entry in enumerate(_words(value), 1):
            found = re.fullmatch(rf"({OWNER}):([0-9a-f]{{64}})", entry)
            if not found:
                raise ValueError(f"entry {number} is not owner:sha256; `kissgs-serve key OWNER` makes one")
            keys.append((found[1], found[2]))
        return keys

    @field_validator("cors_origins")
    @classmethod
    def _check_origins(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for origin in value:
            if not re.fullmatch(r"\*|https?://[^/\s]+", origin):
                raise ValueError(f"{origin!r} is not an origin such as https://example.org")
        return value

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach the service."""
        return self.host in LOOPBACK

    def answers_to(self, name: str) -> bool:
        """Return whether the service accepts this host name (in lower case, without a port)."""
        if self.names:
            return name in self.names or name in LOOPBACK
        return name in LOOPBACK or bool(self.keys) or not self.is_private

    @property
    def ray_address(self) -> str | None:
        """Address of the Ray cluster that runs jobs, "auto" for that of this machine; None without one."""
        return {"local": None, "ray": "auto"}.get(self.runner, self.runner)

    @classmethod
    def from_environment(cls) -> Self:
        """Read ``KISSGS_*``; a :class:`SettingsError` lists all unknown names and invalid values."""
        known = {PREFIX + name.upper() for name in cls.model_fields}
        given = {name for name in os.environ if name.upper().startswith(PREFIX)}
        unknown = sorted(name for name in given if name.upper() not in known | CLIENT_NAMES)
        problems = [f"{name}: there is no such setting{_nearest(name, known)}" for name in unknown]
        try:
            settings = cls()
        except ValidationError as error:
            problems += [f"{PREFIX}{str(e['loc'][0]).upper()}: {_sentence(e['msg'])}" for e in error.errors()]
        if problems:
            raise SettingsError("\n".join(problems))
        return settings


def _nearest(name: str, known: Iterable[str]) -> str:
    found = difflib.get_close_matches(name.upper(), list(known), 1)
    return f"; did you mean {found[0]}?" if found else "; `kissgs-serve settings` lists all"


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[\s,]+", text) if word]


def _sentence(message: str) -> str:
    message = message.removeprefix("Value error, ")
    return message[:1].lower() + message[1:]
