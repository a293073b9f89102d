"""What the operator may choose: environment variables ``KISSGS_*``."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, ByteSize, ConfigDict, Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

PREFIX = "KISSGS_"

CLIENT_NAMES = {"KISSGS_SERVER", "KISSGS_KEY"}
"""What `kissgs remote` reads: in the same shell they are no mistake."""

LOOPBACK = ("127.0.0.1", "localhost", "::1")

OWNER = r"[A-Za-z0-9._@-]{1,64}"
"""What the owner of a key may be called."""

Seconds = Annotated[float, Field(gt=0, le=10 * 365 * 86400)]


class SettingsError(Exception):
    """Settings that cannot be used; the message names every problem, one a line."""


class ApiKey(BaseModel):
    """Who may use the service: a name, and the SHA-256 of a secret that only its owner has."""

    model_config = ConfigDict(frozen=True)

    owner: str
    sha256: str


class ServiceSettings(BaseSettings):
    """All settings of the service. Sizes may be written as ``2GB`` or ``512MiB``, lists with spaces or commas."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, hide_input_in_errors=True)

    host: str = Field("127.0.0.1", description="Address to listen on; 0.0.0.0 is every network there is.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    data_dir: Path = Field(Path("kissgs-data"), description="Folder of jobs and results; made if it is not there.")
    database_url: str | None = Field(
        None, description="SQLAlchemy URL of the job database; by default SQLite within the data folder."
    )
    keys: Annotated[tuple[ApiKey, ...], NoDecode] = Field(
        (), description="Who may use the service, as owner:sha256 (`kissgs-serve key` makes them); none: everyone."
    )
    names: Annotated[tuple[str, ...], NoDecode] = Field(
        (),
        description="Host names it answers to; by default localhost if it listens there and has no keys, else all.",
    )
    cors_origins: Annotated[tuple[str, ...], NoDecode] = Field(
        (), description="Origins whose pages may call the service; none by default."
    )

    max_upload_bytes: ByteSize = Field(ByteSize(2 << 30), gt=0, description="Of one upload.")
    max_header_bytes: ByteSize = Field(ByteSize(64 << 10), ge=1024, le=1 << 20, description="Of a .ply header.")
    max_gaussians: int = Field(5_000_000, gt=0, le=20_000_000, description="Of one scene.")
    max_uploads: int = Field(16, gt=0, description="Uploads at the same time.")
    upload_idle_seconds: Seconds = Field(30, description="An upload that sends nothing for so long is ended.")
    upload_min_rate: ByteSize = Field(
        ByteSize(8 << 10), description="Bytes per second, on average, below which an upload is ended."
    )
    max_queue: int = Field(100, gt=0, description="Jobs that may wait.")
    max_jobs_per_key: int = Field(20, gt=0, description="Jobs of one key that may wait or run.")
    max_disk_bytes: ByteSize = Field(ByteSize(50 << 30), gt=0, description="Of all jobs together.")
    min_free_bytes: ByteSize = Field(ByteSize(1 << 30), ge=0, description="What must stay free on the disk.")

    workers: int = Field(1, gt=0, le=64, description="Jobs that run at the same time.")
    job_threads: int = Field(0, ge=0, description="Threads of one job; 0 is one per processor.")
    job_seconds: Seconds = Field(3600, description="Wall time after which a job is ended.")
    job_memory: ByteSize = Field(ByteSize(8 << 30), ge=256 << 20, description="Memory of one job (Linux).")
    job_starts: int = Field(3, ge=1, description="How often a job may be started, restarts of the service included.")

    keep_seconds: Seconds = Field(86400, description="How long results can be fetched once a job has ended.")
    keep_uploads: bool = Field(True, description="Keep the .ply as long as the result, while there is room.")
    sweep_seconds: Seconds = Field(30, description="How often what has expired is removed.")
    sync_seconds: Seconds = Field(30, le=600, description="How long POST /v1/compress waits before it answers 202.")
    drain_seconds: float = Field(20, ge=0, description="How long a stopping service waits for running jobs.")
    log_level: Annotated[str, Field(pattern="^(debug|info|warning|error)$")] = Field(
        "info", description="debug, info, warning or error."
    )

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
            keys.append({"owner": found[1], "sha256": found[2]})
        return keys

    @field_validator("names", mode="before")
    @classmethod
    def _split_names(cls, value: Any) -> Any:  # noqa: ANN401
        return [word.lower() for word in _words(value)] if isinstance(value, str) else value

    @field_validator("cors_origins", mode="before")
    @classmethod
    def _split_origins(cls, value: Any) -> Any:  # noqa: ANN401
        origins = _words(value) if isinstance(value, str) else value
        for origin in origins:
            if not re.fullmatch(r"\*|https?://[^/\s]+", origin):
                raise ValueError(f"{origin!r} is not an origin such as https://example.org")
        return [origin.lower() for origin in origins]  # as browsers send them

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host in LOOPBACK

    def answers_to(self, name: str) -> bool:
        """Whether a request may call it by this name, in lower case and without a port."""
        if self.names:
            return name in self.names or name in LOOPBACK
        return name in LOOPBACK or bool(self.keys) or not self.is_private

    @property
    def database(self) -> str:
        """SQLAlchemy's URL of the job database."""
        return self.database_url or f"sqlite:///{(self.data_dir / 'jobs.sqlite').absolute()}"

    @classmethod
    def from_environment(cls) -> Self:
        """Read ``KISSGS_*``.

        Raises:
            SettingsError: names that are no settings, or values that are not possible; all of them.
        """
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
