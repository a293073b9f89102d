"""How starts of jobs are recorded when the database fails in between. Oracle: what one undisturbed record leaves."""

import pytest
from helpers.data_folders import add_a_job, service
from sqlalchemy.exc import OperationalError

from kissgs.runners import Outcome
from service.core.models import State
from service.jobs.process import postponed
from service.storage.job_records import Store

pytestmark = pytest.mark.usefixtures("no_variables")

SUMMARY = {"count": 3, "seconds": {"total": 1.0}, "cpu_seconds": 1.0, "container": {"bytes": 2}, "files": {}}
DONE = Outcome("done", SUMMARY)


@pytest.fixture
def context(tmp_path):
    with service(tmp_path / "data") as it:
        yield it


@pytest.fixture
def record(context):
    """``record(job, outcome, work)`` records how a start ended."""
    return lambda job, outcome, work: context.worker.completion.record(job, outcome, work, False)


def start(context):
    """Start the next job; return it and its work folder, with a result in it."""
    job = context.store.claim()
    work = context.storage.new_work(job.id)
    (work / "result").mkdir()
    (work / "result" / "scene.zip").write_bytes(b"PK")
    return job, work


def fail_after_the_next_change(monkeypatch, before=lambda: None):
    """Let the next change of a job's state take effect, but fail; ``before`` that, another worker acts."""
    move = Store.move

    def moved(self, *arguments, **values):
        move(self, *arguments, **values)
        monkeypatch.setattr(Store, "move", move)
        before()
        raise OperationalError("x", None, Exception("the connection was lost"))

    monkeypatch.setattr(Store, "move", moved)


@pytest.mark.parametrize("outcome", [Outcome("lost", code="crashed"), postponed()], ids=["lost", "postponed"])
def test_a_repeated_record_does_not_touch_the_next_start(context, record, monkeypatch, outcome):
    job_id, others = add_a_job(context), []
    first, work = start(context)
    fail_after_the_next_change(monkeypatch, lambda: others.extend(start(context)))
    with pytest.raises(OperationalError):
        record(first, outcome, work)
    record(first, outcome, work)
    second, its_work = others
    now = context.store.get(job_id)
    assert (now.state, now.starts, now.started_at) == (State.RUNNING, second.starts, second.started_at)
    assert context.store.claim() is None
    assert list((context.storage.jobs / job_id).glob("work-*")) == [its_work]


def test_a_repeated_record_of_success_keeps_the_result(context, record, monkeypatch):
    job_id = add_a_job(context)
    job, work = start(context)
    (context.storage.jobs / job_id / "checkpoint.npz").touch()
    fail_after_the_next_change(monkeypatch)
    with pytest.raises(OperationalError):
        record(job, DONE, work)
    record(job, DONE, work)
    assert context.store.get(job_id).result == SUMMARY
    assert sorted(path.name for path in (context.storage.jobs / job_id).iterdir()) == ["result", "scene.ply"]


def test_the_result_of_a_job_that_is_cancelled_at_the_same_moment_is_removed(context, record, monkeypatch):
    job_id = add_a_job(context)
    job, work = start(context)
    keep = context.storage.keep_result

    def cancelled_meanwhile(*arguments):
        context.store.move(job.number, State.CANCELLED)
        keep(*arguments)

    monkeypatch.setattr(context.storage, "keep_result", cancelled_meanwhile)
    record(job, DONE, work)
    assert context.store.get(job_id).state == State.CANCELLED
    assert not (context.storage.jobs / job_id).exists()


def test_a_repeated_record_of_failure_removes_the_files(context, record, monkeypatch):
    job_id = add_a_job(context)
    job, work = start(context)
    fail_after_the_next_change(monkeypatch)
    error = Outcome("error", code="time-limit", message="the job took too long")
    with pytest.raises(OperationalError):
        record(job, error, work)
    record(job, error, work)
    assert context.store.get(job_id).state == State.FAILED
    assert not (context.storage.jobs / job_id).exists()
