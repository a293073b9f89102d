"""What stands in the place of a job's folder, or within it, and was not put there by the service; and folders of the
service that go away while it runs. Oracle: what lay there before."""

import asyncio
import errno
import os
import shutil
import time
from pathlib import Path

import pytest
from helpers.data_folders import add_a_job, finish_a_job, listing, names, service
from helpers.service import SLOW, SMALL, problem, scene_bytes

from service.core.models import State
from service.jobs.expiry import ExpiryTask
from service.jobs.runner import Outcome
from service.jobs.worker import Worker


def a_file(folder, elsewhere):
    shutil.rmtree(folder)
    folder.write_text("mine")


def a_link(folder, elsewhere):
    folder.rename(elsewhere)
    folder.symlink_to(elsewhere)


def a_link_to_nothing(folder, elsewhere):
    shutil.rmtree(folder)
    folder.symlink_to(elsewhere)


WAYS = [a_file, a_link, a_link_to_nothing]


def lies_aside(folder, way, elsewhere, before):
    """That nothing was removed, and nothing is left where it stood."""
    assert not os.path.lexists(folder)
    aside = folder.parent / ".orphaned" / folder.name
    assert aside.read_text() == "mine" if way is a_file else aside.is_symlink()
    if way is a_link:
        assert listing(elsewhere) == before


@pytest.mark.parametrize("way", WAYS)
def test_deleting(start, way, tmp_path):
    it = start()
    job = it.ended(it.submit())
    folder = it.folder / "jobs" / job["id"]
    before = listing(folder)
    way(folder, tmp_path / "elsewhere")
    assert it.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    problem(it.http.get(f"/v1/jobs/{job['id']}"), 404, "not-found")
    lies_aside(folder, way, tmp_path / "elsewhere", before)
    assert f"job {job['id']}: its folder is no folder of ours and lies in" in it.log.read_text()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.usefixtures("no_variables")
def test_expiring(tmp_path, way):
    """The others expire all the same."""
    with service(tmp_path / "data") as context:
        jobs = [finish_a_job(context) for _ in range(3)]
        folder = context.storage.jobs / jobs[0]
        before = listing(folder)
        way(folder, tmp_path / "elsewhere")
        context.clock._offset += 10**5
        assert sorted(ExpiryTask(context, 0.0).sweep()) == sorted(jobs)
        context.clock._offset += 10**5
        ExpiryTask(context, 0.0).sweep()
        assert context.store.ids() == set()
        lies_aside(folder, way, tmp_path / "elsewhere", before)
        assert names(context.storage.jobs) == {".orphaned"}


@pytest.mark.usefixtures("no_variables")
def test_what_cannot_be_removed_stays(tmp_path, monkeypatch, caplog):
    """The log says so, and the others go."""
    with service(tmp_path / "data") as context:
        jobs = [finish_a_job(context) for _ in range(3)]

        def refuse(path):
            if path.name == jobs[0]:
                raise PermissionError(errno.EPERM, "Operation not permitted")
            return iter(())

        monkeypatch.setattr(Path, "iterdir", refuse)
        context.clock._offset += 10**5
        assert sorted(ExpiryTask(context, 0.0).sweep()) == sorted(jobs)
        monkeypatch.undo()
        assert names(context.storage.jobs) == {jobs[0]}
        assert f"job {jobs[0]}: its folder cannot be removed: operation not permitted" in caplog.text


@pytest.mark.usefixtures("no_variables")
def test_links_within_a_folder_are_removed_alone(tmp_path):
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
def test_a_start_follows_no_links(tmp_path):
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


# A result that cannot be kept ----------------------------------------------------------------------------------------


@pytest.mark.usefixtures("no_variables")
def test_a_result_that_can_never_be_kept_ends_its_job(tmp_path, monkeypatch):
    """A folder that was not empty once held up its worker for ever."""

    def refuse(job_id):
        raise OSError(errno.ENOTEMPTY, "Directory not empty")

    with service(tmp_path / "data") as context:
        job = context.store.get(add_a_job(context))
        context.store.claim()
        monkeypatch.setattr(context.storage, "keep_result", refuse)
        asyncio.run(asyncio.wait_for(context.worker._settle(job, Outcome("done", {})), 10))
        found = context.store.get(job.id)
        assert (found.state, found.problem["code"]) == (State.FAILED, "output")
        assert found.problem["detail"].endswith("cannot be written: directory not empty; try again later")


@pytest.mark.parametrize("error", [errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR, errno.ENOENT])
def test_which_errors_are_final(tmp_path, monkeypatch, error):
    monkeypatch.setenv("KISSGS_DATA_DIR", str(tmp_path / "data"))
    with service(tmp_path / "data") as context:
        worker: Worker = context.worker
        assert worker._is_final(OSError(error, os.strerror(error)))
        assert not worker._is_final(OSError(errno.ENOSPC, "no space left on device"))
        context.storage.jobs.rename(tmp_path / "away")
        assert not worker._is_final(OSError(error, os.strerror(error)))
        (tmp_path / "away").rename(context.storage.jobs)


# Folders of the service that go away ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["jobs", "incoming"])
@pytest.mark.parametrize("way", ["moved away", "a file", "another folder"])
def test_readiness(start, name, way):
    it = start()
    folder = it.folder / name
    folder.rename(it.folder / "away")
    if way == "a file":
        folder.write_text("")
    if way == "another folder":
        folder.mkdir()
    ready = it.http.get("/readyz")
    assert (ready.status_code, ready.json()["ready"]) == (503, False)
    said = "is not there; put it back" if way == "moved away" else "was replaced; restart the service"
    assert ready.json()["checks"]["disk"] == f"the data folder cannot be used: its folder {name} {said}"
    if way != "moved away":
        folder.unlink() if way == "a file" else folder.rmdir()
    (it.folder / "away").rename(folder)
    assert it.http.get("/readyz").status_code == 200
    assert it.ended(it.submit())["state"] == "succeeded"


def test_a_folder_that_cannot_be_written_to(start):
    it = start()
    if os.geteuid() == 0:
        pytest.skip("root may write to any folder")
    (it.folder / "incoming").chmod(0o500)
    ready = it.http.get("/readyz")
    (it.folder / "incoming").chmod(0o700)
    assert ready.status_code == 503
    assert ready.json()["checks"]["disk"].endswith("its folder incoming cannot be written to")


def test_no_job_fails_because_all_folders_are_away(start):
    """They are done when the folders are back: what runs as well as what waits."""
    it = start()
    running, waiting = it.submit(scene_bytes(6_000, 2)), [it.submit(), it.submit()]
    it.running(running)
    (it.folder / "jobs").rename(it.folder / "away")
    end = time.monotonic() + 60
    while it.children():
        assert time.monotonic() < end
        time.sleep(0.05)
    time.sleep(1.5)
    assert it.status(running)["state"] in ("running", "queued")
    assert [it.status(job)["state"] for job in waiting] == ["queued", "queued"]
    problem(it.http.post("/v1/jobs", content=SMALL, params={"options": SLOW}), 507, "disk-full")
    (it.folder / "away").rename(it.folder / "jobs")
    assert [it.ended(job)["state"] for job in (running, *waiting)] == ["succeeded"] * 3
    assert it.http.get("/readyz").status_code == 200
