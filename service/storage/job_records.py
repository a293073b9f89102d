"""``Store``: reading and changes of the tables of jobs and events, each change in one transaction. State transitions
are limited to :data:`_PREDECESSORS`, and compared and set in one step, so that of a simultaneous cancellation and
result only one takes effect. Each change of state or progress adds an event for clients."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from ..core.models import ACTIVE, ENDED, NOTE_CHARS, Event, Job, Meta, State
from ..core.settings import SettingsError
from .database import IDENTITY, DatabaseMonitor, NewDatabaseError, connect
from .job_files import RESERVE_BYTES, JobStorage

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
    """A job was not added because of a limit: ``"queue"``, ``"owner"`` or ``"key"``."""

    def __init__(self, limit: str) -> None:
        super().__init__(limit)
        self.limit = limit


class Store:
    """Jobs and events in a database. Methods block for milliseconds and are safe in any thread."""

    def __init__(self, file: Path, clock: Callable[[], float], *, jobs: int = 0) -> None:
        self._engine, self._writing, self._reading = connect(file, jobs=jobs)
        self.monitor = DatabaseMonitor(file, self.meta_value(IDENTITY))
        self.clock = clock
        self.turns: dict[str, int] = {}  # by owner, the number of the last start of one of its jobs, counted from 1
        self.changes = 0  # of the queue so far
        self.ends: dict[int, float] = {}  # when running jobs are expected to end, by their numbers

    def close(self) -> None:
        """Close all connections."""
        self._engine.dispose()
        self.monitor.close()

    def abandon(self) -> None:
        """Close without changing the database's files."""
        self.monitor.abandon()
        self._engine.dispose()

    # The database itself -------------------------------------------------------------------------------------------

    def meta_value(self, name: str) -> float | None:
        """Return a row of ``meta``, such as ``identity`` or ``time``; None if it does not exist."""
        with self._reading() as session:
            found = session.get(Meta, name)
        return found.value if found is not None else None

    @contextlib.contextmanager
    def _write(self) -> Iterator[Session]:
        """Begin a transaction; raise an error if the database is removed or replaced before it ends."""
        self.monitor.check_files()
        with self._writing.begin() as session:
            self.monitor.check_identity(session)
            yield session
        self.monitor.check_files()

    # Reading ----------------------------------------------------------------------------------------------------------

    def _one(self, query: sa.Select[Any]) -> Any:  # noqa: ANN401
        with self._reading() as session:
            return session.scalar(query)

    def _all(self, query: sa.Select[Any]) -> list[Any]:
        with self._reading() as session:
            return list(session.scalars(query))

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """Return a job by id; None if it does not exist or has another owner than ``owner``."""
        job = self._one(sa.select(Job).where(Job.id == job_id))
        return job if job is not None and owner in (None, job.owner) else None

    def by_idempotency_key(self, owner: str, key: str) -> Job | None:
        """Return the job that ``owner`` submitted with this key; None if there is none."""
        return self._one(sa.select(Job).where(Job.owner == owner, Job.idempotency_key == key))

    def with_capture(self, owner: str, reference: str) -> list[str]:
        """Return the ids of the jobs of an owner that have kept this capture, latest first."""
        same = Job.options["capture"].as_string() == reference
        query = sa.select(Job.id).where(Job.owner == owner, Job.upload_kept, same).order_by(Job.number.desc())
        return self._all(query)

    def listing(self, owner: str, *, limit: int, before: int | None = None, state: State | None = None) -> list[Job]:
        """Return up to ``limit`` jobs of an owner with a number below ``before``, newest first."""
        query = sa.select(Job).where(Job.owner == owner).order_by(Job.number.desc()).limit(limit)
        if before is not None:
            query = query.where(Job.number < before)
        if state is not None:
            query = query.where(Job.state == state)
        return self._all(query)

    def active(self) -> list[Job]:
        """Return all queued and running jobs, oldest first."""
        return self._all(sa.select(Job).where(Job.state.in_(ACTIVE)).order_by(Job.number))

    def events(self, number: int, after: int = 0) -> list[Event]:
        """Return the events of a job with a ``seq`` above ``after``, in order."""
        return self._all(sa.select(Event).where(Event.job == number, Event.seq > after).order_by(Event.seq))

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
            return _count(session, Job.owner == owner, Job.state.in_(ACTIVE))

    def disk_bytes(self) -> int:
        """Return the disk space of all jobs, bytes."""
        return self._one(sa.select(sa.func.sum(Job.disk_bytes))) or 0

    def rates(self, preset: str, evaluate: bool) -> list[float]:
        """Return seconds per Gaussian of up to 21 recent jobs of a preset, with or without evaluation."""
        kind = Job.preset == preset, Job.evaluate == evaluate, Job.state == State.SUCCEEDED
        query = sa.select(Job.finished_at - Job.started_at, Job.gaussians).where(*kind)
        with self._reading() as session:
            latest = session.execute(query.order_by(Job.number.desc()).limit(5 * 21)).all()
        # In jobs with small scenes, the start of the process dominates.
        return [spent / count for spent, count in latest if spent and count >= 10_000][:21]

    def ids(self, *states: State) -> set[str]:
        """Return the ids of all jobs in ``states``, by default of all jobs."""
        return set(self._all(sa.select(Job.id).where(Job.state.in_(states or tuple(State)))))

    def due(self, states: Iterable[State], before: float) -> list[tuple[int, str]]:
        """Return number and id of up to 200 jobs in ``states`` that expire before a time."""
        query = sa.select(Job.number, Job.id).where(Job.state.in_(tuple(states)), Job.expires_at < before)
        with self._reading() as session:
            return [(number, job_id) for number, job_id in session.execute(query.limit(200))]

    def oldest_reclaimable(self) -> Job | None:
        """Return the oldest ended job with reclaimable files; None if there is none."""
        query = sa.select(Job).where(Job.reclaimable_bytes > 0, Job.state.in_(ENDED))
        return self._one(query.order_by(Job.number).limit(1))

    def reclaimable_bytes(self) -> int:
        """Return the bytes of all reclaimable files of ended jobs."""
        query = sa.select(sa.func.sum(Job.reclaimable_bytes)).where(Job.reclaimable_bytes > 0, Job.state.in_(ENDED))
        return self._one(query) or 0

    def add(self, job: Job, *, max_queue: int, max_owner: int) -> Job:
        """Queue a job, unless ``max_queue`` are queued, or ``max_owner`` of its owner are queued or running."""
        try:
            with self._write() as session:
                if _count(session, Job.state == State.QUEUED) >= max_queue:
                    raise LimitExceeded("queue")
                active = Job.owner == job.owner, Job.owner != "", Job.state.in_(ACTIVE)
                if _count(session, *active) >= max_owner:
                    raise LimitExceeded("owner")
                job.created_at = self.clock()
                session.add(job)
                session.flush()
                _add_event(session, job, "state", {"state": State.QUEUED})
        except IntegrityError as error:
            raise LimitExceeded("key") from error
        self.changes += 1
        return job

    # Changes -------------------------------------------------------------------------------------------------------

    def claim(self) -> Job | None:
        """Set the next queued job to running and return it; None if the queue is empty. The owners of keys take turns,
        so that nobody waits for all jobs of another; of one, the oldest is next."""
        with self._write() as session:
            turn = [sa.case(self.turns, value=Job.owner, else_=0)] if self.turns else []
            query = sa.select(Job).where(Job.state == State.QUEUED).order_by(*turn, Job.number).limit(1)
            job = session.scalar(query)
            if job is None:
                return None
            job.starts += 1
            job.started_at = self.clock()
            job.disk_bytes = job.upload_bytes + job.work_bytes
            job.state = State.RUNNING
            _add_event(session, job, "state", {"state": State.RUNNING, "start": job.starts})
            self.turns = {**self.turns, job.owner: max(self.turns.values(), default=0) + 1}
        self.changes += 1
        return job

    def progress(self, number: int, stage: str, fraction: float, note: str = "", left: float | None = None) -> None:
        """Store the progress of a running job: stage, fraction from 0 to 1, a note if any, and the seconds left."""
        with self._write() as session:
            job = session.get(Job, number)
            if job is not None and job.state == State.RUNNING:
                job.stage, job.fraction, job.note = stage, fraction, note[:NOTE_CHARS] or None
                optional: dict[str, Any] = {"note": job.note} if job.note else {}
                if left is not None:
                    optional["seconds_left"], self.ends[number] = left, self.clock() + left
                _add_event(session, job, "progress", {"stage": stage, "fraction": fraction, **optional})

    def move(self, number: int, state: State, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's state and the columns ``values``; return False if its current state does not allow it. A job that
        returns to the queue loses its progress."""
        with self._write() as session:
            job = session.get(Job, number)
            if job is None or job.state not in _PREDECESSORS[state]:
                return False
            for name, value in values.items():
                setattr(job, name, value)
            if state == State.QUEUED:
                job.stage, job.fraction, job.note = None, 0.0, None
            if state in ENDED:
                job.finished_at = self.clock()
            job.state = state
            _add_event(session, job, "state", {"state": state, **({"problem": job.problem} if job.problem else {})})
        self.ends.pop(number, None)
        self.changes += 1
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

    def heartbeat(self) -> None:
        """Store the current time, with which the clock of the next start begins; it checks that it can be written."""
        with self._write() as session:
            session.merge(Meta(name="time", value=self.clock()))


def _count(session: Session, *where: sa.ColumnElement[bool]) -> int:
    """Return the number of jobs with these properties."""
    return session.scalar(sa.select(sa.func.count()).select_from(Job).where(*where)) or 0


def _add_event(session: Session, job: Job, kind: str, data: dict[str, Any]) -> None:
    job.last_event = (job.last_event or 0) + 1
    session.add(Event(job=job.number, seq=job.last_event, kind=kind, data=data))


def open_store(folder: JobStorage, clock: Callable[[], float]) -> Store:
    """Open the database of a data folder, on a full disk with the space of its reserve and of incomplete uploads."""
    stored = folder.job_ids()
    store = _open(folder, clock, stored)
    active = store.ids(*ACTIVE)
    if active and not active & stored:
        store.abandon()
        raise SettingsError(
            f"KISSGS_DATA_DIR: {folder.jobs} has none of the {len(active)} jobs that are queued or running in the job "
            f"database; mount or restore that folder, or, if they are lost, create the empty folder "
            f"{folder.jobs / min(active)} and start again, so that they are recorded as failed"
        )
    return store


def _open(folder: JobStorage, clock: Callable[[], float], stored: set[str]) -> Store:
    if folder.free_bytes() < RESERVE_BYTES:
        folder.free_reserve()
    try:
        return Store(folder.database, clock, jobs=len(stored))
    except SettingsError as error:
        if isinstance(error, NewDatabaseError) or folder.free_bytes() >= RESERVE_BYTES:
            raise
    folder.remove_uploads()  # this may free enough space for the database
    return Store(folder.database, clock, jobs=len(stored))
