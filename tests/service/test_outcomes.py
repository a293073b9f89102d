"""How starts of jobs are recorded when the database fails in between, or another replica does the same.

Oracle: the rows and the files that a single undisturbed record leaves.
"""

from types import SimpleNamespace

import pytest
from helpers.data_folders import add_a_job, service
from sqlalchemy.exc import OperationalError

from service.core.models import State
from service.jobs.completion import JobCompletion
from service.jobs.runner import Outcome
from service.jobs.workplace import workplace
from service.storage.job_records import Store

pytestmark = pytest.mark.usefixtures("no_variables")

FOLDER = "result-dead-1234"
SUMMARY = {"count": 3, "seconds": {"total": 1.0}, "cpu_seconds": 1.0, "container": {"bytes": 2}, "files": {}}
LOST = Outcome("lost", {"code": "crashed", "detail": "the machine was lost"})


class Shared:
    """Stand-in for the storage of replicas: it records what is removed."""

    shared = True

    def __init__(self):
        self.removed, self.settled = [], []

    def upload_name(self, job_id):
        return "scene.ply"

    def job_bytes(self, job_id):
        return 1

    def settle(self, job_id, folder, *, keep_upload):
        self.settled.append((folder, keep_upload))

    def remove_result(self, job_id, folder):
        self.removed.append(folder)


@pytest.fixture
def context(tmp_path):
    with service(tmp_path / "data") as it:
        yield it


def completion_of(context):
    settings = SimpleNamespace(keep_uploads=True, keep_seconds=100)
    return JobCompletion(settings, context.store, Shared(), context.metrics, context.clock)


def test_the_result_that_another_replica_has_recorded_stays(context):
    """Two replicas clear up after the same dead one."""
    add_a_job(context)
    job, completion = context.store.claim(), completion_of(context)
    for _ in range(2):
        completion.succeed(job, SUMMARY, FOLDER)
    assert context.store.get(job.id).result == {**SUMMARY, "folder": FOLDER}
    assert completion.storage.removed == []
    completion.succeed(job, SUMMARY, "result-other-1")
    assert completion.storage.removed == ["result-other-1"]


def test_the_result_of_a_cancelled_job_is_removed(context):
    add_a_job(context)
    job, completion = context.store.claim(), completion_of(context)
    context.store.move(job.number, State.CANCELLED)
    completion.succeed(job, SUMMARY, FOLDER)
    assert completion.storage.removed == [FOLDER]


def failing_look(monkeypatch, before=lambda: None):
    """Let the next look at a job after a change of its state fail, ``before`` which another worker acts."""
    get, move, armed = Store.get, Store.move, []

    def moved(self, *arguments, **values):
        armed.append(True)
        return move(self, *arguments, **values)

    def look(self, *arguments):
        if armed:
            monkeypatch.setattr(Store, "get", get)
            before()
            raise OperationalError("x", None, Exception("the connection was lost"))
        return get(self, *arguments)

    monkeypatch.setattr(Store, "move", moved)
    monkeypatch.setattr(Store, "get", look)


@pytest.mark.parametrize("outcome", [LOST, Outcome("postponed")], ids=lambda outcome: outcome.kind)
def test_a_repeated_record_does_not_touch_the_next_start(context, monkeypatch, outcome):
    job_id = add_a_job(context)
    first, others, recorder = context.store.claim(), [], context.worker._recorder
    place = workplace(context.settings, context.storage, first)
    place.task()

    def start_again():
        others.append(context.store.claim())
        others.append(workplace(context.settings, context.storage, others[0]).task()["work"])

    failing_look(monkeypatch, start_again)
    with pytest.raises(OperationalError):
        recorder.record(first, outcome, place, False)
    recorder.record(first, outcome, place, False)
    second, work = others
    now = context.store.get(job_id)
    assert (now.state, now.starts, now.started_at) == (State.RUNNING, second.starts, second.started_at)
    assert context.store.claim() is None
    assert [str(path) for path in (context.storage.jobs / job_id).glob("work-*")] == [work]


def test_a_repeated_record_of_success_settles_the_files(context, monkeypatch):
    add_a_job(context)
    job, completion = context.store.claim(), completion_of(context)
    place = SimpleNamespace(folder=FOLDER, keep=lambda: None, clear=lambda *, kept: cleared.append(kept))
    recorder, cleared = context.worker._recorder, []
    object.__setattr__(recorder, "completion", completion)
    failing_look(monkeypatch)
    done = Outcome("done", SUMMARY)
    with pytest.raises(OperationalError):
        recorder.record(job, done, place, False)
    assert completion.storage.settled == []
    recorder.record(job, done, place, False)
    assert completion.storage.settled == [(FOLDER, True)]
    assert cleared == [True, True]


def test_a_repeated_record_of_failure_removes_the_files(context, monkeypatch):
    job_id = add_a_job(context)
    job, recorder = context.store.claim(), context.worker._recorder
    place = workplace(context.settings, context.storage, job)
    failing_look(monkeypatch)
    error = Outcome("error", {"code": "time-limit", "detail": "the job took too long"})
    with pytest.raises(OperationalError):
        recorder.record(job, error, place, False)
    recorder.record(job, error, place, False)
    assert context.store.get(job_id).state == State.FAILED
    assert not (context.storage.jobs / job_id).exists()
