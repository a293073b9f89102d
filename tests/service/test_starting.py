"""Starts with the jobs of a data folder, and folders that move to the orphaned one; oracle: the files before."""

import asyncio
import shutil

import pytest
from fastapi import Response
from helpers.data_folders import database, finish_a_job, listing, names, service

from service.core.models import State
from service.http.routes import facts
from service.jobs.upkeep import ExpiryTask

pytestmark = pytest.mark.usefixtures("no_variables")


def test_a_folder_of_an_earlier_version(jobs_folder):
    """It has numbers of the folder and of its owner, in files and in the database."""
    for name in ("identity", "database"):
        (jobs_folder / name).write_text("123\n")
    for name in ("folder", "owner", "owner-process", "owner-machine"):
        database(jobs_folder, f"INSERT INTO meta VALUES ('{name}', 123)")
    with service(jobs_folder) as context:
        assert context.storage.job_ids() == context.store.ids()
        assert context.store.monitor.health_problem() is None
        assert finish_a_job(context) in context.store.ids()


def test_a_start_after_the_jobs_were_moved_away(jobs_folder):
    (jobs_folder / "jobs.sqlite").unlink()
    (jobs_folder / "jobs").rename(jobs_folder / "old")
    with service(jobs_folder):
        pass
    (jobs_folder / "jobs.sqlite").unlink()  # without jobs, a new database is right
    with service(jobs_folder) as context:
        assert context.store.ids() == set()
        assert context.store.monitor.health_problem() is None
        finish_a_job(context)
    with service(jobs_folder) as context:
        assert len(context.store.ids()) == 1
    assert len(list((jobs_folder / "old").iterdir())) == 12


def test_folders_of_unknown_jobs_are_moved(jobs_folder, caplog):
    """The database is an older copy without the latest job."""
    known = names(jobs_folder / "jobs")
    shutil.copy(jobs_folder / "jobs.sqlite", jobs_folder.parent / "old.sqlite")
    with service(jobs_folder) as context:
        job = finish_a_job(context)
    shutil.copytree(jobs_folder / "jobs" / job, jobs_folder / "jobs" / ".orphaned" / job)
    (jobs_folder / "jobs" / ".orphaned" / job / "scene.ply").write_bytes(b"an earlier one")
    shutil.copy(jobs_folder.parent / "old.sqlite", jobs_folder / "jobs.sqlite")
    (jobs_folder / "jobs" / job / "work-0123456789abcdef").mkdir()
    before = listing(jobs_folder / "jobs" / job)
    with service(jobs_folder) as context:
        assert context.storage.job_ids() == known
        assert context.storage.count_orphaned() == 2
    assert listing(jobs_folder / "jobs" / ".orphaned" / f"{job}-2") == before
    assert (jobs_folder / "jobs" / ".orphaned" / job / "scene.ply").read_bytes() == b"an earlier one"
    assert f"that the database does not know were moved to {jobs_folder}/jobs/.orphaned: 1" in caplog.text
    caplog.clear()
    with service(jobs_folder) as context:
        assert context.storage.count_orphaned() == 2
        health = asyncio.run(facts.get_readyz(context, Response()))
        assert health.checks["orphaned"] == "folders without a job in jobs/.orphaned of the data folder: 2"
    assert caplog.text == ""


def test_other_files_are_not_removed(jobs_folder):
    job = min(names(jobs_folder / "jobs"))
    others = ["notes.txt", "incoming/notes.txt", "incoming/x.part", "jobs/notes.txt", "jobs/mine/scene.ply"]
    others += ["work-1/x", "lock", f"jobs/{job}/notes.txt"]
    for name in others:
        (jobs_folder / name).parent.mkdir(exist_ok=True)
        (jobs_folder / name).write_text("mine")
    (jobs_folder / "incoming" / "0123456789abcdef.part").write_text("half an upload")
    (jobs_folder / "jobs" / job / "work-0123456789abcdef").mkdir()
    with service(jobs_folder) as context:
        assert not (jobs_folder / "incoming" / "0123456789abcdef.part").exists()
        assert not (jobs_folder / "jobs" / job / "work-0123456789abcdef").exists()
        assert {name: (jobs_folder / name).read_text() for name in others} == dict.fromkeys(others, "mine")
        context.clock._offset += 10**6
        ExpiryTask(context, 0.0).sweep()
        assert context.storage.job_ids() == set()
    others[-1] = f"jobs/.orphaned/{job}/notes.txt"
    assert {name: (jobs_folder / name).read_text() for name in others} == dict.fromkeys(others, "mine")
    assert names(jobs_folder / "jobs" / ".orphaned" / job) == {"notes.txt"}


def test_an_interrupted_removal_is_completed(tmp_path):
    with service(tmp_path / "data") as context:
        job = finish_a_job(context, State.EXPIRED)
        assert context.storage.job_ids() == {job}
    with service(tmp_path / "data") as context:
        assert (context.storage.job_ids(), context.storage.count_orphaned()) == (set(), 0)


def test_only_jobs_are_removed(jobs_folder):
    with service(jobs_folder) as context:
        for name in ("", "..", ".", "../jobs", ".orphaned", "a/b", "0" * 31):
            with pytest.raises(ValueError, match="not a job id"):
                context.storage.remove_job(name)
