"""Rows of replicas and of their claims, as a part of the job store."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import AbstractContextManager

import sqlalchemy as sa
from sqlalchemy.orm import Session

from . import replicas
from .database import Sessions
from .database_health import DatabaseMonitor


class ReplicaRecords:
    """Methods of the job store that concern replicas; without replicas, they do nothing."""

    _writing: Sessions
    _reading: Sessions
    _monitor: DatabaseMonitor

    def _write(self) -> AbstractContextManager[Session]:
        raise NotImplementedError

    @property
    def replica(self) -> str | None:
        """Id of this replica; None if the database belongs to one service."""
        return self._monitor.replica

    @contextlib.contextmanager
    def starting(self) -> Iterator[None]:
        """Let only one replica at a time start with this database, which must be PostgreSQL."""
        with self._writing.begin() as session:
            replicas.lock(session, replicas.START_LOCK)
            yield

    def join(self) -> str:
        """Register this process as a replica, with a new id; return it."""
        with self._writing.begin() as session:
            replicas.lock(session, replicas.JOIN_LOCK)
            replicas.create_tables(session)
            self._monitor.replica = replicas.register(session)
        return self._monitor.replica

    def is_lapsed(self) -> bool:
        """Return whether another replica has taken this one for dead."""
        with self._reading() as session:
            return self.replica is not None and session.get(replicas.Replica, self.replica) is None

    def other_replicas(self) -> list[replicas.Replica]:
        """Return the rows of all other replicas."""
        with self._reading() as session:
            return list(session.scalars(sa.select(replicas.Replica).where(replicas.Replica.id != self.replica)))

    def count_replicas(self) -> int:
        """Return the number of replicas; 1 if the database belongs to one service."""
        if self.replica is None:
            return 1
        with self._reading() as session:
            return max(1, session.scalar(sa.select(sa.func.count()).select_from(replicas.Replica)) or 0)

    def bury(self, row: replicas.Replica) -> bool:
        """Remove the row of a replica that has not changed it since it was read; return whether it was removed."""
        with self._write() as session:
            return replicas.remove(session, row.id, row.beats)

    def claimed_ids(self) -> set[str]:
        """Return the ids of all jobs that a replica writes files of."""
        with self._reading() as session:
            return set(session.scalars(sa.select(replicas.Claim.job)))

    def claims_of_the_dead(self) -> list[tuple[str, str]]:
        """Return job and replica of all claims whose replica has no row."""
        with self._reading() as session:
            return replicas.claims_of_the_dead(session)

    def take_claim(self, job_id: str) -> None:
        """Record that this replica writes files of a job; nothing without replicas."""
        if self.replica is not None:
            with self._write() as session:
                replicas.take(session, job_id, self.replica)

    def drop_claim(self, job_id: str, replica: str | None = None) -> None:
        """Record that a replica, by default this one, writes files of a job no more; nothing without replicas."""
        if (holder := replica or self.replica) is not None:
            with self._write() as session:
                replicas.drop(session, job_id, holder)

    def is_claimed(self, job_id: str) -> bool:
        """Return whether a running replica writes files of a job."""
        with self._reading() as session:
            return self.replica is not None and replicas.is_claimed(session, job_id)
