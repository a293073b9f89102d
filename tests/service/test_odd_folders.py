"""Files and links that the service did not create, in place of a job's folder or in it; folders that disappear while
the service runs; jobs that expire. Oracles: the files before, the settings and times of jobs."""

import asyncio
import errno
import os
import shutil
import time
from pathlib import Path

import pytest
from helpers.data_folders import add_a_job, finish_a_job, listing, names, opened, service, swept
from helpers.running import wait_until
from helpers.service import SLOW, SMALL, problem, scene_bytes
from helpers.thread_runner import ThreadRunner

import kissgs
from kissgs.runners import Outcome
from service.core.models import State
from service.http.routes import facts


def a_file(folder, elsewhere):
    shutil.rmtree(folder)
    folder.write_text("mine")


def a_link(folder, elsewhere):
    folder.rename(elsewhere)
    folder.symlink_to(elsewhere)


def a_link_to_nothing(folder, elsewhere):
    shutil.rmtree(folder)
    folder.symlink_to(elsewhere)


CHANGES = [a_file, a_link, a_link_to_nothing]


def assert_orphaned(folder, change, elsewhere, before):
    """Assert that the entry was moved to the orphaned folder, unchanged."""
    assert not os.path.lexists(folder)
    moved = folder.parent / ".orphaned" / folder.name
    assert moved.read_text() == "mine" if change is a_file else moved.is_symlink()
    if change is a_link:
        assert listing(elsewhere) == before


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.usefixtures("no_variables")
def test_expiring(tmp_path, change):
    """Other jobs expire nevertheless."""
    with service(tmp_path / "data") as context:
        jobs = [finish_a_job(context) for _ in range(3)]
        folder = context.storage.jobs / jobs[0]
        before = listing(folder)
        change(folder, tmp_path / "elsewhere")
        context.clock._offset += 10**5
        assert sorted(swept(context)) == sorted(jobs)
        context.clock._offset += 10**5
        swept(context)
        assert context.store.ids() == set()
        assert_orphaned(folder, change, tmp_path / "elsewhere", before)
        assert names(context.storage.jobs) == {".orphaned"}


@pytest.mark.usefixtures("no_variables")
def test_folders_that_cannot_be_removed(tmp_path, monkeypatch, caplog):
    """There is a warning in the log, and other jobs are removed."""
    with service(tmp_path / "data") as context:
        jobs = [finish_a_job(context) for _ in range(3)]

        def refuse(path):
            if path.name == jobs[0]:
                raise PermissionError(errno.EPERM, "Operation not permitted")
            return iter(())

        monkeypatch.setattr(Path, "iterdir", refuse)
        context.clock._offset += 10**5
        assert sorted(swept(context)) == sorted(jobs)
        monkeypatch.undo()
        assert names(context.storage.jobs) == {jobs[0]}
        assert f"job {jobs[0]}: its folder cannot be removed: operation not permitted" in caplog.text


@pytest.mark.usefixtures("no_variables")
def test_links_in_a_folder_are_removed_without_their_targets(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "scene.zip").write_text("mine")
    with service(tmp_path / "data") as context:
        job = finish_a_job(context)
        folder = context.storage.jobs / job
        shutil.rmtree(folder / "result")
        for name in ("result", "work-0123456789abcdef", "decoded.ply"):
            (folder / name).symlink_to(tmp_path / "mine")
        context.storage.remove_job(job)
        assert names(context.storage.jobs) == set()
    assert listing(tmp_path / "mine") == {(tmp_path / "mine" / "scene.zip").relative_to(tmp_path / "mine"): b"mine"}


@pytest.mark.usefixtures("no_variables")
def test_recovery_follows_no_links(tmp_path):
    with service(tmp_path / "data") as context:
        jobs = [finish_a_job(context, State.EXPIRED), finish_a_job(context), add_a_job(context)]
        for job in jobs:
            (context.storage.jobs / job / "work-0123456789abcdef").mkdir()
            (context.storage.jobs / job).rename(tmp_path / job)
            (context.storage.jobs / job).symlink_to(tmp_path / job)
            (tmp_path / job / "work-0123456789abcdef" / "mine").write_text("mine")
    before = [listing(tmp_path / job) for job in jobs]
    with service(tmp_path / "data") as context:
        assert context.store.get(jobs[2]).state == State.QUEUED
        context.storage.discard_checkpoints(jobs[1])
        for path in context.storage.reclaimable_files(jobs[1]):
            context.storage.discard(path)
    assert [listing(tmp_path / job) for job in jobs] == before


@pytest.mark.usefixtures("no_variables")
def test_a_permanent_error_fails_the_job(tmp_path, monkeypatch):
    """A folder that was not empty once blocked its worker for ever."""

    def refuse(job_id, work):
        raise OSError(errno.ENOTEMPTY, "Directory not empty")

    with service(tmp_path / "data") as context:
        add_a_job(context)
        job = context.store.claim()
        monkeypatch.setattr(context.storage, "keep_result", refuse)
        work = context.storage.new_work(job.id)
        asyncio.run(asyncio.wait_for(context.worker._finish(job, Outcome("done", {}), work), 10))
        found = context.store.get(job.id)
        assert (found.state, found.problem["code"]) == (State.FAILED, "output")
        assert found.problem["detail"].endswith("cannot be written: directory not empty; try again later")
        is_permanent = context.completion.is_permanent
        errors = [OSError(number, "") for number in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR, errno.ENOENT)]
        assert [is_permanent(error) for error in (*errors, OSError(errno.ENOSPC, ""))] == [True] * 4 + [False]
        context.storage.jobs.rename(tmp_path / "away")  # which may come back
        assert not any(map(is_permanent, errors))
        (tmp_path / "away").rename(context.storage.jobs)


def test_readiness(start, monkeypatch):
    monkeypatch.setattr(facts, "READY_SECONDS", 0.0)
    it = start()
    for name, replacement in (("jobs", None), ("incoming", "a file"), ("jobs", "another folder")):
        folder = it.folder / name
        folder.rename(it.folder / "away")
        if replacement == "a file":
            folder.write_text("")
        elif replacement == "another folder":
            folder.mkdir()
        ready = it.http.get("/readyz")
        assert (ready.status_code, ready.json()["ready"]) == (503, False)
        reason = "was replaced; restart the service" if replacement else "is missing; restore it"
        assert ready.json()["checks"]["disk"] == f"the data folder cannot be used: its folder {name} {reason}"
        if replacement == "a file":
            folder.unlink()
        (it.folder / "away").rename(folder)  # over an empty folder, too
        assert it.ended(it.submit())["state"] == "succeeded"


def test_a_folder_that_cannot_be_written_to(start):
    it = start()
    if os.geteuid() == 0:
        pytest.skip("root can write to every folder")
    (it.folder / "incoming").chmod(0o500)
    ready = it.http.get("/readyz")
    (it.folder / "incoming").chmod(0o700)
    assert ready.status_code == 503
    assert ready.json()["checks"]["disk"].endswith("its folder incoming is not writable; change its permissions")


@pytest.mark.quick(0)
def test_no_job_fails_while_the_folder_of_jobs_is_missing(start):
    """Running and queued jobs succeed once the folder is back."""
    it = start(processes=True)
    running, waiting = it.submit(scene_bytes(6_000, 2)), [it.submit(), it.submit()]
    it.running(running)
    (it.folder / "jobs").rename(it.folder / "away")
    wait_until(lambda: not it.children(), 300)
    time.sleep(1.5)
    assert it.status(running)["state"] in ("running", "queued")
    assert [it.status(job)["state"] for job in waiting] == ["queued", "queued"]
    problem(it.http.post("/v1/jobs", content=SMALL, params={"options": SLOW}), 507, "disk-full")
    (it.folder / "away").rename(it.folder / "jobs")
    assert [it.ended(job)["state"] for job in (running, *waiting)] == ["succeeded"] * 3
    assert it.http.get("/readyz").status_code == 200


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
    monkeypatch.setattr("service.jobs.process.LocalRunner", ThreadRunner)
    context = opened(tmp_path / "data")
    job_id = add_a_job(context, SMALL)
    real = time.time
    for jump in (365 * 86400, -365 * 86400):
        monkeypatch.setattr(time, "time", lambda jump=jump: real() + jump)
        asyncio.run(run_one(context))
        swept(context)
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
