"""``JobProgress``. Oracles: jobs whose stages take as long as the test says, on a clock that it sets."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs import Cancelled
from kissgs.core import context
from kissgs.core.context import Deadline, JobProgress, with_seconds_left

PLAN = [("kernels", 1.0), ("cameras", 4.0), ("order", 2.0), ("images", 3.0)]


class Clock:
    """A clock instead of the system's."""

    now = 100.0
    process_time = staticmethod(lambda: 0.0)

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(context, "time", clock)
    return clock


def run(clock, plan, work, *, reports=10, deadline=None):
    """Do the ``work``, pairs of a stage and its seconds, each with so many reports. Return for each event the seconds
    since the beginning, the fraction, and the seconds left."""
    began, events = clock.now, []

    def receive(stage, fraction, note="", seconds_left=None):
        events.append((clock.now - began, fraction, seconds_left))

    job = JobProgress(receive)
    job.expect(plan, deadline)
    for stage, seconds in work:
        for done in range(reports + 1):
            job(stage, done / reports)
            clock.now += seconds / reports * (done < reports)
    job.stop()
    return events, job


def errors(events, total, start=0.25):
    """Return by which factor the seconds left were wrong from ``start`` on, up to the last twentieth."""
    late = [(total - at, left) for at, _, left in events if start * total <= at <= 0.95 * total]
    return [max(left / true, true / left) for true, left in late]


def test_a_job_as_expected_has_a_bar_and_an_estimate_like_a_clock(clock):
    events, job = run(clock, PLAN, PLAN)
    for at, fraction, left in events[:-2]:
        assert fraction == pytest.approx(at / 10, abs=1e-9)
        assert left == pytest.approx(10 - at, abs=1e-9)
    assert events[-2][1:] == pytest.approx((0.99, 0.1))
    assert events[-1][1:] == (1.0, 0.0)
    assert job.seconds == pytest.approx(dict(PLAN))


@pytest.mark.parametrize(("speed", "start"), [(0.3, 0.25), (3.0, 0.25), (0.1, 0.6), (10.0, 0.6)])
def test_the_estimate_follows_the_speed_of_the_machine(clock, speed, start):
    plan = [(f"stage {n}", 1.0) for n in range(20)]
    events, _ = run(clock, plan, [(stage, seconds / speed) for stage, seconds in plan])
    assert max(errors(events, 20 / speed, start)) < 1.5


def test_a_slow_stage_is_found_out_by_its_pace(clock):
    """It takes ten times as long as expected, and then nine tenths of all the time."""
    events, _ = run(clock, [("a", 1.0), ("b", 9.0)], [("a", 1.0), ("b", 90.0)], reports=100)
    assert max(errors(events, 91.0, start=0.5)) < 1.5


def test_a_stage_that_reports_nothing_is_expected_to_go_on_for_a_while(clock):
    events = []
    job = JobProgress(lambda stage, fraction, note="", seconds_left=None: events.append(seconds_left), [("a", 4.0)])
    for _ in range(100):
        job("a", 0.0)
        clock.now += 1.0
    assert events[:3] == [4.0, 3.0, 2.0]
    assert all(0 < left <= 25 for left in events)
    assert events[-1] == pytest.approx(99 / 4)


def test_steps_that_are_left_out_are_skipped(clock):
    events, _ = run(clock, PLAN, [("cameras", 4.0), ("images", 3.0)])
    fractions = [fraction for _, fraction, _ in events]
    assert fractions == sorted(fractions)
    assert [left for _, _, left in events[-12:-2]] == pytest.approx([3 - 0.3 * n for n in range(10)], abs=1e-9)
    assert fractions[-1] == 1.0


def test_rounds_of_a_search_after_all_expected_steps_leave_the_bar_below_its_end(clock):
    """The last step expected ends with fraction 1, and further rounds follow."""
    round_ = [("order", 1.0), ("images", 2.0)]
    events, _ = run(clock, round_, round_ * 5)
    assert all(fraction <= 0.99 and left > 0.01 for _, fraction, left in events[:-1])
    assert events[-1][1:] == (1.0, 0.0)


def test_kernels_that_are_compiled_leave_room_for_the_stages_that_follow(clock):
    """The first stages take a thousand times as long as expected, each with one event at its end."""
    plan = [("order", 0.01), ("codebook", 0.01), ("images", 0.001), ("write", 0.001)]
    events, _ = run(clock, plan, [("order", 10.0), ("codebook", 10.0), ("images", 5.0), ("write", 0.1)], reports=1)
    assert all(events[n][1] <= most for n, most in ((3, 0.97), (5, 0.98), (7, 0.99)))
    assert events[-1][1] == 1.0


def test_a_job_that_is_done_cannot_be_cancelled(clock):
    fractions = []

    def cancel(stage, fraction, note=""):
        fractions.append(fraction)
        if fraction == 1:
            raise Cancelled

    job = JobProgress(cancel, [("a", 1.0)])
    job("a", 1.0)
    job.stop()
    assert fractions == [0.0, 1.0]


def test_a_search_that_takes_more_containers_slows_the_bar_and_never_turns_it_back(clock):
    container, begin, end = [("order", 1.0), ("images", 2.0), ("evaluate", 1.0)], [("read", 1.0)], [("write", 0.5)]
    events, _ = run(clock, begin + container * 2 + end, begin + container * 6 + end)
    fractions = [fraction for _, fraction, _ in events]
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1.0, abs=0.02)
    for (before, start, _), (after, end, _) in itertools.pairwise(events):
        if 9.0 < before < after:  # the containers that nobody expected
            assert end - start < (after - before) / 9.5


def test_a_search_that_ends_early_jumps_forward(clock):
    container = [("order", 1.0), ("images", 2.0)]
    events, _ = run(clock, [*container * 5, ("write", 0.5)], [*container * 2, ("write", 0.5)])
    assert [left for at, _, left in events if at > 5.99][:2] == pytest.approx([9.5, 0.5])
    assert events[-1][1] == 1.0


def test_a_stage_before_others_that_have_not_come_is_a_repetition(clock):
    """A third scene is pruned and evaluated where two were expected: the container is still to be made."""
    pruned = [("score", 1.0), ("evaluate", 1.0)]
    events, _ = run(clock, [*pruned * 2, ("finetune", 5.0), *pruned], [*pruned * 3, ("finetune", 5.0), *pruned])
    assert all(at + left == pytest.approx(13.0, abs=0.5) for at, _, left in events if 4.01 < at < 12)


def test_announced_steps_are_as_slow_as_those_before(clock):
    """Half as fast as expected, then a gap that belongs to no stage: a search expects the same again."""
    left, job = [], JobProgress(lambda stage, fraction, note="", seconds_left=None: left.append(seconds_left))
    for gap in (7.0, 0.0):
        job.expect([("images", 2.0)])
        for fraction in (0.0, 1.0):
            job("images", fraction)
            clock.now += gap if fraction else 4.0
    assert left[2] == pytest.approx(4.0)


def test_the_estimate_does_not_stand_still_once_no_steps_are_expected(clock):
    left, job = [], JobProgress(lambda stage, fraction, note="", seconds_left=None: left.append(seconds_left))
    job.expect([("images", 10.0)] * 5)
    for stage, steps in (("images", None), ("evaluate", [])):
        if steps is not None:
            job.expect(steps)
        for tenth in range(10):
            job(stage, tenth / 10)
            clock.now += 1.0
    assert left[9] > 30
    assert max(left[10:]) < 1


def test_a_stage_that_begins_at_its_end_says_nothing_about_its_repetitions(clock):
    left, steps = [], [("targets", 4.0), ("order", 4.0), ("targets", 4.0)]
    job = JobProgress(lambda stage, fraction, note="", seconds_left=None: left.append(seconds_left), steps)
    for stage, seconds in (("targets", 0.0), ("order", 4.0)):
        job(stage, 1.0 if stage == "targets" else 0.0)
        clock.now += seconds
    job("order", 1.0)
    assert left[-1] == pytest.approx(4.0)


def test_work_that_goes_on_from_a_checkpoint(clock):
    """The stage begins at 60 %: its pace is that of what is left of it."""
    events = []
    job = JobProgress(lambda stage, fraction, note="", seconds_left=None: events.append(seconds_left), [("a", 100.0)])
    for percent in range(60, 101):
        job("a", percent / 100)
        clock.now += 1.0
    assert events == pytest.approx([*(40.0 - n for n in range(40)), 0.4])


def test_loading_counts_once(clock):
    """It goes on after the last event of its stage. Later parts that make sure of it are no repetitions."""
    work = [("kernels", 0.0), ("loading", 1.0), ("cameras", 4.0), ("kernels", 0.0), ("order", 2.0), ("images", 3.0)]
    events, _ = run(clock, PLAN, work)
    assert all(fraction == pytest.approx(at / 10, abs=1e-9) for at, fraction, _ in events[:-2])


def test_a_deadline_bounds_the_estimate(clock):
    """Past the deadline, the job is not taken for done."""
    events, _ = run(clock, [("a", 200.0)], [("a", 30.0)], reports=100, deadline=Deadline(clock.now + 20.0))
    assert max(errors([event for event in events if event[0] <= 20], 20.0)) < 1.01
    assert all(0 < left == pytest.approx(0.05 * at) for at, _, left in events if 20 < at < 25)
    assert events[-2][1] < 1


def test_without_steps_nothing_is_known(clock):
    events, job = run(clock, [], PLAN)
    assert {(fraction, left) for _, fraction, left in events[:-1]} == {(0.0, None)}
    assert events[-1][1:] == (1.0, 0.0)
    assert sum(job.seconds.values()) == pytest.approx(10.0)


STAGES = st.sampled_from(["kernels", "a", "b", "c", "other"])
SECONDS = st.floats(0, 1e4)
PLANS = st.lists(st.tuples(STAGES, SECONDS), max_size=12)
EVENTS = st.lists(st.tuples(STAGES, st.floats(-0.5, 1.5), SECONDS, st.none() | PLANS), max_size=40)


@given(PLANS, EVENTS, st.none() | SECONDS)
def test_the_fraction_never_falls_whatever_happens(plan, events, limit):
    """Stages come in any order, at any time, and plans change in between."""
    clock, found = Clock(), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(context, "time", clock)
        job = JobProgress(lambda stage, fraction, note="", seconds_left=None: found.append((fraction, seconds_left)))
        job.expect(plan, None if limit is None else Deadline(clock.now + limit))
        for stage, fraction, seconds, changed in events:
            if changed is not None:
                job.expect(changed)
            clock.now += seconds
            job(stage, fraction)
        assert job.fraction < 1
        job.stop()
    assert (not found) or found.pop() == (1.0, 0.0)
    fractions = [fraction for fraction, _ in found]
    assert fractions == sorted(fractions)
    assert all(0 <= fraction <= 0.99 for fraction in fractions)
    assert all(left is None or left > 0 for _, left in found)


def test_receivers_without_a_usable_parameter_get_no_seconds():
    """Regression: a callable without a signature, as C extensions have them, was an error before the work began."""
    got = []
    for receiver in ("{} {}".format, lambda stage, fraction, note="", seconds_left=None, /: got.append(seconds_left)):
        with_seconds_left(receiver)("order", 0.5, "", 3.0)
    assert got == [None]


def test_receivers_get_what_they_have_parameters_for():
    got = []
    receivers = [
        lambda stage, fraction: got.append((stage, fraction)),
        lambda stage, fraction, note="": got.append((stage, fraction, note)),
        lambda stage, fraction, note="", scene=7: got.append((stage, fraction, note, scene)),
        lambda stage, fraction, note="", seconds_left=None: got.append((stage, fraction, note, seconds_left)),
        lambda *event: got.append(event),
    ]
    for receiver in receivers:
        with_seconds_left(receiver)("order", 0.5, "", 3.0)
    assert got == [("order", 0.5), ("order", 0.5, ""), ("order", 0.5, "", 7), ("order", 0.5, "", 3.0), ("order", 0.5)]
    got.clear()
    event = ("refine", 0.5, "loss")
    for receiver in receivers[1:]:
        with_seconds_left(receiver)(*event, None)
    assert got == [event, (*event, 7), (*event, None), event]
