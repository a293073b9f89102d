"""The heartbeat of a replica, with stand-ins for the store and the storage. Oracle: counts of what was called."""

import asyncio
import threading
import time
from types import SimpleNamespace

import pytest

from kissgs.core.errors import RunnerError
from service.core.settings import ServiceSettings
from service.http import app
from service.jobs import replica_watch
from service.jobs.replica_watch import ReplicaWatch


class Store:
    """A store of a replica that has no others; it counts beats."""

    beats = 0

    def is_lapsed(self):
        return False

    def heartbeat(self):
        self.beats += 1

    def other_replicas(self):
        return []


@pytest.fixture
def watch(monkeypatch):
    monkeypatch.setattr(replica_watch, "HEARTBEAT_SECONDS", 0.01)
    return ReplicaWatch(SimpleNamespace(store=Store(), notifier=SimpleNamespace(notify=lambda name: None)))


async def until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end, "it has not happened in time"
        await asyncio.sleep(0.01)


def test_a_storage_that_hangs_does_not_delay_the_beats(watch, monkeypatch):
    released, calls, at_once = threading.Event(), [], []

    def hang():
        calls.append(True)
        at_once.append(len(calls))
        released.wait(60)
        at_once.append(len(calls))

    async def run():
        beating = asyncio.create_task(watch.heartbeat())
        beats = watch.context.store
        await until(lambda: calls)
        before = beats.beats
        await until(lambda: beats.beats > before + 5)
        assert len(calls) == 1
        released.set()
        await until(lambda: len(calls) > 2)
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)
        ended, names = len(calls), [task.get_coro().__name__ for task in asyncio.all_tasks()]
        await asyncio.sleep(0.05)
        assert len(calls) == ended
        assert names == ["run"]

    monkeypatch.setattr(watch, "clear_up", hang)
    asyncio.run(run())
    assert at_once[:2] == [1, 1]


def test_an_error_while_clearing_up_is_no_end(watch, monkeypatch, caplog):
    calls = []

    def fail():
        calls.append(True)
        raise ValueError("a bug")

    async def run():
        beating = asyncio.create_task(watch.heartbeat())
        await until(lambda: len(calls) > 2)
        beating.cancel()
        await asyncio.gather(beating, return_exceptions=True)

    monkeypatch.setattr(watch, "clear_up", fail)
    asyncio.run(run())
    assert "the replicas could not be watched; trying again" in caplog.text


def test_a_service_that_cannot_reach_its_cluster_has_not_joined(tmp_path, monkeypatch):
    """Connecting takes longer than other replicas wait for a beat."""

    def refuse(settings):
        raise RunnerError("the cluster does not answer")

    monkeypatch.setattr(app.JobRunner, "open", refuse)
    monkeypatch.setattr(app, "open_store", lambda *arguments: pytest.fail("it has joined already"))
    for _ in range(2):  # the data folder is released
        with pytest.raises(RunnerError):
            app.build(ServiceSettings(data_dir=tmp_path / "data"))
