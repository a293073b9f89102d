"""Starts with an older, damaged or missing database or data folder; oracle: the files before."""

import hashlib
import json
import shutil

import pytest
from helpers.data_folders import add_a_job, database, listing, opened, service

import kissgs
from service.core.models import State
from service.core.schemas import JobOptions
from service.core.settings import SettingsError
from service.http.routes.common import job_status
from service.jobs.admission import Queue

pytestmark = pytest.mark.usefixtures("no_variables")


def write_result(context, job_id, folder=None):
    """Write a result as a job process does."""
    folder = folder or context.storage.result(job_id)
    (folder / "files").mkdir(parents=True)
    contents = {"scene.zip": b"PK", "report.json": b"{}", "files/meta.json": b"{} "}
    for name, content in contents.items():
        (folder / name).write_bytes(content)
    entries = {name: {"bytes": len(c), "sha256": hashlib.sha256(c).hexdigest()} for name, c in contents.items()}
    summary = {
        "container": entries["scene.zip"], "report": entries["report.json"],
        "files": {"meta.json": {**entries["files/meta.json"], "stored": 3}},
        "count": 3, "seconds": {"total": 1.0}, "cpu_seconds": 1.0,
    }  # fmt: skip
    (folder / "summary.json").write_text(json.dumps(summary))
    return summary


def state_of(context, job_id):
    return context.store.get(job_id).state


@pytest.fixture
def two_jobs(tmp_path):
    """Data folder with a queued and a running job, in this order."""
    with service(tmp_path / "data") as context:
        first, second = add_a_job(context), add_a_job(context)
        context.store.claim()
    return tmp_path / "data", second, first


def read_again(options, tmp_path):
    """Return the settings of a job with these stored options, as its status shows them and as it would start."""
    with service(tmp_path / "data") as context:
        job_id = add_a_job(context)
    change = f"preset = '{options['preset']}', options = '{json.dumps(options)}'"
    database(tmp_path / "data", f"UPDATE jobs SET {change}")
    with service(tmp_path / "data") as context:
        job = context.store.get(job_id)
        found = job_status(job, Queue(context.store, 1)).options
        task = context.worker._task(job, str(context.storage.upload(job_id)), tmp_path)
    return found, kissgs.Settings.model_validate(task["settings"])


def test_options_that_an_older_version_accepted_are_kept(tmp_path):
    """Regression: a job whose values belong to the preset now had no status, and could not start."""
    options = {"preset": "fast", "encode": {"seed": 3, "sh_step": 1.0}, "compact": {"seed": 0}}
    for settings in read_again(options, tmp_path):
        assert (settings.encode.seed, settings.encode.sh_step, settings.compact.seed) == (3, 1.0, 0)


@pytest.mark.parametrize("preset", ["balanced", "small"])
def test_options_with_values_that_are_gone_are_kept_without_them(tmp_path, preset):
    """Regression: a job with a value that was removed from the presets, or changed, failed the list of all jobs."""
    options = JobOptions(encode={"seed": 3}).model_dump(mode="json") | {"preset": preset}
    options["compact"] |= {"means_lr_scale": 1.0, "refine_steps": 5000}
    for settings in read_again(options, tmp_path):
        assert (settings.preset, settings.encode.seed, settings.compact.refine_steps) == ("balanced", 3, 5000)


@pytest.mark.parametrize("upload", ["kept", "gone"])
@pytest.mark.parametrize("state", ["waiting", "running"])
def test_a_result_without_a_record_is_recovered(tmp_path, state, upload, caplog):
    """The database is a restored copy, made before the job ran, or the service was killed just before the record."""
    folder = tmp_path / "data"
    with service(folder) as context:
        ours, other = add_a_job(context), add_a_job(context)
        if state == "running":
            assert context.store.claim().id == ours
        summary = write_result(context, ours)
        if upload == "gone":
            context.storage.upload(ours).unlink()
    before = listing(folder / "jobs" / ours)
    with service(folder) as context:
        job = context.store.get(ours)
        assert (job.state, job.result, job.upload_kept) == (State.SUCCEEDED, summary, upload == "kept")
        assert state_of(context, other) == State.QUEUED
        events = [event.data["state"] for event in context.store.events(job.number)]
        assert events == ["queued", "running", "succeeded"]
    assert listing(folder / "jobs" / ours) == before
    assert "after -" not in caplog.text


def test_a_job_during_which_the_service_ends_fails_after_its_last_start(tmp_path):
    """The job may be what kills the service."""
    with service(tmp_path / "data") as context:
        job_id, most = add_a_job(context), context.settings.job_starts
    for start in range(most):
        with service(tmp_path / "data") as context:
            assert (state_of(context, job_id), context.store.get(job_id).starts) == (State.QUEUED, start)
            context.store.claim()
    with service(tmp_path / "data") as context:
        job = context.store.get(job_id)
        assert (job.state, job.problem["code"]) == (State.FAILED, "crashed")
        assert f"ended {most} times while the job ran" in job.problem["detail"]


@pytest.mark.parametrize("change", ["emptied", "moved away", "of other jobs"])
def test_folders_of_all_active_jobs_are_missing(two_jobs, change):
    folder, waiting, running = two_jobs
    (folder / "jobs").rename(folder / "away")
    if change != "moved away":
        (folder / "jobs").mkdir()
    if change == "of other jobs":
        (folder / "jobs" / ("0" * 32)).mkdir()
    for _ in range(2):
        with pytest.raises(SettingsError, match=r"has none of the 2 jobs that are queued or running") as caught:
            opened(folder)
        assert "\n" not in str(caught.value)
    if change == "moved away":
        (folder / "jobs").rmdir()
    else:
        shutil.rmtree(folder / "jobs")
    (folder / "away").rename(folder / "jobs")
    with service(folder) as context:
        assert state_of(context, waiting) == state_of(context, running) == State.QUEUED


def test_a_start_without_the_folders_of_all_active_jobs(two_jobs):
    """The message describes how."""
    folder, *jobs = two_jobs
    shutil.rmtree(folder / "jobs")
    with pytest.raises(SettingsError) as caught:
        opened(folder)
    named = str(caught.value).split("create the empty folder ")[1].split(" ")[0]
    assert named == str(folder / "jobs" / min(jobs))
    (folder / "jobs" / min(jobs)).mkdir()
    with service(folder) as context:
        assert [state_of(context, job) for job in jobs] == [State.FAILED] * 2
        assert list((folder / "jobs").iterdir()) == []


def test_a_job_without_its_upload_keeps_its_folder(two_jobs, caplog):
    caplog.set_level("INFO")
    folder, waiting, running = two_jobs
    for job in (waiting, running):
        (folder / "jobs" / job / "scene.ply").unlink()
        (folder / "jobs" / job / "result").mkdir()
        (folder / "jobs" / job / "result" / "scene.zip").write_bytes(b"PK")
    before = listing(folder / "jobs")
    for _ in range(2):
        with service(folder) as context:
            for job in (waiting, running):
                assert state_of(context, job) == State.FAILED
                assert "no longer on the server's disk" in context.store.get(job).problem["detail"]
        assert listing(folder / "jobs" / ".orphaned") == before
    assert caplog.text.count("has lost its upload and was moved to") == 2
    assert f"job {waiting} failed before it was started" in caplog.text


def test_a_result_of_a_job_that_failed_is_kept(two_jobs):
    folder, waiting, running = two_jobs
    with service(folder) as context:
        write_result(context, running)
        context.store.move(context.store.get(running).number, State.FAILED)
        context.store.move(context.store.get(waiting).number, State.FAILED)
    before = listing(folder / "jobs" / running)
    with service(folder):
        assert listing(folder / "jobs" / ".orphaned" / running) == before
        assert not (folder / "jobs" / waiting).exists()  # without a result, the folder is removed


DAMAGES = {
    "cut off": lambda result: (result / "summary.json").write_text('{"container": {"by'),
    "a list": lambda result: (result / "summary.json").write_text("[]"),
    "no object in it": lambda result: (result / "summary.json").write_text('{"container": 3, "files": []}'),
    "no text": lambda result: (result / "summary.json").write_bytes(b"\xff\xfe\0"),
    "nested": lambda result: (result / "summary.json").write_text("[" * 100_000),
    "a folder": lambda result: ((result / "summary.json").unlink(), (result / "summary.json").mkdir()),
    "not there": lambda result: (result / "summary.json").unlink(),
    "a container cut off": lambda result: (result / "scene.zip").write_bytes(b"P"),
    "a file gone": lambda result: (result / "files" / "meta.json").unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("state", ["waiting", "running"])
@pytest.mark.quick(4)
def test_a_damaged_result(two_jobs, damage, state, caplog):
    """The job runs again, and its new result replaces the damaged one."""
    folder, waiting, running = two_jobs
    job = waiting if state == "waiting" else running
    with service(folder) as context:
        write_result(context, job)
        context.store.claim()
    DAMAGES[damage](folder / "jobs" / job / "result")
    with service(folder) as context:
        assert state_of(context, job) == State.QUEUED
        assert f"job {job}: its result is damaged" in caplog.text
        (context.storage.new_work(job) / "result").mkdir()  # of a former start, and not complete
        work = context.storage.new_work(job)
        summary = write_result(context, job, work / "result")
        context.storage.keep_result(job, work)
        context.storage.keep_result(job, work)  # repeated if the end could not be recorded
        context.storage.remove_work(job)
        assert sorted(path.name for path in (folder / "jobs" / job).iterdir()) == ["result", "scene.ply"]
        assert json.loads((context.storage.result(job) / "summary.json").read_text()) == summary


def test_a_missing_result(two_jobs):
    folder, waiting, _ = two_jobs
    with service(folder) as context, pytest.raises(FileNotFoundError, match="its result is missing"):
        context.storage.keep_result(waiting, folder / "jobs" / waiting)
