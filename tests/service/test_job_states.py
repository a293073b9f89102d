"""Jobs that are followed, listed, cancelled and deleted; oracle: the order of what was asked and of what happened."""

import json
import time

from helpers.service import SLOW, events, problem


def test_following_an_event_stream(service):
    job = service.submit()
    answer = service.http.get(job["links"]["events"])
    assert answer.headers["content-type"].startswith("text/event-stream")
    found = events(answer.text)
    assert [number for number, _, _ in found] == list(range(1, len(found) + 1))
    states = [data["state"] for _, kind, data in found if kind == "state"]
    assert states == ["queued", "running", "succeeded"]
    stages = [data["stage"] for _, kind, data in found if kind == "progress"]
    assert stages[0] == "read"
    assert "images" in stages
    fractions = [data["fraction"] for _, kind, data in found if kind == "progress"]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1
    assert all(data["seconds_left"] >= 0 for _, kind, data in found if kind == "progress" and data["stage"] != "read")
    assert found[-1][2]["job"]["sizes"] == service.status(job)["sizes"]


def test_events_resume_after_the_last_id(service, job):
    all_events = events(service.http.get(job["links"]["events"]).text)
    for last in range(1, len(all_events)):
        rest = service.http.get(job["links"]["events"], headers={"Last-Event-ID": str(last)})
        assert events(rest.text) == all_events[last:]
    over = service.http.get(job["links"]["events"], headers={"Last-Event-ID": str(len(all_events))})
    assert (over.status_code, over.content) == (204, b"")
    problem(service.http.get(job["links"]["events"], headers={"Last-Event-ID": "x"}), 422, "invalid-request")


def test_a_long_poll_ends_with_the_job(service):
    job = service.submit()
    assert service.status(job, wait=30)["state"] == "succeeded"
    begun = time.monotonic()
    assert service.status(job, wait=30)["state"] == "succeeded"
    assert time.monotonic() - begun < 30
    for wait in (31, -1, "nan", "soon"):
        problem(service.http.get(f"/v1/jobs/{job['id']}", params={"wait": wait}), 422, "invalid-request")


def test_listing(start):
    service = start()
    submitted = [service.cancel(service.submit(options=SLOW))["id"] for _ in range(3)]
    page = service.http.get("/v1/jobs", params={"limit": 2}).json()
    assert [job["id"] for job in page["jobs"]] == submitted[:0:-1]
    rest = service.http.get("/v1/jobs", params={"limit": 2, "cursor": page["next"]}).json()
    assert [job["id"] for job in rest["jobs"]] == submitted[:1]
    assert "next" not in rest
    assert service.http.get("/v1/jobs", params={"state": "failed"}).json() == {"jobs": []}
    assert len(service.http.get("/v1/jobs", params={"state": "cancelled"}).json()["jobs"]) == 3
    for wrong in ({"limit": 0}, {"limit": 101}, {"cursor": "x"}, {"state": "lost"}):
        problem(service.http.get("/v1/jobs", params=wrong), 422, "invalid-request")


def test_the_queue_is_in_order_and_has_positions(start):
    service = start()
    first = service.hold()
    waiting = [service.submit() for _ in range(2)]
    assert [service.status(job)["position"] for job in waiting] == [1, 2]
    left = [service.status(job)["estimate"]["seconds_left"] for job in (first, *waiting)]
    assert left == sorted(left)
    service.cancel(first)
    started = [service.ended(job)["timings"]["started_at"] for job in waiting]
    assert started == sorted(started)


def test_a_running_job_and_its_cancellation(start):
    service = start()
    job = service.submit(options=SLOW)
    with service.http.stream("GET", job["links"]["events"]) as answer:  # events arrive as they happen
        for line in answer.iter_lines():
            if line.startswith("data: ") and json.loads(line[6:]).get("stage") == "order":
                break
    begun = time.monotonic()
    assert service.status(job, wait=0.5)["state"] == "running"
    assert time.monotonic() - begun > 0.4
    begun = time.monotonic()
    for _ in range(20):
        service.status(job)
    assert time.monotonic() - begun < 20 * 0.5
    for name in ("result", "report", "decoded", "source", "files/meta.json"):
        answer = service.http.get(f"/v1/jobs/{job['id']}/{name}")
        assert problem(answer, 409, "not-finished")["retryable"]
        assert int(answer.headers["retry-after"]) >= 1
    waiting = service.submit()
    assert service.cancel(waiting)["state"] == "cancelled"
    cancelled = service.cancel(job)
    assert cancelled["state"] == "cancelled"
    assert "problem" not in cancelled
    assert not {"preview", "result", "source"} & {*job["links"], *cancelled["links"]}
    assert service.cancel(job)["state"] == "cancelled"  # no change
    problem(service.http.get(f"/v1/jobs/{job['id']}/result"), 409, "not-succeeded")
    assert service.stored() == set()
    done = service.ended(service.submit())  # the worker continues
    assert done["state"] == "succeeded"
    assert service.cancel(done) == service.status(done)


def test_deleting(start):
    service = start()
    done, running = service.ended(service.submit()), service.submit(options=SLOW)
    service.running(running)
    for job in (done, running):
        assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
        problem(service.http.get(f"/v1/jobs/{job['id']}"), 404, "not-found")
        problem(service.http.delete(f"/v1/jobs/{job['id']}"), 404, "not-found")
    assert service.stored() == set()
