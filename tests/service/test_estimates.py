"""Estimated times of jobs with a time limit. Oracles: the limit, and the time of the same job without one."""

import json

import pytest

from service.core.models import Job, State
from service.core.presets import usual_seconds
from service.http.submission import parse_options
from service.jobs.admission import QueueEstimator

SCENE = 500_000


class Records:
    """Job records whose rates are seconds per Gaussian by kind."""

    turns, changes = {}, 0

    def __init__(self, ends=None, **rates):
        self.ends = {} if ends is None else {1: ends}
        self.given = {name.replace("_", "+"): rate for name, rate in rates.items()}

    def clock(self):
        return 1000.0

    def active(self):
        return []

    def rates(self, kind, evaluate):
        return [self.given[kind]] if kind in self.given else []


def seconds(records=None, gaussians=SCENE, started=None, **options):
    chosen = parse_options(json.dumps(options))
    job = Job(
        number=1,
        preset=chosen.kind,
        evaluate=chosen.evaluate,
        gaussians=gaussians,
        options=chosen.model_dump(mode="json"),
        state=State.QUEUED if started is None else State.RUNNING,
        started_at=started,
    )
    return QueueEstimator(records or Records(), 1).current().seconds_left(job)


@pytest.mark.parametrize("options", [{}, {"encode": {"target_size": "3MB"}}, {"finetune": {"enabled": True}}])
def test_a_limited_job_takes_its_time_and_the_start(options):
    assert seconds(**options) > 31
    assert seconds(time_limit="30s", **options) == 31


def test_more_time_than_it_takes_changes_nothing(monkeypatch):
    monkeypatch.setattr("service.http.submission.can_train", lambda: False)
    monkeypatch.setattr("service.jobs.admission.can_train", lambda: False)
    assert seconds(time_limit="10h") == seconds() == usual_seconds("balanced", False, SCENE)
    assert seconds(time_limit="10h", preset="fast") == seconds(preset="fast")


def test_time_that_is_left_trains():
    tuned = seconds(finetune={"enabled": True})
    assert tuned < seconds(time_limit="10h") == 2 * tuned
    assert seconds(time_limit="10min") == 601


def test_the_search_for_the_number_of_gaussians_is_not_limited():
    auto = {"encode": {"psnr": 40}, "compact": {"auto_count": True}}
    assert seconds(time_limit=30, **auto) == seconds(**auto) > 31


def test_evaluation_is_beyond_the_limit():
    added = seconds(preset="fast", evaluate=True) - seconds(preset="fast")
    assert seconds(time_limit=30, evaluate=True) == pytest.approx(31 + added)


def test_rates_are_those_without_a_limit():
    records = Records(balanced_time=9.0, balanced_search=1e-4)
    assert seconds(records, time_limit="10h", encode={"psnr": 40}) == 50
    assert seconds(records, time_limit="20s", encode={"psnr": 40}) == 21
    assert seconds(records, time_limit="40s") == 41


def test_the_estimate_falls_as_time_passes():
    assert seconds(time_limit="60s", started=960) == 21


def test_the_progress_of_a_job_says_when_it_ends():
    """The estimate is the time until then, and 0 where the job takes longer."""
    assert seconds(Records(ends=1007.5), time_limit="60s", started=960) == 7.5
    assert seconds(Records(ends=990.0), time_limit="60s", started=960) == 0
