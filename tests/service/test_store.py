"""The job store; oracle: a table of allowed state transitions."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers.data_folders import add_a_row as add

from service.core.models import ENDED, State
from service.jobs.admission import QueueEstimator
from service.storage.job_records import Store

ALLOWED = {
    *itertools.product([State.QUEUED], [State.RUNNING, State.FAILED, State.CANCELLED]),
    *itertools.product([State.RUNNING], [State.QUEUED, State.SUCCEEDED, State.FAILED, State.CANCELLED]),
    *itertools.product(ENDED, [State.EXPIRED]),
}


@pytest.fixture
def store(tmp_path):
    ticks = itertools.count(1000)
    opened = Store(tmp_path / "jobs.sqlite", lambda: float(next(ticks)))
    yield opened
    opened.close()


def set_state(store, number, state):
    """Move a queued job to a state by the shortest path."""
    paths = {
        State.QUEUED: [], State.RUNNING: [State.RUNNING], State.SUCCEEDED: [State.RUNNING, State.SUCCEEDED],
        State.FAILED: [State.FAILED], State.CANCELLED: [State.CANCELLED], State.EXPIRED: [State.FAILED, State.EXPIRED],
    }  # fmt: skip
    for step in paths[state]:
        assert store.move(number, step)


def test_state_transitions(store):
    for before, after in itertools.product(State, State):
        number = add(store, max_queue=99).number
        set_state(store, number, before)
        events, allowed = len(store.events(number)), (before, after) in ALLOWED
        assert store.move(number, after) == allowed, (before, after)
        assert len(store.events(number)) == events + allowed


def test_owners_take_turns(store):
    """One key with many jobs once let all others wait. Oracle: the order written out; positions must agree."""
    jobs = [add(store, owner, max_owner=9) for owner in "aaaaabbc"]
    estimator = QueueEstimator(store, 1)
    positions = sorted(jobs, key=lambda job: estimator.current().position(job))
    started = [store.claim().number]
    after_one = sorted(jobs[1:], key=lambda job: estimator.current().position(job))
    started += [store.claim().number for _ in jobs[1:]]
    order = [1, 6, 8, 2, 7, 3, 4, 5]
    assert [jobs.index(next(job for job in jobs if job.number == number)) + 1 for number in started] == order
    assert [job.number for job in positions] == started
    assert [job.number for job in after_one] == started[1:]
    late = [add(store, owner, max_owner=9) for owner in "abd"]
    assert [store.claim().number for _ in late] == [late[2].number, late[1].number, late[0].number]


def run_together(*calls):
    """Run calls simultaneously and return their results."""
    with ThreadPoolExecutor(len(calls)) as pool:
        return [future.result() for future in [pool.submit(*call) for call in calls]]


def test_jobs_are_claimed_once_and_in_order(store):
    ids = [add(store).id for _ in range(8)]
    claimed = [found.id if found else None for found in run_together(*[(store.claim,)] * 16)]
    assert sorted(filter(None, claimed)) == sorted(ids)
    assert claimed.count(None) == 8
    again = [add(store).id for _ in range(3)]
    assert [store.claim().id for _ in range(3)] == again
    assert store.claim() is None


def test_of_a_cancellation_and_a_result_only_one_takes_effect(store):
    for _ in range(10):
        number = add(store).number
        store.claim()
        moved = run_together((store.move, number, State.SUCCEEDED), (store.move, number, State.CANCELLED))
        assert sorted(moved) == [False, True]


def test_event_numbers_have_no_gaps_with_many_threads(store):
    number = add(store).number
    store.claim()
    run_together(*[(store.progress, number, "order", 0.5)] * 20)
    found = store.events(number)
    assert [event.seq for event in found] == list(range(1, 23))
    assert [event.seq for event in store.events(number, after=20)] == [21, 22]


def test_progress_notes(store):
    found = add(store)
    store.claim()
    store.progress(found.number, "refine", 0.5, "x" * 1000)
    assert store.get(found.id).note == "x" * 200
    store.progress(found.number, "refine", 0.6)
    assert store.get(found.id).note is None
    assert [event.data.get("note") for event in store.events(found.number)] == [None, None, "x" * 200, None]
    store.progress(found.number, "refine", 0.7, "y")
    store.move(found.number, State.QUEUED)
    waiting = store.get(found.id)
    assert (waiting.stage, waiting.fraction, waiting.note) == (None, 0.0, None)


def test_the_expected_end_is_forgotten_when_a_job_starts_again(store):
    found = add(store)
    store.claim()
    store.progress(found.number, "refine", 0.5, "", 12.5)
    assert store.events(found.number)[-1].data == {"stage": "refine", "fraction": 0.5, "seconds_left": 12.5}
    assert store.ends == pytest.approx({found.number: store.clock() + 12.5}, abs=2)
    store.move(found.number, State.QUEUED)
    assert store.ends == {}


def test_work_bytes_count_while_a_job_runs(store):
    number = add(store, upload_bytes=100, disk_bytes=100, work_bytes=600).number
    assert store.disk_bytes() == 100
    store.claim()
    assert store.disk_bytes() == 700
    store.move(number, State.QUEUED)
    assert store.disk_bytes() == 700  # its checkpoints are kept
    store.claim()
    store.move(number, State.SUCCEEDED, disk_bytes=120)
    assert store.disk_bytes() == 120


def test_queries(store):
    jobs = [add(store, owner) for owner in ("alice", "bob", "alice")]
    assert store.disk_bytes() == 9_000_000_000
    assert [found.id for found in store.listing("alice", limit=9)] == [jobs[2].id, jobs[0].id]
    assert [found.id for found in store.listing("alice", limit=9, before=jobs[2].number)] == [jobs[0].id]
    store.claim()
    assert store.counts()[State.RUNNING] == 1
    assert store.active_of("alice") == 2
    assert store.get(jobs[0].id, "bob") is None
    store.move(jobs[0].number, State.SUCCEEDED, expires_at=5.0, result={"a": 1})
    assert len(store.rates("fast", False)) == 1
    assert store.due(ENDED, 6.0) == [(jobs[0].number, jobs[0].id)]
    assert (store.oldest_reclaimable(), store.reclaimable_bytes()) == (None, 0)
    store.update(jobs[0].number, reclaimable_bytes=2_000_000_000)
    store.update(jobs[1].number, reclaimable_bytes=5)  # a queued job needs its upload
    assert (store.oldest_reclaimable().id, store.reclaimable_bytes()) == (jobs[0].id, 2_000_000_000)
    store.forget(jobs[0].number)
    assert store.get(jobs[0].id) is None
    assert store.events(jobs[0].number) == []
    last = add(store).number
    store.forget(last)
    assert add(store).number > last  # clients use them as cursors of lists
