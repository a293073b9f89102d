"""What is known of every job: all reading and writing of the tables, each change one transaction.

States change only as the table of :data:`_NEXT` allows, compared and set in one step, so that a cancellation and a
result that arrive together cannot both win. Every change that a client may want to hear of leaves an event.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.orm import Session, load_only

from service.core.models import ACTIVE, ENDED, NOTE_CHARS, Event, Job, Meta, State
from service.storage import database_lease
from service.storage.database import connect
from service.storage.database_health import IDENTITY, DatabaseMonitor, DatabaseReplacedError

_NEXT: dict[State, tuple[State, ...]] = {
    State.RUNNING: (State.QUEUED,),
    State.QUEUED: (State.RUNNING,),  # started again
    State.SUCCEEDED: (State.RUNNING,),
    State.FAILED: (State.QUEUED, State.RUNNING),
    State.CANCELLED: (State.QUEUED, State.RUNNING),
    State.EXPIRED: ENDED,
}
"""State -> those it may be reached from."""


class LimitExceeded(Exception):
    """A job was not added, because a limit would be passed; ``limit`` names it: queue, owner or key."""

    def __init__(self, limit: str) -> None:
        super().__init__(limit)
        self.limit = limit


class Store:
    """Jobs and events in a database. Methods block for milliseconds and are safe in any thread.

    Args:
        url: of SQLAlchemy.
        clock: tells the time.
        may_be_new: whether tables may be made.

    Raises:
        SettingsError: as :func:`service.storage.database.connect`.
    """

    def __init__(self, url: str, clock: Callable[[], float], *, may_be_new: bool = True) -> None:
        self._engine, self._writing, self._reading = connect(url, may_be_new=may_be_new)
        self._watch = DatabaseMonitor(self._engine)
        self._watch.identity = self.fact(IDENTITY)
        self.clock = clock

    def close(self) -> None:
        """Let go of all connections, and let the next service have the database."""
        if self._watch.owner is not None and self.health_problem() is None:
            with contextlib.suppress(SQLAlchemyError), self._write() as session:
                database_lease.release(session)
        self._engine.dispose()
        self._watch.close()

    def leave(self) -> None:
        """Let go of a database that is not to be touched."""
        self._watch.leave()
        self._engine.dispose()

    # The database itself -------------------------------------------------------------------------------------------

    def require(self) -> None:
        """See that the database's files are those that were opened: a matter of microseconds.

        Raises:
            DatabaseReplacedError: they are not.
        """
        self._watch.require()

    def health_problem(self) -> str | None:
        """Why the database cannot be relied on; None if it can."""
        return self._watch.health_problem()

    def fact(self, name: str) -> float | None:
        """A number that the database keeps about itself: ``identity``, ``folder`` or ``time``."""
        with self._reading() as session:
            found = session.get(Meta, name)
        return found.value if found is not None else None

    def belong_to(self, folder: float, identity: float) -> None:
        """Write down which data folder the database belongs to, and which number it is known by."""
        with self._writing.begin() as session:
            session.merge(Meta(name="folder", value=folder))
            session.merge(Meta(name=IDENTITY, value=identity))
        self._watch.identity = identity

    def acquire_database(self) -> None:
        """Keep other services from using the database as long as this one calls :meth:`heartbeat` again and again.

        Raises:
            SettingsError: another service is using it.
        """
        self._watch.owner = database_lease.acquire(self._writing, self._reading)

    @contextlib.contextmanager
    def _write(self) -> Iterator[Session]:
        """A transaction that counts only if the database is still there when it has ended."""
        self.require()
        with self._writing.begin() as session:
            if why := self._watch.ownership_problem(session):
                raise DatabaseReplacedError(f"the job database is no longer this service's: {why}")
            yield session
        self.require()

    # Jobs ----------------------------------------------------------------------------------------------------------

    def add(self, job: Job, *, max_queue: int, max_owner: int) -> Job:
        """Queue a job.

        Raises:
            LimitExceeded: ``max_queue`` jobs wait already, ``max_owner`` of its owner's are active, or its idempotency
                key is taken.
        """
        try:
            with self._write() as session:
                if self._count(session, Job.state == State.QUEUED) >= max_queue:
                    raise LimitExceeded("queue")
                mine = Job.owner == job.owner, Job.owner != "", Job.state.in_(ACTIVE)
                if self._count(session, *mine) >= max_owner:
                    raise LimitExceeded("owner")
                job.created_at = self.clock()
                session.add(job)
                session.flush()
                _note(session, job, "state", {"state": State.QUEUED})
        except IntegrityError as error:
            raise LimitExceeded("key") from error
        return job

    def get(self, job_id: str, owner: str | None = None) -> Job | None:
        """A job by its id; None if there is none, or if it is not ``owner``'s."""
        with self._reading() as session:
            job = session.scalar(sa.select(Job).where(Job.id == job_id))
        return job if job is not None and owner in (None, job.owner) else None

    def by_idempotency_key(self, owner: str, key: str) -> Job | None:
        """The job that ``owner`` submitted with this key."""
        with self._reading() as session:
            return session.scalar(sa.select(Job).where(Job.owner == owner, Job.idempotency_key == key))

    def listing(self, owner: str, *, limit: int, before: int | None = None, state: State | None = None) -> list[Job]:
        """Jobs of an owner, newest first, from the one before number ``before``."""
        query = sa.select(Job).where(Job.owner == owner).order_by(Job.number.desc()).limit(limit)
        if before is not None:
            query = query.where(Job.number < before)
        if state is not None:
            query = query.where(Job.state == state)
        with self._reading() as session:
            return list(session.scalars(query))

    def in_state(self, *states: State) -> list[Job]:
        """All jobs in one of ``states``, oldest first."""
        with self._reading() as session:
            return list(session.scalars(sa.select(Job).where(Job.state.in_(states)).order_by(Job.number)))

    def active(self) -> list[Job]:
        """Jobs that wait or run: what estimates need of them."""
        columns = load_only(Job.state, Job.preset, Job.evaluate, Job.gaussians, Job.started_at)
        with self._reading() as session:
            return list(session.scalars(sa.select(Job).where(Job.state.in_(ACTIVE)).options(columns)))

    # Changes -------------------------------------------------------------------------------------------------------

    def claim(self) -> Job | None:
        """The job that has waited longest, now running; None if none waits."""
        with self._write() as session:
            query = sa.select(Job).where(Job.state == State.QUEUED).order_by(Job.number).limit(1)
            job = session.scalar(query.with_for_update(skip_locked=True))
            if job is None:
                return None
            job.starts += 1
            job.started_at = self.clock()
            job.disk_bytes = job.upload_bytes + job.work_bytes
            job.state = State.RUNNING
            _note(session, job, "state", {"state": State.RUNNING, "start": job.starts})
            return job

    def progress(self, number: int, stage: str, fraction: float, note: str = "") -> None:
        """Note how far a running job is, and what it has to say of that, if anything."""
        with self._write() as session:
            job = session.get(Job, number, with_for_update=True)
            if job is not None and job.state == State.RUNNING:
                job.stage, job.fraction, job.note = stage, fraction, note[:NOTE_CHARS] or None
                said = {"note": job.note} if job.note else {}
                _note(session, job, "progress", {"stage": stage, "fraction": fraction, **said})

    def move(self, number: int, state: State, **values: Any) -> bool:  # noqa: ANN401
        """Set a job's state, and ``values`` with it; False if it is no longer in a state that leads there.

        A job that goes back into the queue has nothing behind it.
        """
        with self._write() as session:
            job = session.get(Job, number, with_for_update=True)
            if job is None or job.state not in _NEXT[state]:
                return False
            for name, value in values.items():
                setattr(job, name, value)
            if state == State.QUEUED:
                job.stage, job.fraction, job.note = None, 0.0, None
            if state in ENDED:
                job.finished_at = self.clock()
            job.state = state
            _note(session, job, "state", {"state": state, **({"problem": job.problem} if job.problem else {})})
            return True

    def update(self, number: int, **values: Any) -> None:  # noqa: ANN401
        """Set columns that nobody needs to hear of."""
        with self._write() as session:
            session.execute(sa.update(Job).where(Job.number == number).values(**values))

    def forget(self, number: int) -> None:
        """Remove a job and its events."""
        with self._write() as session:
            session.execute(sa.delete(Event).where(Event.job == number))
            session.execute(sa.delete(Job).where(Job.number == number))

    # Events --------------------------------------------------------------------------------------------------------

    def events(self, number: int, after: int = 0) -> list[Event]:
        """What happened to a job after event ``after``."""
        query = sa.select(Event).where(Event.job == number, Event.seq > after).order_by(Event.seq)
        with self._reading() as session:
            return list(session.scalars(query))

    # Sums ----------------------------------------------------------------------------------------------------------

    def counts(self) -> dict[State, int]:
        """Jobs in each state."""
        with self._reading() as session:
            rows = session.execute(sa.select(Job.state, sa.func.count()).group_by(Job.state)).all()
        found = {State(state): count for state, count in rows}
        return {state: found.get(state, 0) for state in State}

    def active_of(self, owner: str) -> int:
        """Jobs of an owner that wait or run."""
        with self._reading() as session:
            return self._count(session, Job.owner == owner, Job.state.in_(ACTIVE))

    def disk_bytes(self) -> int:
        """What the files of all jobs take."""
        with self._reading() as session:
            return int(session.scalar(sa.select(sa.func.coalesce(sa.func.sum(Job.disk_bytes), 0))) or 0)

    def rates(self, preset: str, evaluate: bool, limit: int = 21) -> list[float]:
        """Seconds per Gaussian of the latest jobs of a preset, with or without evaluation."""
        kind = Job.preset == preset, Job.evaluate == evaluate, Job.state == State.SUCCEEDED
        query = sa.select(Job.finished_at - Job.started_at, Job.gaussians).where(*kind)
        with self._reading() as session:
            latest = session.execute(query.order_by(Job.number.desc()).limit(5 * limit)).all()
        # Of small scenes, most of the time is the process' own.
        return [spent / count for spent, count in latest if spent and count >= 10_000][:limit]

    def ids(self, *states: State) -> set[str]:
        """The ids of all jobs in ``states``; without any, of all jobs."""
        with self._reading() as session:
            return set(session.scalars(sa.select(Job.id).where(Job.state.in_(states or tuple(State)))))

    def due(self, states: Iterable[State], before: float, limit: int = 200) -> list[tuple[int, str]]:
        """Number and id of some jobs in ``states`` that expire before a time."""
        query = sa.select(Job.number, Job.id).where(Job.state.in_(tuple(states)), Job.expires_at < before)
        with self._reading() as session:
            return [(number, job_id) for number, job_id in session.execute(query.limit(limit))]

    def reclaimable(self, limit: int = 50) -> list[tuple[int, str]]:
        """Number and id of some ended jobs that have something to give up, oldest first."""
        query = sa.select(Job.number, Job.id).where(Job.reclaimable_bytes > 0, Job.state.in_(ENDED))
        with self._reading() as session:
            return [(number, job_id) for number, job_id in session.execute(query.order_by(Job.number).limit(limit))]

    def reclaimable_bytes(self) -> int:
        """What ended jobs could give up."""
        query = sa.select(sa.func.coalesce(sa.func.sum(Job.reclaimable_bytes), 0)).where(Job.reclaimable_bytes > 0)
        with self._reading() as session:
            return int(session.scalar(query.where(Job.state.in_(ENDED))) or 0)

    def waiting(self) -> int:
        """Jobs in the queue."""
        with self._reading() as session:
            return self._count(session, Job.state == State.QUEUED)

    # The clock -----------------------------------------------------------------------------------------------------

    def latest_time(self) -> float:
        """What :meth:`heartbeat` has written last."""
        return self.fact("time") or 0.0

    def heartbeat(self) -> None:
        """Write down the time, and see that the database can be written to."""
        with self._write() as session:
            session.merge(Meta(name="time", value=self.clock()))

    @staticmethod
    def _count(session: Session, *where: sa.ColumnElement[bool]) -> int:
        return session.scalar(sa.select(sa.func.count()).select_from(Job).where(*where)) or 0


def _note(session: Session, job: Job, kind: str, data: dict[str, Any]) -> None:
    job.last_event = (job.last_event or 0) + 1
    session.add(Event(job=job.number, seq=job.last_event, kind=kind, data=data))
