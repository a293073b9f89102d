"""Starts that are lost, or not possible now. Oracle: the outcomes, the log, and the times that the guide states."""

import asyncio
import logging
from concurrent.futures import Future

import pytest
from helpers.data_folders import add_a_job, service

from kissgs.runners import NOT_STARTED, Outcome, Resources, RunHandle
from service.core.models import State
from service.core.settings import ServiceSettings
from service.jobs import worker as worker_module
from service.jobs.process import JobProcess, JobRunners, postponed

pytestmark = pytest.mark.usefixtures("no_variables")

TASK = {"function": "job_process:compress", "folder": "/jobs/1", "files": [], "source": "scene.ply", "work": "work-1"}
TASK["settings"] = {"preset": "fast"}
TRAINING = {**TASK, "settings": {"preset": "fast", "finetune": {"enabled": True}}}
LOST = Outcome("lost", code="crashed", message="the machine was lost")


class Cluster:
    """A runner whose items all have one outcome, and whose state a test chooses; ``None`` stands for no problem."""

    nodes = ()

    def __init__(self, outcome=None, problem=None, largest=None):
        self.outcome, self.problem, self.largest = outcome, problem, largest

    def submit(self, item, progress):
        future = Future()
        future.set_result(self.outcome)
        return RunHandle("1", future)

    def cancel(self, item_id):
        pass

    def health_problem(self):
        return self.problem

    def refusal(self, resources):
        fits = self.largest is not None and resources.fits(self.largest)
        return self.problem or (None if fits else f"no node has {resources}")


async def ignore(stage, fraction, note):
    pass


def outcome_on(cluster, task, local=None, **settings):
    runners = JobRunners(ServiceSettings(job_threads=1, **settings), cluster, local or Cluster())
    return asyncio.run(JobProcess(runners).run(task, ignore))


MESSAGE = "the machine secret-7 cannot use the folder of the work: no such file"


def test_a_node_that_cannot_work_loses_the_start_and_is_named_in_the_log_only(caplog):
    cluster = Cluster(Outcome("error", code="node-unusable", message=MESSAGE, node="10.0.0.7"))
    outcome = outcome_on(cluster, TASK)
    assert (outcome.kind, outcome.code) == ("lost", "internal")
    assert "secret-7" not in outcome.message
    assert f"a job could not run on 10.0.0.7: {MESSAGE}" in caplog.text


def test_on_this_machine_another_start_would_meet_the_same():
    cluster = Cluster(Outcome("error", code="node-unusable", message=MESSAGE))
    outcome = outcome_on(cluster, TASK, local=cluster)
    assert (outcome.kind, outcome.code) == ("error", "output")
    assert "secret-7" not in outcome.message


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
    outcome = outcome_on(Cluster(Outcome("done"), problem, largest), TRAINING, job_gpus=1)
    assert outcome.code == expected
    assert outcome.kind == {"unsupported": "error", "": "done"}.get(expected, "lost")


@pytest.fixture
def context(tmp_path):
    with service(tmp_path / "data") as it:
        yield it


def run(context, job, kind, meanwhile=None):
    """Run a job whose start has this outcome at once; return the seconds until that is recorded."""

    async def follow(job, process):
        return kind

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
    monkeypatch.setattr(worker_module, "LOST_SECONDS", 0.2)
    job_id, pauses = add_a_job(context), []
    for start in range(1, context.settings.job_starts + 1):
        job = context.store.claim()
        assert job.starts == start
        pauses.append(run(context, job, LOST))
    assert context.store.get(job_id).state == State.FAILED
    assert all(pause >= 0.2 * 2**start for start, pause in enumerate(pauses[:-1]))


def test_stopping_ends_the_pause(context, monkeypatch):
    monkeypatch.setattr(worker_module, "LOST_SECONDS", 3600.0)
    monkeypatch.setattr(worker_module, "MOST_LOST_SECONDS", 3600.0)
    job_id = add_a_job(context)
    run(context, context.store.claim(), LOST, context.worker.drain)
    assert context.store.get(job_id).state == State.QUEUED


def test_a_cancelled_job_does_not_pause(context, monkeypatch):
    monkeypatch.setattr(worker_module, "LOST_SECONDS", 3600.0)
    monkeypatch.setattr(worker_module, "MOST_LOST_SECONDS", 3600.0)
    job_id = add_a_job(context)
    job = context.store.claim()

    async def cancel():
        context.worker._processes[job_id].ended.set()  # as after its end
        await context.worker.cancel(job)

    run(context, job, LOST, cancel)
    assert context.store.get(job_id).state == State.CANCELLED
    assert not (context.storage.jobs / job_id).exists()


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


def test_a_reason_of_the_runner_reaches_the_worker():
    outcome = outcome_on(Cluster(Outcome("lost", code="not-started", message="no more processes")), TASK)
    assert outcome == postponed("no more processes")
