"""Reading of the tables of jobs and events, as a part of the job store."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Iterable, Mapping

import sqlalchemy as sa
from sqlalchemy.orm import Session, load_only

from ..core.models import ACTIVE, ENDED, Event, Job, State
from .database import Sessions


class JobQueries:
    """Methods of the job store that only read."""

    _reading: Sessions

    def states(self, job_ids: Iterable[str]) -> dict[str, tuple[State, int]]:
        """Return the state and the number of the last event of jobs, by id; those that do not exist are missing."""
        query = sa.select(Job.id, Job.state, Job.last_event).where(Job.id.in_(list(job_ids)))
        with self._reading() as session:
            return {job_id: (State(state), last) for job_id, state, last in session.execute(query)}

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
        columns = load_only(Job.owner, Job.state, Job.preset, Job.evaluate, Job.gaussians, Job.options, Job.started_at)
        with self._reading() as session:
            return list(session.scalars(sa.select(Job).where(Job.state.in_(ACTIVE)).options(columns)))

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
            return count(session, Job.owner == owner, Job.state.in_(ACTIVE))

    def disk_bytes(self) -> int:
        """Return the disk space of all jobs, bytes."""
        with self._reading() as session:
            return disk_bytes(session)

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
            return count(session, Job.state == State.QUEUED)


def in_turn(queued: Iterable[Job], turns: Mapping[str, int]) -> list[Job]:
    """Return queued jobs in the order in which :meth:`Store.claim` starts them.

    The owners take turns, first the one whose ``turns``, the number of its last start, is the lowest; of one owner, the
    oldest job is first.
    """
    waiting: dict[str, deque[Job]] = {}
    for job in sorted(queued, key=lambda job: job.number):
        waiting.setdefault(job.owner, deque()).append(job)
    heads = [(turns.get(owner, 0), jobs[0].number, owner) for owner, jobs in waiting.items()]
    heapq.heapify(heads)
    order: list[Job] = []
    latest = max(turns.values(), default=0)
    while heads:
        _, _, owner = heapq.heappop(heads)
        order.append(waiting[owner].popleft())
        if waiting[owner]:
            heapq.heappush(heads, (latest + len(order), waiting[owner][0].number, owner))
    return order


def disk_bytes(session: Session) -> int:
    """Return the disk space of all jobs, bytes."""
    return int(session.scalar(sa.select(sa.func.coalesce(sa.func.sum(Job.disk_bytes), 0))) or 0)


def count(session: Session, *where: sa.ColumnElement[bool]) -> int:
    """Return the number of jobs with these properties."""
    return session.scalar(sa.select(sa.func.count()).select_from(Job).where(*where)) or 0
