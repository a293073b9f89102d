"""Replicas: services that share a database and a storage, each with a row that its heartbeat changes.

A replica whose row has not changed during :data:`LAPSE_BEATS` heartbeats of another one is taken for dead: its row is
removed. Only changes count, so the clocks of machines need not agree, and beats that an observer could not see, because
the database did not answer it, do not count. A replica that was only suspended finds its row missing and writes
nothing: every write checks the row, and holds a lock on it that its removal waits for.

A claim says that a replica writes files of a job: of one whose row does not exist yet, of one that it runs, or of one
that it decodes. The claims of a dead replica stay until another one has cleaned up after it
(:mod:`service.jobs.replica_watch`).
"""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterable

import sqlalchemy as sa
from sqlalchemy import BigInteger, String
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column

from .machine import machine_number, may_run

LAPSE_BEATS = 4
"""Heartbeats without a change of another replica's row after which it is taken for dead."""

START_LOCK, JOIN_LOCK, QUEUE_LOCK = 7_302_001, 7_302_002, 7_302_003
"""Numbers of PostgreSQL's advisory locks: of starts, of new replicas, and of additions to the queue."""


class ReplicaBase(DeclarativeBase):
    """Base class of these tables, which only replicas have."""


class Replica(ReplicaBase):
    """A running replica: its machine and process, as in the database lease, and its number of heartbeats."""

    __tablename__ = "replicas"

    id: Mapped[str] = mapped_column(String(32), primary_key=True)
    machine: Mapped[int] = mapped_column(BigInteger)
    process: Mapped[int] = mapped_column(BigInteger)
    beats: Mapped[int] = mapped_column(BigInteger, default=0)


class Claim(ReplicaBase):
    """A replica writes files of a job, which may have no row."""

    __tablename__ = "claims"

    job: Mapped[str] = mapped_column(String(32), primary_key=True)
    replica: Mapped[str] = mapped_column(String(32), primary_key=True, index=True)


def lock(session: Session, number: int) -> None:
    """Wait for an advisory lock, which the end of the transaction releases."""
    session.execute(sa.text("SELECT pg_advisory_xact_lock(:number)"), {"number": number})


def create_tables(session: Session) -> None:
    """Create the tables of replicas if they do not exist."""
    ReplicaBase.metadata.create_all(session.connection())


def register(session: Session) -> str:
    """Add a row for this process; return its id."""
    row = Replica(id=secrets.token_hex(8), machine=machine_number(), process=os.getpid(), beats=0)
    session.add(row)
    session.flush()
    return row.id


def hold(session: Session | sa.Connection, replica: str) -> bool:
    """Lock the row of a replica against its removal until the end of the transaction; return whether it exists."""
    query = sa.select(Replica.id).where(Replica.id == replica)
    return session.execute(query.with_for_update(read=True, key_share=True)).first() is not None


def beat(session: Session, replica: str) -> None:
    """Change the row of a replica."""
    session.execute(sa.update(Replica).where(Replica.id == replica).values(beats=Replica.beats + 1))


def remove(session: Session, replica: str, beats: int | None = None) -> bool:
    """Remove the row of a replica, if it has not changed since ``beats``; return whether it was removed."""
    row = session.get(Replica, replica, with_for_update=True, populate_existing=True)
    if row is None or beats not in (None, row.beats):
        return False
    session.delete(row)
    session.flush()
    return True


def certainly_dead(row: Replica) -> bool:
    """Return whether a replica ran on this machine, in a process that has ended."""
    return row.machine == machine_number() and not may_run(row.process)


def take(session: Session, job_id: str, replica: str) -> None:
    """Add a claim."""
    session.merge(Claim(job=job_id, replica=replica))


def drop(session: Session, job_id: str, replica: str) -> bool:
    """Remove a claim; return whether there was one."""
    removed = session.execute(
        sa.delete(Claim).where(Claim.job == job_id, Claim.replica == replica).returning(Claim.job)
    )
    return removed.first() is not None


def is_claimed(session: Session, job_id: str) -> bool:
    """Return whether a running replica claims a job."""
    query = sa.select(Claim.job).join(Replica, Replica.id == Claim.replica).where(Claim.job == job_id)
    return session.execute(query.limit(1)).first() is not None


def claims_of_the_dead(session: Session) -> list[tuple[str, str]]:
    """Return job and replica of all claims whose replica has no row."""
    query = sa.select(Claim.job, Claim.replica).outerjoin(Replica, Replica.id == Claim.replica)
    return [(job, replica) for job, replica in session.execute(query.where(Replica.id.is_(None)).order_by(Claim.job))]


class LapseObserver:
    """Counts how often the rows of other replicas were seen without a change."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[int, int]] = {}

    def lapsed(self, rows: Iterable[Replica]) -> list[Replica]:
        """Return the replicas that are taken for dead, from one reading of all rows per heartbeat of the caller."""
        seen, found = {}, []
        for row in rows:
            beats, missed = self._seen.get(row.id, (row.beats, -1))
            missed = missed + 1 if beats == row.beats else 0
            seen[row.id] = row.beats, missed
            if missed >= LAPSE_BEATS or certainly_dead(row):
                found.append(row)
        self._seen = seen
        return found
