"""``Store``: all reading and writing of the tables of jobs and events; each change is one transaction.

State transitions are limited to :data:`_PREDECESSORS`, and compared and set in one step, so that of a simultaneous
cancellation and result only one takes effect. Each change of state or progress adds an event for clients.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.orm import Session, load_only

from ..core.models import ACTIVE, ENDED, NOTE_CHARS, Event, Job, Meta, State
from . import database_lease, replicas
from .database import connect
from .database_health import IDENTITY, DatabaseMonitor, DatabaseReplacedError
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


class Store(ReplicaRecords):
    """Jobs and events in a database. Methods block for milliseconds and are safe in any thread.

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

    def states(self, job_ids: Iterable[str]) -> dict[str, tuple[State, int]]:
        """Return the state and the number of the last event of jobs, by id; those that do not exist are missing."""
        query = sa.select(Job.id, Job.state, Job.last_event).where(Job.id.in_(list(job_ids)))
        with self._reading() as session:
            return {job_id: (State(state), last) for job_id, state, last in session.execute(query)}

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
                if max_disk is not None and self._disk_bytes(session) + job.disk_bytes > max_disk:
                    raise LimitExceeded("disk")
                if self._count(session, Job.state == State.QUEUED) >= max_queue:
                    raise LimitExceeded("queue")
                active = Job.owner == job.owner, Job.owner != "", Job.state.in_(ACTIVE)
                if self._count(session, *active) >= max_owner:
                    raise LimitExceeded("owner")
                job.created_at = self.clock()
                session.add(job)
                session.flush()
                _add_event(session, job, "state", {"state": State.QUEUED})
        except IntegrityError as error:
            raise LimitExceeded("key") from error
        return job

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """Return a job by id; None if it does not exist or has another owner than ``owner``."""
        with self._reading() as session:
            job = session.scalar(sa.select(Job).where(Job.id == job_id))
        return job if job is not None and owner in (None, job.owner) else None

    def by_idempotency_key(self, owner: str, key: str) -> Job | None:
        """Return the job that ``owner`` submitted with this key; None if there is none."""
        with self._reading() as session:
            return session.scalar(sa.select(Job).where(Job.owner == owner, Job.idempotency_key == key))

    def listing(self, owner: str, *, limit: int, before: int | None = None, state: State | None = None) -> list[Job]:
        """Return up to ``limit`` jobs of an owner with a number below ``before``, newest first."""
        query = sa.select(Job).where(Job.owner == owner).order_by(Job.number.desc()).limit(limit)
        if before is not None:
            query = query.where(Job.number < before)
        if state is not None:
            query = query.where(Job.state == state)
        with self._reading() as session:
            return list(session.scalars(query))

    def in_state(self, *states: State) -> list[Job]:
        """Return all jobs in one of ``states``, oldest first."""
        with self._reading() as session:
            return list(session.scalars(sa.select(Job).where(Job.state.in_(states)).order_by(Job.number)))

    def active(self) -> list[Job]:
        """Return all queued and running jobs, with only the columns that estimates need."""
        columns = load_only(Job.state, Job.preset, Job.evaluate, Job.gaussians, Job.started_at)
        with self._reading() as session:
            return list(session.scalars(sa.select(Job).where(Job.state.in_(ACTIVE)).options(columns)))

    # Changes -------------------------------------------------------------------------------------------------------

    def claim(self) -> Job | None:
        """Set the oldest queued job to running and return it; None if the queue is empty."""
        with self._write() as session:
            query = sa.select(Job).where(Job.state == State.QUEUED).order_by(Job.number).limit(1)
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
        ``dead`` replica, without which the state does not change.
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
            for name, value in values.items():
                setattr(job, name, value)
            if state == State.QUEUED:
                job.stage, job.fraction, job.note = None, 0.0, None
            if state in ENDED:
                job.finished_at = self.clock()
            job.state = state
            _add_event(session, job, "state", {"state": state, **({"problem": job.problem} if job.problem else {})})
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

    # Events --------------------------------------------------------------------------------------------------------

    def events(self, number: int, after: int = 0) -> list[Event]:
        """Return the events of a job with a ``seq`` above ``after``, in order."""
        query = sa.select(Event).where(Event.job == number, Event.seq > after).order_by(Event.seq)
        with self._reading() as session:
            return list(session.scalars(query))

    # Sums ----------------------------------------------------------------------------------------------------------

    def counts(self) -> dict[State, int]:
        """Return the number of jobs in each state."""
        with self._reading() as session:
            rows = session.execute(sa.select(Job.state, sa.func.count()).group_by(Job.state)).all()
        found = {State(state): count for state, count in rows}
        return {state: found.get(state, 0) for state in State}

    def active_of(self, owner: str) -> int:
        """Return the number of queued and running jobs of an owner."""
        with self._reading() as session:
            return self._count(session, Job.owner == owner, Job.state.in_(ACTIVE))

    def disk_bytes(self) -> int:
        """Return the disk space of all jobs, bytes."""
        with self._reading() as session:
            return self._disk_bytes(session)

    def rates(self, preset: str, evaluate: bool, limit: int = 21) -> list[float]:
        """Return seconds per Gaussian of up to ``limit`` recent jobs of a preset, with or without evaluation."""
        kind = Job.preset == preset, Job.evaluate == evaluate, Job.state == State.SUCCEEDED
        query = sa.select(Job.finished_at - Job.started_at, Job.gaussians).where(*kind)
        with self._reading() as session:
            latest = session.execute(query.order_by(Job.number.desc()).limit(5 * limit)).all()
        # In jobs with small scenes, the start of the process dominates.
        return [spent / count for spent, count in latest if spent and count >= 10_000][:limit]

    def ids(self, *states: State) -> set[str]:
        """Return the ids of all jobs in ``states``, by default of all jobs."""
        with self._reading() as session:
            return set(session.scalars(sa.select(Job.id).where(Job.state.in_(states or tuple(State)))))

    def due(self, states: Iterable[State], before: float, limit: int = 200) -> list[tuple[int, str]]:
        """Return number and id of up to ``limit`` jobs in ``states`` that expire before a time."""
        query = sa.select(Job.number, Job.id).where(Job.state.in_(tuple(states)), Job.expires_at < before)
        with self._reading() as session:
            return [(number, job_id) for number, job_id in session.execute(query.limit(limit))]

    def reclaimable(self, limit: int = 50) -> list[tuple[int, str]]:
        """Return number and id of up to ``limit`` ended jobs with reclaimable files, oldest first."""
        query = sa.select(Job.number, Job.id).where(Job.reclaimable_bytes > 0, Job.state.in_(ENDED))
        with self._reading() as session:
            return [(number, job_id) for number, job_id in session.execute(query.order_by(Job.number).limit(limit))]

    def reclaimable_bytes(self) -> int:
        """Return the bytes of all reclaimable files of ended jobs."""
        query = sa.select(sa.func.coalesce(sa.func.sum(Job.reclaimable_bytes), 0)).where(Job.reclaimable_bytes > 0)
        with self._reading() as session:
            return int(session.scalar(query.where(Job.state.in_(ENDED))) or 0)

    def waiting(self) -> int:
        """Return the number of queued jobs."""
        with self._reading() as session:
            return self._count(session, Job.state == State.QUEUED)

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

    @staticmethod
    def _disk_bytes(session: Session) -> int:
        return int(session.scalar(sa.select(sa.func.coalesce(sa.func.sum(Job.disk_bytes), 0))) or 0)

    @staticmethod
    def _count(session: Session, *where: sa.ColumnElement[bool]) -> int:
        return session.scalar(sa.select(sa.func.count()).select_from(Job).where(*where)) or 0


def _add_event(session: Session, job: Job, kind: str, data: dict[str, Any]) -> None:
    job.last_event = (job.last_event or 0) + 1
    session.add(Event(job=job.number, seq=job.last_event, kind=kind, data=data))
