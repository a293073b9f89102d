"""``Store``: all changes of the tables of jobs and events, each in one transaction; reading is in ``job_queries``.

State transitions are limited to :data:`_PREDECESSORS`, and compared and set in one step, so that of a simultaneous
cancellation and result only one takes effect. Each change of state or progress adds an event for clients.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.orm import Session

from ..core.models import ACTIVE, ENDED, NOTE_CHARS, Event, Job, Meta, State
from . import database_lease, replicas
from .database import connect
from .database_health import IDENTITY, DatabaseMonitor, DatabaseReplacedError
from .job_queries import JobQueries, count, disk_bytes
from .replica_records import ReplicaRecords

_PREDECESSORS: dict[State, tuple[State, ...]] = {
    State.RUNNING: (State.QUEUED,),
    State.QUEUED: (State.RUNNING,),  # started again
    State.SUCCEEDED: (State.RUNNING,),
    State.FAILED: (State.QUEUED, State.RUNNING),
    State.CANCELLED: (State.QUEUED, State.RUNNING),
    State.EXPIRED: ENDED,
}
"""States from which each state can be reached."""


class LimitExceeded(Exception):
    """A job was not added because of a limit: ``"queue"``, ``"owner"``, ``"disk"`` or ``"key"``.

    Attributes:
        limit: name of the limit.
    """

    def __init__(self, limit: str) -> None:
        super().__init__(limit)
        self.limit = limit


class Store(JobQueries, ReplicaRecords):
    """Jobs and events in a database. Methods block for milliseconds and are safe in any thread.

    Attributes:
        turns: by owner, the number of the last start of one of its jobs, counted from 1 since this service has started.

    Args:
        url: SQLAlchemy URL.
        clock: returns the time, seconds since 1970.
        create: whether a new database may be created.

    Raises:
        SettingsError: as for :func:`service.storage.database.connect`.
    """

    def __init__(self, url: str, clock: Callable[[], float], *, create: bool = True) -> None:
        self._engine, self._writing, self._reading = connect(url, create=create)
        self._monitor = DatabaseMonitor(self._engine)
        self._monitor.identity = self.meta_value(IDENTITY)
        self.clock = clock
        self.turns: dict[str, int] = {}
        self._changes = 0

    def close(self) -> None:
        """Release the database lease and close all connections."""
        if self._monitor.owner is not None and self.health_problem() is None:
            with contextlib.suppress(SQLAlchemyError), self._write() as session:
                database_lease.release(session)
        if self._monitor.replica is not None:
            with contextlib.suppress(SQLAlchemyError), self._writing.begin() as session:
                replicas.remove(session, self._monitor.replica)
        self._engine.dispose()
        self._monitor.close()

    def abandon(self) -> None:
        """Close without changing the database's files or releasing the lease."""
        self._monitor.abandon()
        self._engine.dispose()

    # The database itself -------------------------------------------------------------------------------------------

    def check(self) -> None:
        """Check that the database's files are those that were opened; takes microseconds.

        Raises:
            DatabaseReplacedError: a file was removed or replaced.
        """
        self._monitor.check_files()

    def health_problem(self) -> str | None:
        """Check the database; return the problem, None if there is none."""
        return self._monitor.health_problem()

    def meta_value(self, name: str) -> float | None:
        """Return a row of ``meta``, such as ``identity``, ``folder`` or ``time``; None if it does not exist."""
        with self._reading() as session:
            found = session.get(Meta, name)
        return found.value if found is not None else None

    def bind_to(self, folder: float, identity: float) -> None:
        """Store the number of the data folder that the database belongs to, and the number of the database itself."""
        with self._writing.begin() as session:
            session.merge(Meta(name="folder", value=folder))
            session.merge(Meta(name=IDENTITY, value=identity))
        self._monitor.identity = identity

    def acquire_database(self) -> None:
        """Take the database lease, which periodic calls of :meth:`heartbeat` renew.

        Raises:
            SettingsError: another service holds the lease.
        """
        self._monitor.owner = database_lease.acquire(self._writing, self._reading)

    @contextlib.contextmanager
    def _write(self) -> Iterator[Session]:
        """Begin a transaction; raise an error if the database is removed or replaced before it ends."""
        self.check()
        with self._writing.begin() as session:
            if problem := self._monitor.ownership_problem(session):
                raise DatabaseReplacedError(f"the job database no longer belongs to this service: {problem}")
            yield session
        self.check()

    # Jobs ----------------------------------------------------------------------------------------------------------

    @property
    def changes(self) -> int | None:
        """Number of changes of the queue so far; None if other replicas may change it, too."""
        return self._changes if self.replica is None else None

    def add(self, job: Job, *, max_queue: int, max_owner: int, max_disk: int | None = None) -> Job:
        """Queue a job; of a replica, drop the claim of it.

        Raises:
            LimitExceeded: ``max_queue`` jobs are queued, ``max_owner`` jobs of its owner are active, all jobs would
                have more than ``max_disk`` bytes, or its idempotency key is in use.
            DatabaseReplacedError: this replica has lost its claim.
        """
        try:
            with self._write() as session:
                if self.replica is not None:
                    replicas.lock(session, replicas.QUEUE_LOCK)  # counting and adding is one step for all replicas
                    if not replicas.drop(session, job.id, self.replica):
                        raise DatabaseReplacedError("another replica took this one for dead; send the request again")
                if max_disk is not None and disk_bytes(session) + job.disk_bytes > max_disk:
                    raise LimitExceeded("disk")
                if count(session, Job.state == State.QUEUED) >= max_queue:
                    raise LimitExceeded("queue")
                active = Job.owner == job.owner, Job.owner != "", Job.state.in_(ACTIVE)
                if count(session, *active) >= max_owner:
                    raise LimitExceeded("owner")
                job.created_at = self.clock()
                session.add(job)
                session.flush()
                _add_event(session, job, "state", {"state": State.QUEUED})
        except IntegrityError as error:
            raise LimitExceeded("key") from error
        self._changes += 1
        return job

    # Changes -------------------------------------------------------------------------------------------------------

    def claim(self) -> Job | None:
        """Set the next queued job to running and return it; None if the queue is empty.

        The owners of keys take turns, so that nobody waits for all jobs of another; of one, the oldest is next.
        """
        with self._write() as session:
            turn = [sa.case(self.turns, value=Job.owner, else_=0)] if self.turns else []
            query = sa.select(Job).where(Job.state == State.QUEUED).order_by(*turn, Job.number).limit(1)
            job = session.scalar(query.with_for_update(skip_locked=True))
            if job is None:
                return None
            job.starts += 1
            job.started_at = self.clock()
            job.disk_bytes = job.upload_bytes + job.work_bytes
            job.state = State.RUNNING
            if self.replica is not None:
                replicas.take(session, job.id, self.replica)
            _add_event(session, job, "state", {"state": State.RUNNING, "start": job.starts})
            self.turns = {**self.turns, job.owner: max(self.turns.values(), default=0) + 1}
        self._changes += 1
        return job

    def progress(self, number: int, stage: str, fraction: float, note: str = "") -> None:
        """Store the progress of a running job: stage, fraction from 0 to 1, and an optional note."""
        with self._write() as session:
            job = session.get(Job, number, with_for_update=True)
            if job is not None and job.state == State.RUNNING:
                job.stage, job.fraction, job.note = stage, fraction, note[:NOTE_CHARS] or None
                optional = {"note": job.note} if job.note else {}
                _add_event(session, job, "progress", {"stage": stage, "fraction": fraction, **optional})

    def move(self, number: int, state: State, *, dead: str | None = None, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's state and the columns ``values``; return False if its current state does not allow it.

        A job that returns to the queue loses its progress. A replica drops its own claim of the job, or that of a
        ``dead`` replica, without which the state does not change. One of a job that has succeeded it keeps, or takes,
        until the job's files are settled.
        """
        with self._write() as session:
            job = session.get(Job, number, with_for_update=True)
            if job is None or job.state not in _PREDECESSORS[state]:
                return False
            holder = dead or self.replica
            if holder is not None and state != State.RUNNING:
                dropped = replicas.drop(session, job.id, holder)
                if dead is not None and not dropped:
                    return False
                if state == State.SUCCEEDED and self.replica is not None:
                    replicas.take(session, job.id, self.replica)
            for name, value in values.items():
                setattr(job, name, value)
            if state == State.QUEUED:
                job.stage, job.fraction, job.note = None, 0.0, None
            if state in ENDED:
                job.finished_at = self.clock()
            job.state = state
            _add_event(session, job, "state", {"state": state, **({"problem": job.problem} if job.problem else {})})
        self._changes += 1
        return True

    def update(self, number: int, **values: Any) -> None:  # noqa: ANN401
        """Set columns without adding an event."""
        with self._write() as session:
            session.execute(sa.update(Job).where(Job.number == number).values(**values))

    def forget(self, number: int) -> None:
        """Remove a job and its events."""
        with self._write() as session:
            session.execute(sa.delete(Event).where(Event.job == number))
            session.execute(sa.delete(Job).where(Job.number == number))

    # The clock -----------------------------------------------------------------------------------------------------

    def latest_time(self) -> float:
        """Return the time of the last :meth:`heartbeat`; 0 if there was none."""
        return self.meta_value("time") or 0.0

    def heartbeat(self) -> None:
        """Store the current time, which renews the lease and checks that the database is writable."""
        with self._write() as session:
            session.merge(Meta(name="time", value=self.clock()))
            if self.replica is not None:
                replicas.beat(session, self.replica)


def _add_event(session: Session, job: Job, kind: str, data: dict[str, Any]) -> None:
    job.last_event = (job.last_event or 0) + 1
    session.add(Event(job=job.number, seq=job.last_event, kind=kind, data=data))
