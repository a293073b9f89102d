"""Many clients, also idle and hostile ones; oracle: the responses for a single client."""

import asyncio
import contextlib
import os
import resource
import signal
import socket
import threading
import time
import uuid

import pytest
import uvicorn
from helpers.running import wait_until
from helpers.service import FAST, SLOW, SMALL, events, keys_of, problem, read_response, scene_bytes

from service.core.metrics import Metrics
from service.core.problems import ProblemError
from service.core.settings import ServiceSettings
from service.http.app import RequestMiddleware
from service.http.server import TimeoutProtocol, config_of
from service.http.submission import address_of
from service.jobs.admission import Admission
from service.jobs.process import JobProcess, JobRunners

BIG = scene_bytes(20_000, 3)


def slowest(service, count=60):
    """Return the seconds of the slowest of ``count`` requests for the limits."""
    spent = []
    for _ in range(count):
        begun = time.perf_counter()
        assert service.http.get("/v1/limits").status_code == 200
        spent.append(time.perf_counter() - begun)
        time.sleep(0.01)
    return max(spent)


@pytest.mark.quick(0)
def test_idle_connections_do_not_fail_jobs(start_process):
    """Idle connections once used up all file descriptors, so that jobs could not open their files."""
    service = start_process()
    resource.prlimit(service.process.pid, resource.RLIMIT_NOFILE, (300, 300))
    jobs = [service.submit() for _ in range(3)]
    connections = []
    for _ in range(400):
        with contextlib.suppress(OSError):
            connections.append(socket.create_connection(("127.0.0.1", service.port), timeout=300))
    time.sleep(3)
    for connection in connections:
        connection.close()
    for job in jobs:
        status = service.ended(job)
        assert status["state"] == "succeeded", status


@pytest.mark.quick(0)
def test_abandoned_long_polls_cost_nothing(start):
    service = start(drain_seconds=1)
    job = service.hold()
    for _ in range(300):
        with service.raw(b"GET /v1/jobs/%b?wait=30 HTTP/1.1\r\nHost: localhost\r\n\r\n" % job["id"].encode()):
            pass
    assert slowest(service) < 10
    service.interrupt()
    service.join(25)  # it waits for the job only


def test_bodies_in_single_bytes_are_rejected(start):
    service = start()
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"

    def flood(connection):
        end = time.monotonic() + 20
        while time.monotonic() < end:
            connection.sendall(b"1\r\nx\r\n" * 5000)

    with service.raw(head) as connection, pytest.raises(ConnectionError):
        flood(connection)
    assert slowest(service) < 10


def test_announced_bodies_reserve_no_disk_space(start):
    service = start(KISSGS_MAX_DISK_BYTES=10 * len(SMALL))
    job = service.ended(service.submit())
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n"
    for size in (5 * len(SMALL), 100 * len(SMALL)):
        with service.raw(head % size) as connection:
            connection.settimeout(0.3)
            with contextlib.suppress(TimeoutError):
                assert b"507" in read_response(connection)
    assert service.http.get(job["links"]["source"]).status_code == 200
    assert service.http.post("/v1/jobs", files={"file": ("x.ply", SMALL)}, data={"options": FAST}).status_code == 202


@pytest.mark.quick(0)
def test_a_decoding_ends_with_its_job(start):
    service = start(processes=True)
    job = service.ended(service.submit(scene_bytes(120_000, 3)))
    answers = []
    requesting = threading.Thread(target=lambda: answers.append(service.http.get(job["links"]["decoded"])))
    requesting.start()
    wait_until(service.children, 300)
    assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
    requesting.join(300)
    if answers[0].status_code != 200:  # unless the decoding was faster
        problem(answers[0], 410, "gone")
    assert str(service.folder) not in answers[0].text[:2000]
    assert list((service.folder / "jobs").iterdir()) == []
    assert service.http.get("/readyz").status_code == 200


def test_an_error_in_the_job_process_is_internal(tmp_path):
    """It once looked like a crash, because the interpreter could not exit while a thread read standard input."""

    async def ignore(stage, fraction, note):
        pass

    task = {"function": "job_process:nothing", "folder": str(tmp_path), "files": [], "work": "work", "source": "x"}
    outcome = asyncio.run(JobProcess(JobRunners(ServiceSettings())).run(task, ignore))
    assert (outcome.kind, outcome.code) == ("error", "internal")


@pytest.mark.quick(0)
def test_a_signal_to_the_process_group_requeues_the_job(start):
    """Some supervisors signal the job process, too."""
    service = start(processes=True, drain_seconds=0.5)
    job = service.submit(BIG, SLOW)
    service.running(job)
    (child,) = service.children()
    service.interrupt()
    os.kill(child, signal.SIGTERM)
    time.sleep(0.05)
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    service.join()
    service.restart()
    status = service.status(job)
    assert (status["state"] in ("queued", "running"), status["starts"] <= 1) == (True, True)


@pytest.mark.parametrize("more", [0, 100_000])
def test_an_upload_while_the_service_stops(start, more):
    """A stalled upload does not delay the end, either, nor does a job after a second signal. Events of the job go on
    after the restart."""
    service = start(drain_seconds=3600 * more)
    job = service.hold()
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n" % len(BIG)
    with service.raw(head + BIG[:100_000]) as connection:
        service.wait_for_uploads(1)
        service.interrupt()
        with contextlib.suppress(ConnectionError):
            connection.sendall(BIG[100_000 : 100_000 + more])
        answer = read_response(connection)
    assert answer.startswith(b"HTTP/1.1 503")
    assert b'"stopping"' in answer
    if more:
        service.interrupt()
    service.join()
    service.restart()
    assert service.status(job)["state"] in ("queued", "running")
    service.cancel(job)
    numbers = [number for number, _, _ in events(service.http.get(job["links"]["events"]).text)]
    assert numbers == list(range(1, len(numbers) + 1))


def test_a_second_signal_at_once_is_no_failure(start, caplog):
    """``timeout make serve`` sends one: make passes on the signal that its group gets as well."""
    service = start()
    service.interrupt()
    service.interrupt()
    service.join()
    assert "Traceback" not in caplog.text


def test_clients_cannot_add_log_lines_or_metric_labels(service):
    service.http.get("/x%0a2026-01-01%20ERROR%20forged")
    for _ in range(3):
        service.http.request(f"FOO{uuid.uuid4().hex[:6].upper()}", "/livez")
    assert "\n2026-01-01" not in service.log.read_text()
    metrics = service.http.get("/metrics").text
    assert "FOO" not in metrics
    assert 'method="other"' in metrics


def test_unexpected_errors_are_problem_documents():
    async def application(scope, receive, send):
        raise RuntimeError("internal detail")

    async def request():
        scope = {"type": "http", "method": "GET", "path": "/x", "headers": [(b"host", b"localhost")]}
        await RequestMiddleware(application, Metrics(), ServiceSettings())(scope, None, send)

    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(request())
    headers = dict(sent[0]["headers"])
    assert (sent[0]["status"], headers[b"content-type"]) == (500, b"application/problem+json")
    assert headers[b"x-request-id"] in sent[1]["body"]
    assert b"internal detail" not in sent[1]["body"]


def test_monitors_can_use_head(service):
    for path in ("/", "/livez", "/readyz", "/version", "/favicon.ico"):
        answer = service.http.head(path)
        assert (answer.status_code, answer.content) == (200, b""), path


def test_refused_methods_list_the_allowed_ones(service):
    for path, allowed in (("/livez", "GET, HEAD"), ("/v1/jobs", "GET, POST"), ("/v1/jobs/x", "DELETE, GET, HEAD")):
        answer = service.http.patch(path)
        assert (answer.headers["allow"], allowed in answer.json()["detail"]) == (allowed, True)


@pytest.mark.quick(0)
def test_events_continue_after_a_restart(start):
    service = start(processes=True)
    job = service.submit(scene_bytes(6_000, 2))
    service.running(job)
    seen = []
    with service.http.stream("GET", job["links"]["events"]) as answer:
        for line in answer.iter_lines():
            if line.startswith("id: "):
                seen.append(int(line[4:]))
            if len(seen) == 3:
                break
    service.stop()
    service.restart()
    rest = service.http.get(job["links"]["events"], headers={"Last-Event-ID": str(seen[-1])}).text
    seen += [int(line[4:]) for line in rest.splitlines() if line.startswith("id: ")]
    assert seen == list(range(1, len(seen) + 1))
    assert '"succeeded"' in rest


def test_nobody_holds_all_upload_slots(start):
    """One key once held all of them, with uploads of 9 kB/s."""
    service = start(KISSGS_KEYS=keys_of(alice="alice", bob="bob"), KISSGS_MAX_UPLOADS=6)
    head = b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer alice\r\nContent-Length: 5000\r\n\r\nply\n"

    def submit(owner):
        headers = {"Authorization": f"Bearer {owner}"}
        return service.http.post("/v1/jobs", content=SMALL, params={"options": FAST}, headers=headers)

    with service.raw(head), service.raw(head):
        service.wait_for_uploads(2)
        assert "this key" in problem(submit("alice"), 429, "too-many-uploads")["detail"]
        assert submit("bob").status_code == 202
    wait_until(lambda: submit("alice").status_code == 202)


def test_an_address_has_a_quarter_of_the_upload_slots():
    """IPv6 clients count by their network. Oracle: RFC 6177, by which a site has at least a /64."""
    admission = Admission(ServiceSettings(max_uploads=8), None, None, None)
    for one, same, other in (
        ("192.0.2.1", "192.0.2.1", "192.0.2.2"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::9", "2001:db8:1:3::9"),
        ("fe80::1%eth0", "fe80::2%eth1", "2001:db8:1:3::9"),
    ):
        one, same, other = (address_of((host, 1)) for host in (one, same, other))
        with admission.slot(one), admission.slot(same):
            with pytest.raises(ProblemError, match="this address"), admission.slot(same):
                pass
            with admission.slot(other):
                assert admission.uploads == 3
        with admission.slot(one):
            assert admission.uploads == 1


def test_one_address_does_not_take_all_connections(monkeypatch):
    """Event streams of one client once filled all connections, and others were closed. Oracle: the counts by hand."""

    async def application(scope, receive, send):
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"x", "more_body": True})
        await receive()  # the request
        await receive()  # the end of the connection

    def connect(host):
        connection = socket.create_connection(listener.getsockname(), timeout=60, source_address=(host, 0))
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answered = False
        with contextlib.suppress(ConnectionError):
            answered = connection.recv(1000).startswith(b"HTTP/1.1 200")
        return connection, answered

    def is_open(connection):
        connection.settimeout(0.2)
        try:
            while connection.recv(1000):
                pass
        except TimeoutError:
            return True
        except ConnectionError:
            pass
        return False

    monkeypatch.setattr(TimeoutProtocol, "most_connections", 6)
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(config_of(application))
    serving = threading.Thread(target=server.run, args=([listener],))
    serving.start()
    try:
        greedy = [connect("127.0.0.2") for _ in range(8)]
        assert [answered for _, answered in greedy] == [True] * 6 + [False] * 2
        others = [connect("127.0.0.1") for _ in range(4)]
        assert [answered for _, answered in others] == [True] * 3 + [False]
        assert sum(is_open(connection) for connection, _ in greedy) == 3
    finally:
        for connection, _ in [*greedy, *others]:
            connection.close()
        server.should_exit = True
        serving.join(60)
