"""Database tables as SQLAlchemy models."""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, Float, ForeignKey, Index, Integer, String, UniqueConstraint
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

SCHEMA_VERSION = 4  # of the tables and the results in them; a database of another version is refused
NOTE_CHARS = 200  # maximum length of a progress note; longer notes are truncated


class State(StrEnum):
    """Life cycle state of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    EXPIRED = "expired"


ACTIVE = (State.QUEUED, State.RUNNING)
ENDED = (State.SUCCEEDED, State.FAILED, State.CANCELLED)


class Base(DeclarativeBase):
    """Base class of all tables."""


class Meta(Base):
    """Properties of the database itself, by name: schema version, identity, latest time."""

    __tablename__ = "meta"

    name: Mapped[str] = mapped_column(String(32), primary_key=True)
    value: Mapped[float] = mapped_column(Float(53))


class Job(Base):
    """One upload, its options, its progress and its result. Times are seconds since 1970; sizes are bytes.
    ``disk_bytes`` is the size of its files; while the job runs, that of the upload plus ``work_bytes``, the upper bound
    for its checkpoints, and its capture. ``reclaimable_bytes`` is the part that can be deleted for new uploads once the
    job has ended: the upload, which is kept for comparisons, the capture and the decoded scene."""

    __tablename__ = "jobs"
    __table_args__ = (
        UniqueConstraint("owner", "idempotency_key"),
        Index("jobs_by_state", "state", "number"),
        Index("jobs_by_owner", "owner", "number"),
        Index("jobs_by_kind", "preset", "evaluate", "state", "number"),
        Index("jobs_by_expiry", "expires_at"),
        Index("jobs_by_size", "disk_bytes"),
        Index("jobs_by_reclaimable", "reclaimable_bytes"),
        {"sqlite_autoincrement": True},  # numbers are cursors and must never be reused
    )

    number: Mapped[int] = mapped_column(Integer, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(32), unique=True)
    owner: Mapped[str] = mapped_column(String(64))
    name: Mapped[str] = mapped_column(String(200))
    state: Mapped[str] = mapped_column(String(16), default=State.QUEUED)
    options: Mapped[dict[str, Any]] = mapped_column(JSON)
    preset: Mapped[str] = mapped_column(String(60))
    evaluate: Mapped[bool]
    gaussians: Mapped[int] = mapped_column(Integer)
    sh_degree: Mapped[int] = mapped_column(Integer)
    upload_bytes: Mapped[int] = mapped_column(BigInteger)
    upload_sha256: Mapped[str] = mapped_column(String(64))
    fingerprint: Mapped[str] = mapped_column(String(64))
    idempotency_key: Mapped[str | None] = mapped_column(String(255))
    disk_bytes: Mapped[int] = mapped_column(BigInteger)
    reclaimable_bytes: Mapped[int] = mapped_column(BigInteger, default=0)
    work_bytes: Mapped[int] = mapped_column(BigInteger, default=0)
    upload_kept: Mapped[bool] = mapped_column(default=True)
    starts: Mapped[int] = mapped_column(Integer, default=0)
    crashes: Mapped[int] = mapped_column(Integer, default=0)
    stage: Mapped[str | None] = mapped_column(String(64))
    fraction: Mapped[float] = mapped_column(Float(53), default=0.0)
    note: Mapped[str | None] = mapped_column(String(NOTE_CHARS))
    last_event: Mapped[int] = mapped_column(Integer, default=0)
    created_at: Mapped[float] = mapped_column(Float(53))
    started_at: Mapped[float | None] = mapped_column(Float(53))
    finished_at: Mapped[float | None] = mapped_column(Float(53))
    expires_at: Mapped[float | None] = mapped_column(Float(53))
    problem: Mapped[dict[str, Any] | None] = mapped_column(JSON)
    result: Mapped[dict[str, Any] | None] = mapped_column(JSON)


class Event(Base):
    """State change or progress of a job; ``seq`` counts from 1 without gaps."""

    __tablename__ = "events"

    job: Mapped[int] = mapped_column(ForeignKey("jobs.number", ondelete="CASCADE"), primary_key=True)
    seq: Mapped[int] = mapped_column(Integer, primary_key=True)
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]] = mapped_column(JSON)
