"""Deadlines, the number of steps that fit in, and parts of a stage. Oracle: a clock that the test sets."""

import pytest

from kissgs.core import context as deadline
from kissgs.core.context import Context, Deadline, Pace


@pytest.fixture
def clock(monkeypatch):
    """Return the seconds that the clock shows, in a list, to be changed."""
    now = [100.0]
    monkeypatch.setattr(deadline.time, "perf_counter", lambda: now[0])
    return now


def made(clock, pace, seconds_per_step):
    """Make steps as a training does, each as long as ``seconds_per_step`` says of its number, and count them."""
    done = 0
    pace.update(done)
    while done < pace.steps:
        clock[0] += seconds_per_step(done)
        done += 1
        pace.update(done)
    return done


def test_a_deadline_comes_nearer(clock):
    end = Deadline.after(30)
    clock[0] += 12
    assert end.seconds == pytest.approx(18)
    assert end.earlier(20).seconds == pytest.approx(-2)


def test_all_steps_are_made_where_they_fit_in(clock):
    assert made(clock, Pace(50), lambda done: 1e3) == 50
    assert made(clock, Pace(50, Deadline.after(100)), lambda done: 1.0) == 50


@pytest.mark.parametrize("seconds", [7.0, 20.0, 90.0])
def test_as_many_steps_are_made_as_fit_in(clock, seconds):
    end = Deadline.after(seconds)
    assert made(clock, Pace(1000, end), lambda done: 0.5) == pytest.approx(2 * seconds, abs=1)
    assert -0.5 <= end.seconds <= 0.5


def test_a_slow_first_step_does_not_count(clock):
    end = Deadline.after(30)
    pace, totals = Pace(1000, end), []

    def seconds_of(done):
        totals.append(pace.steps)
        return 10.0 if done == 0 else 0.5

    made(clock, pace, seconds_of)
    assert 0 <= end.seconds <= 0.5
    assert set(totals[5:-5]) <= {40, 41, 42}  # 10 s for the first, 0.5 s for each other


def test_a_machine_that_becomes_slower_ends_in_time(clock):
    end = Deadline.after(30)
    assert made(clock, Pace(1000, end), lambda done: 0.2 if done < 50 else 0.8) < 80
    assert -0.8 <= end.seconds <= 2


def test_no_step_is_made_after_the_deadline(clock):
    assert made(clock, Pace(10, Deadline.after(-1)), lambda done: 1.0) == 0
    assert made(clock, Pace(10, Deadline.after(2.5)), lambda done: 9.0) == 1


def test_parts_of_a_stage_are_reported_as_that_stage():
    events, deadline = [], Deadline(3.0)
    whole = Context(2, "cuda", lambda *event: events.append(event), deadline)
    part = whole.stage("evaluate")
    part.progress("kernels", 1.0)
    part.progress("evaluate", 0.5, "a note of another stage")
    assert events == [("evaluate", 0.0), ("evaluate", 0.5)]
    assert (part.threads, part.device, part.deadline) == (2, "cuda", deadline)
