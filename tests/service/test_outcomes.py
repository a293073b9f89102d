"""How starts of jobs end. Oracles: the log, the times that the guide states, and what an undisturbed record leaves."""

import asyncio
import logging
from concurrent.futures import Future

import pytest
from helpers.data_folders import add_a_job, service
from sqlalchemy.exc import OperationalError

from kissgs.runners import NOT_STARTED, Outcome, Resources
from service.core.models import State
from service.core.settings import ServiceSettings
from service.jobs import worker as worker_module
from service.jobs.process import JobProcess, JobRunners, postponed
from service.storage.job_records import Store

pytestmark = pytest.mark.usefixtures("no_variables")


@pytest.fixture
def context(tmp_path):
    with service(tmp_path / "data") as it:
        yield it


class Cluster:
    """A runner whose items all have one outcome, and whose state a test chooses; ``None`` stands for no problem."""

    nodes = ()

    def __init__(self, outcome=None, problem=None, largest=None):
        self.outcome, self.problem, self.largest = outcome, problem, largest

    def submit(self, item, progress):
        future = Future()
        future.set_result(self.outcome)
        return future

    def cancel(self, item_id):
        pass

    def health_problem(self):
        return self.problem

    def refusal(self, resources):
        fits = self.largest is not None and resources.fits(self.largest)
        return self.problem or (None if fits else f"no node has {resources}")


async def ignore(stage, fraction, note):
    pass


def outcome_on(cluster, local=None, finetune=False, **settings):
    task = {"function": "job_process:compress", "folder": "/jobs/1", "files": [], "source": "x.ply", "work": "work-1"}
    task["settings"] = {"preset": "fast", "finetune": {"enabled": finetune}}
    runners = JobRunners(ServiceSettings(job_threads=1, **settings))
    runners.runner, runners.local = cluster, local or Cluster()
    return asyncio.run(JobProcess(runners).run(task, ignore))


def test_a_node_that_cannot_work_loses_the_start_and_is_named_in_the_log_only(caplog):
    """Another start on this machine would meet the same."""
    message = "the machine secret-7 cannot use the folder of the work: no such file"
    unusable = Outcome("error", code="node-unusable", message=message, node="10.0.0.7")
    elsewhere = outcome_on(Cluster(unusable))
    here = outcome_on(cluster := Cluster(unusable), local=cluster)
    assert [(each.kind, each.code) for each in (elsewhere, here)] == [("lost", "internal"), ("error", "output")]
    assert "secret-7" not in elsewhere.message + here.message
    assert f"a job could not run on 10.0.0.7: {message}" in caplog.text


@pytest.mark.parametrize(
    ("problem", "largest", "expected"),
    [
        ("the connection to the Ray cluster was lost", None, NOT_STARTED),
        (None, None, NOT_STARTED),  # no node has joined again yet
        (None, Resources(8, 1 << 40), "unsupported"),
        (None, Resources(8, 1 << 40, 1), ""),
    ],
)
def test_training_fails_only_if_the_cluster_answers_and_has_no_gpu(problem, largest, expected):
    outcome = outcome_on(Cluster(Outcome("done"), problem, largest), finetune=True, job_gpus=1)
    assert outcome.code == expected
    assert outcome.kind == {"unsupported": "error", "": "done"}.get(expected, "lost")


def test_a_reason_of_the_runner_reaches_the_worker():
    outcome = outcome_on(Cluster(Outcome("lost", code="not-started", message="no more processes")))
    assert outcome == postponed("no more processes")


LOST = Outcome("lost", code="crashed", message="the machine was lost")


def run(context, job, outcome, meanwhile=None):
    """Run a job whose start has this outcome at once; return the seconds until that is recorded."""

    async def follow(job, process):
        return outcome

    async def measured():
        loop = asyncio.get_running_loop()
        begun = loop.time()
        running = asyncio.create_task(context.worker._run(job))
        if meanwhile is not None:
            await asyncio.sleep(0.05)
            await meanwhile()
        await asyncio.wait_for(running, 60)
        return loop.time() - begun

    context.worker._follow = follow
    return asyncio.run(measured())


def test_the_pause_after_a_lost_start_grows(context, monkeypatch):
    monkeypatch.setattr(worker_module, "LOST_SECONDS", 0.02)
    job_id, pauses = add_a_job(context), []
    for start in range(1, context.settings.job_starts + 1):
        job = context.store.claim()
        assert job.starts == start
        pauses.append(run(context, job, LOST))
    failed = context.store.get(job_id)
    assert (failed.state, failed.problem["code"]) == (State.FAILED, "crashed")
    assert "the machine was lost" in failed.problem["detail"]
    assert all(pause >= 0.02 * 2**start for start, pause in enumerate(pauses[:-1]))


@pytest.mark.parametrize("end", ["a stop", "a cancellation"])
def test_what_ends_the_pause(context, monkeypatch, end):
    monkeypatch.setattr(worker_module, "LOST_SECONDS", 3600.0)
    monkeypatch.setattr(worker_module, "MOST_LOST_SECONDS", 3600.0)
    job_id = add_a_job(context)
    job = context.store.claim()

    async def cancel():
        context.worker._processes[job_id].ended.set()  # as after its end
        await context.worker.cancel(job)

    run(context, job, LOST, cancel if end == "a cancellation" else context.worker.drain)
    cancelled = end == "a cancellation"
    assert context.store.get(job_id).state == (State.CANCELLED if cancelled else State.QUEUED)
    assert (context.storage.jobs / job_id).exists() != cancelled


def test_starts_that_are_not_possible_are_logged_once_and_rarely_tried(context, monkeypatch, caplog):
    caplog.set_level(logging.WARNING)
    pauses = []

    async def rest(seconds, process=None):
        pauses.append(seconds)

    monkeypatch.setattr(context.worker, "_rest", rest)
    reason = postponed("the machine node-7 could not start a process: no space left on device")
    job_id = add_a_job(context)
    for _ in range(5):
        run(context, context.store.claim(), reason)
    assert pauses == [1, 2, 4, 8, 8]
    assert caplog.text.count("could not start a process: no space left on device") == 1
    assert (context.store.get(job_id).state, context.store.get(job_id).starts) == (State.QUEUED, 0)
    run(context, context.store.claim(), Outcome("error", code="time-limit", message="too long"))
    add_a_job(context)
    run(context, context.store.claim(), reason)
    assert pauses[-1] == 1


SUMMARY = {"count": 3, "seconds": {"total": 1.0}, "cpu_seconds": 1.0, "container": {"bytes": 2}, "files": {}}
DONE = Outcome("done", SUMMARY)


@pytest.fixture
def record(context):
    """``record(job, outcome, work)`` records how a start ended."""
    return lambda job, outcome, work: context.completion.record(job, outcome, work, False)


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


def test_a_crash_while_the_service_stops_does_not_count(context):
    """Some supervisors signal the job process, too."""
    job_id = add_a_job(context)
    job, work = start(context)
    context.completion.record(job, Outcome("crashed", code="crashed"), work, True)
    assert (context.store.get(job_id).state, context.store.get(job_id).starts) == (State.QUEUED, 0)


@pytest.mark.parametrize("outcome", [DONE, Outcome("error", code="time-limit", message="the job took too long")])
def test_a_repeated_record_of_an_end(context, record, monkeypatch, outcome):
    job_id = add_a_job(context)
    job, work = start(context)
    (context.storage.jobs / job_id / "checkpoint.npz").touch()
    fail_after_the_next_change(monkeypatch)
    with pytest.raises(OperationalError):
        record(job, outcome, work)
    record(job, outcome, work)
    if outcome is DONE:
        assert context.store.get(job_id).result == SUMMARY
        assert sorted(path.name for path in (context.storage.jobs / job_id).iterdir()) == ["result", "scene.ply"]
    else:
        assert context.store.get(job_id).state == State.FAILED
        assert not (context.storage.jobs / job_id).exists()


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
