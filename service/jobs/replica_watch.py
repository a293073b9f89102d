"""``ReplicaWatch``: what a replica does for and about the others: news of jobs, heartbeats, and clearing up."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError

from ..core.formats import container_file
from ..core.models import ACTIVE, Job, State
from ..core.notifier import ended
from ..storage.database_health import error_text
from ..storage.database_lease import HEARTBEAT_SECONDS
from ..storage.job_storage import RESULT
from ..storage.replicas import LapseObserver
from .completion import result_folder
from .container import ServiceContainer
from .worker import QUEUE

log = logging.getLogger("kissgs.service")

POLL_SECONDS = 0.4
"""Seconds between two readings of the jobs that clients of this replica follow, or that it runs."""


@dataclass
class ReplicaWatch:
    """Background tasks of a replica.

    Attributes:
        context: the parts of the service.
    """

    context: ServiceContainer
    _observer: LapseObserver = field(default_factory=LapseObserver)
    _seen: dict[str, tuple[State, int]] = field(default_factory=dict)

    def recover(self) -> None:
        """Clear up after replicas that have died; call it before jobs are accepted or started."""
        store, storage = self.context.store, self.context.storage
        self._bury()
        self.clear_up()
        storage.set_aside_unknown(lambda: store.ids() | store.claimed_ids())

    # News of jobs ---------------------------------------------------------------------------------------------------

    async def follow(self) -> None:
        """Notify local subscribers of what other replicas do, and end processes of cancelled jobs, until cancelled."""
        while True:
            await asyncio.sleep(POLL_SECONDS)
            try:
                await self._poll()
            except SQLAlchemyError:  # /readyz and the worker report it
                continue
            except Exception:
                log.exception("jobs of other replicas could not be followed; trying again")

    async def _poll(self) -> None:
        notifier, worker = self.context.notifier, self.context.worker
        running = worker.running_ids()
        watched = notifier.job_ids() | running
        found = await run_sync(self.context.store.states, watched) if watched else {}
        for job_id in watched:
            state = found.get(job_id)
            if state is None or state[0] not in ACTIVE:
                notifier.notify(ended(job_id))
            if state is None or state != self._seen.get(job_id):
                notifier.notify(job_id)
            if job_id in running and (state is None or state[0] != State.RUNNING):
                worker.kill(job_id)
        self._seen = found

    # Heartbeats -----------------------------------------------------------------------------------------------------

    async def heartbeat(self) -> None:
        """Show that this replica lives, and clear up after those that have died, until cancelled."""
        limiter = CapacityLimiter(1)  # transfers of files must not delay it
        while True:
            await asyncio.sleep(HEARTBEAT_SECONDS)
            try:
                if await run_sync(self.context.store.is_lapsed, limiter=limiter):
                    await self._join_again()
                await run_sync(self.context.store.heartbeat, limiter=limiter)
                await run_sync(self._bury, limiter=limiter)
                await run_sync(self.clear_up)
                self.context.notifier.notify(QUEUE)
            except (SQLAlchemyError, OSError) as error:  # /readyz and the worker report it
                log.debug("no heartbeat: %s", error_text(error))
            except Exception:
                log.exception("the replicas could not be watched; trying again")

    async def _join_again(self) -> None:
        log.warning("another replica took this one for dead and has queued its jobs again; it ends them and joins anew")
        await self.context.worker.abandon()
        self.context.storage.replica = await run_sync(self.context.store.join)
        self._observer = LapseObserver()

    def _bury(self) -> None:
        """Remove the rows of dead replicas; the first time, only of those whose process has ended on this machine."""
        rows = self.context.store.other_replicas()
        found = self._observer.lapsed(rows)
        buried = sum(self.context.store.bury(row) for row in found)
        if buried:
            log.warning("replicas that have died: %d; their jobs are queued again", buried)

    # Clearing up ----------------------------------------------------------------------------------------------------

    def clear_up(self) -> None:
        """Queue the jobs of dead replicas again, and remove what they have left in the storage."""
        for job_id, replica in self.context.store.claims_of_the_dead():
            job = self.context.store.get(job_id)
            if job is not None and job.state == State.RUNNING:
                self._continue(job, replica)
            elif self._remove_rest(job, job_id, replica):
                self.context.store.drop_claim(job_id, replica)

    def _continue(self, job: Job, replica: str) -> None:
        """Queue a job that a dead replica ran again; if a result of it is complete, record that."""
        store, storage, completion = self.context.store, self.context.storage, self.context.worker.completion
        for folder in self._results_of(job.id, replica):
            summary = storage.read_result(job.id, folder, container_file(job.options).name)
            if summary is not None:
                completion.succeed(job, summary, folder, dead=replica)
                return
            storage.remove_result(job.id, folder)
        if job.starts >= self.context.settings.job_starts:
            detail = f"the service was ended {job.starts} times while the job ran; submit a scene with fewer Gaussians"
            completion.fail(job, "crashed", detail, dead=replica)
        elif store.move(job.number, State.QUEUED, dead=replica):
            log.warning("job %s is queued again, because its replica has died", job.id)

    def _remove_rest(self, job: Job | None, job_id: str, replica: str) -> bool:
        """Remove files of a job that is not running, but for its upload and its result; return whether that is done."""
        storage = self.context.storage
        if job is None or job.state not in (*ACTIVE, State.SUCCEEDED):
            return storage.remove_job(job_id)
        if job.state == State.SUCCEEDED:  # its replica may have died before it had removed what is not needed any more
            self.context.worker.completion.settle(job, result_folder(job), keep_upload=job.upload_kept)
            return True
        for folder in self._results_of(job_id, replica):
            storage.remove_result(job_id, folder)
        return True

    def _results_of(self, job_id: str, replica: str) -> list[str]:
        """Return the names of the folders of a job's results that were made for a replica."""
        found = self.context.storage.result_folders(job_id)
        return [folder for folder in found if folder.startswith(f"{RESULT}-{replica}-")]
