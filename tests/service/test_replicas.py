"""Replicas on one PostgreSQL database and one bucket; oracles: kissgs.compress of the scenes, and the bucket's keys."""

import pytest
from helpers.service import FAST, SLOW, SMALL, Service, events, problem, scene_bytes  # noqa: F401

import kissgs

EXPECTED = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast")).to_zip()


@pytest.fixture
def replica(tmp_path, bucket, postgresql):
    """``replica(KISSGS_X=…)`` starts a replica, which ends with the test."""
    started = []

    def begin(**settings):
        folder = tmp_path / f"replica{len(started)}"
        started.append(Service(folder, KISSGS_DATABASE_URL=postgresql, **bucket.variables, **settings).start())
        return started[-1]

    yield begin
    for service in started:
        service.__exit__()


def test_one_replica(replica, bucket):
    it = replica()
    job = it.ended(it.submit())
    assert job["state"] == "succeeded", (job, it.log.read_text()[-3000:])
    assert it.http.get(job["links"]["result"]).content == EXPECTED
