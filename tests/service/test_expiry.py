"""Jobs that expire, and clocks that jump; oracle: the settings, and the times of the jobs."""

import asyncio
import time

import pytest
from helpers.data_folders import add_a_job, opened
from helpers.running import wait_until
from helpers.service import SMALL, problem
from helpers.thread_runner import ThreadRunner

import kissgs
from service.core.models import State
from service.jobs.upkeep import ExpiryTask


@pytest.mark.quick(0)
def test_expiry(start):
    expected = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()  # before the job's time runs
    service = start(KISSGS_KEEP_SECONDS=3, sweep_seconds=0.2)
    job = service.ended(service.submit())
    assert service.only_result(job) == expected
    wait_until(lambda: service.status(job)["state"] == "expired")
    problem(service.http.get(f"/v1/jobs/{job['id']}/result"), 410, "gone")
    wait_until(lambda: not (service.folder / "jobs" / job["id"]).exists())  # removed after this is recorded
    assert list((service.folder / "jobs").iterdir()) == []
    wait_until(lambda: service.http.get(f"/v1/jobs/{job['id']}").status_code == 404)  # deleted after as long again


def test_clock_jumps(tmp_path, monkeypatch):
    """A jump of the clock by a year neither expires jobs early nor makes durations negative."""
    monkeypatch.setattr(kissgs.runners, "LocalRunner", ThreadRunner)
    context = opened(tmp_path / "data")
    job_id = add_a_job(context, SMALL)
    real = time.time
    for jump in (365 * 86400, -365 * 86400):
        monkeypatch.setattr(time, "time", lambda jump=jump: real() + jump)
        asyncio.run(run_one(context))
        ExpiryTask(context, 0.0).sweep()
        found = context.store.get(job_id)
        assert found.state == State.SUCCEEDED
        assert 0 <= found.finished_at - found.started_at < 60
        assert 0 <= found.started_at - found.created_at < 60
    context.close()
    restarted = opened(tmp_path / "data")  # a year back: the time continues
    assert 0 <= restarted.clock() - found.finished_at < 60
    restarted.close()


async def run_one(context):
    context.worker.start()
    for _ in range(600):
        await asyncio.sleep(0.05)
        if not context.store.counts()["queued"] and not context.store.counts()["running"]:
            break
    context.worker.draining = True
    await context.worker.drain()
    context.worker.draining = False
