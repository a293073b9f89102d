"""Requests and services at the same time; oracle: kissgs.compress of the scenes."""

import random
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers.service import FAST, problem, scene_bytes

import kissgs
from service.core.settings import ServiceSettings, SettingsError
from service.http.app import create_app


@pytest.mark.quick(0)
def test_many_simultaneous_jobs(start_process):
    """No job of 60 is lost or runs twice, and the server's memory hardly grows."""
    service = start_process(KISSGS_MAX_QUEUE=500, KISSGS_MAX_UPLOADS=32, KISSGS_WORKERS=2, KISSGS_JOB_THREADS=1)
    scenes = [scene_bytes(20, 0, seed=i) for i in range(60)]
    service.only_result(service.submit(scenes[0]))
    before = service.memory()

    def send(i):
        for _ in range(100):
            answer = service.http.post("/v1/jobs", content=scenes[i], params={"options": FAST, "name": str(i)})
            if answer.status_code == 202:
                return answer.json()
            problem(answer, 429, "too-many-uploads")
            time.sleep(0.2)
        raise AssertionError("never accepted")

    with ThreadPoolExecutor(50) as pool:
        jobs = list(pool.map(send, range(60)))
    assert len({job["id"] for job in jobs}) == 60
    assert service.memory() - before < 64 << 20
    for i in random.Random(0).sample(range(60), 52):
        service.http.post(f"/v1/jobs/{jobs[i]['id']}/cancel")
    states = [service.ended(job, seconds=120) for job in jobs]
    assert {status["state"] for status in states} <= {"succeeded", "cancelled"}
    assert sum(status["state"] == "succeeded" for status in states) >= 8
    for i, status in enumerate(states):
        assert status["name"] == str(i)
        assert status["starts"] <= 1
        if status["state"] == "succeeded":
            expected = kissgs.compress(scenes[i], settings=kissgs.Settings(preset="fast")).to_zip()
            assert service.http.get(status["links"]["result"]).content == expected
    assert service.leftovers() == []


def test_simultaneous_requests_with_one_idempotency_key(start):
    service = start(KISSGS_MAX_UPLOADS=32)
    with ThreadPoolExecutor(8) as pool:
        jobs = list(pool.map(lambda _: service.submit(scene_bytes(6_000, 2), **{"Idempotency-Key": "same"}), range(8)))
    assert len({job["id"] for job in jobs}) == 1
    assert len(service.http.get("/v1/jobs").json()["jobs"]) == 1
    assert service.ended(jobs[0])["state"] == "succeeded"
    assert len(list((service.folder / "jobs").iterdir())) == 1
    assert service.leftovers() == []
    with pytest.raises(SettingsError, match="another service is using"):
        create_app(ServiceSettings(data_dir=service.folder))
    assert service.http.get("/livez").status_code == 200
