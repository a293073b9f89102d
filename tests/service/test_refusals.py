"""Refused requests; oracle: the problem types, RFC 9457 and HTTP."""

import contextlib
import gzip
import io
import socket
import zipfile

import httpx
import pytest
from helpers.running import wait_until
from helpers.service import FAST, SMALL, problem, read_response, scene_bytes

from service.core.problems import PROBLEM_TYPES, ProblemError
from service.http.uploads import refuse_count


def submit(service, data=SMALL, **arguments):
    return service.http.post("/v1/jobs", content=data, **{"params": {"options": FAST}, **arguments})


def bomb():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("../../scene.ply", b"\0" * 5_000_000)
    return file.getvalue()


def header(count, properties="property float x\n", kind="binary_little_endian"):
    return f"ply\nformat {kind} 1.0\nelement vertex {count}\n{properties}end_header\n".encode()


HEAD = b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\n\r\n"
FULL = SMALL[: SMALL.index(b"end_header\n") + 11]

HOSTILE = {  # what is no .ply scene is tested in tests/io; here, what a server makes of any bytes
    "empty": b"",
    "no end of header": b"ply\n" + b"comment x\n" * 100_000,
    "one endless line": b"ply\ncomment " + b"x" * 1_000_000,
    "zip bomb": bomb(),
    "gzip": gzip.compress(SMALL),
    "html": b"<!doctype html><p>sign in",
    "git lfs": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3\n",
    "point cloud": header(3, "property float x\nproperty float y\nproperty float z\n") + bytes(36),
    "truncated": SMALL[:-1],
    "header alone": FULL,
    "enormous count": SMALL.replace(b"vertex 300\n", b"vertex 999999999999999999\n"),
    "nul bytes": b"ply\n" + bytes(70_000),
}


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("form", [False, True])
def test_hostile_scenes(service, kind, form):
    if form:
        answer = service.http.post("/v1/jobs", files={"file": ("x.ply", HOSTILE[kind])})
    else:
        answer = submit(service, HOSTILE[kind])
    assert answer.status_code == 422, answer.text
    found = problem(answer, 422, answer.json()["code"])
    assert found["code"] in ("invalid-scene", "unsupported")
    assert "the upload" in found["detail"]
    assert ".part" not in found["detail"]
    assert not found["retryable"]


def test_too_many_gaussians_are_refused_after_the_header(service):
    """The rest of the body is never sent."""
    start = scene_bytes(1, 1).replace(b"vertex 1\n", b"vertex 20001\n")[:2000]
    with service.raw(HEAD % 3_000_000 + start) as connection:
        answer = read_response(connection).decode()
    assert answer.startswith("HTTP/1.1 422")
    assert "20,001 Gaussians" in answer
    assert "the limit is 20,000" in answer
    assert '"code":"unsupported"' in answer


@pytest.mark.parametrize(("count", "size"), [(5_000_000, 3_800), (20_000_000, 4_000), (200_000, 60_000)])
def test_more_gaussians_than_bytes_can_tell_apart_are_refused(count, size):
    """A SOG whose images have one colour holds millions in 4 kB; real ones take 4 bytes or more for each."""
    with pytest.raises(ProblemError, match="copies"):
        refuse_count(count, size, 20_000_000)
    refuse_count(count, 2 * count, 20_000_000)
    refuse_count(60_000, 100, 60_000)


def test_an_incomplete_scene_is_refused_by_its_length(service):
    with service.raw(HEAD % (len(SMALL) - 1) + FULL) as connection:
        assert b"cut short" in read_response(connection)


@pytest.mark.parametrize("chunked", [False, True])
def test_too_large(service, chunked):
    data = SMALL + bytes(5_000_000)
    answer = submit(service, iter([data[:70_000], *([bytes(100_000)] * 50)]) if chunked else data)
    assert "4,000,000 bytes" in problem(answer, 413, "too-large")["detail"]
    assert service.uploads() == []
    with service.raw(HEAD % 5_000_000) as connection:
        assert read_response(connection).startswith(b"HTTP/1.1 413")  # before the body


INVALID_OPTIONS = [
    *("", "{", "[]", "null", "7", "{" * 5000, '{"x": 1}', '{"preset": "tiny"}', '{"evaluate": "perhaps"}'),
    *('{"encode": {"gaussians_per_codebook_entry": -1}}', '{"encode": {"nothing": 1}}'),
    *('{"encode": {"seed": 1e400}}', '{"encode": null}', '{"format": "glb"}', '{"format": ["sog"]}'),
    *('{"compact": {"count": 5, "ratio": 0.1}}', '{"compact": {"auto_count": true}}'),
]


@pytest.mark.parametrize("options", INVALID_OPTIONS)
@pytest.mark.parametrize("form", [False, True])
def test_invalid_options(service, options, form):
    if form:
        answer = service.http.post("/v1/jobs", files={"options": (None, options), "file": ("x.ply", SMALL)})
    else:
        answer = submit(service, params={"options": options})
    found = problem(answer, 422, "invalid-request")
    assert found["errors"][0]["field"]
    assert found["errors"][0]["message"]


@pytest.mark.parametrize("kind", ["text/plain", "application/json", "application/x-www-form-urlencoded", "x"])
def test_unsupported_media_types(service, kind):
    found = problem(submit(service, headers={"Content-Type": kind}), 415, "media-type")
    assert "curl -F" in found["detail"]
    problem(submit(service, gzip.compress(SMALL), headers={"Content-Encoding": "gzip"}), 415, "media-type")


FORM = "multipart/form-data; boundary=b"
PART = b'--b\r\nContent-Disposition: form-data; name="%b"\r\n\r\n%b\r\n'
OPTIONS = PART % (b"options", b"{}")

FORMS = {
    "no boundary": ("multipart/form-data", b"--b\r\n"),
    "empty boundary": ("multipart/form-data; boundary=", b""),
    "long boundary": ("multipart/form-data; boundary=" + "b" * 300, b""),
    "empty": (FORM, b""),
    "text": (FORM, b"nothing of the kind"),
    "no parts": (FORM, b"--b--\r\n"),
    "a part without a name": (FORM, b"--b\r\n\r\nno name\r\n--b--\r\n"),
    "another field": (FORM, PART % (b"other", b"x") + b"--b--\r\n"),
    "no scene": (FORM, OPTIONS + b"--b--\r\n"),
    "options twice": (FORM, OPTIONS + OPTIONS + b"--b--\r\n"),
    "long header": (FORM, b"--b\r\nX: " + b"x" * 20_000 + b"\r\n\r\n\r\n--b--\r\n"),
    "long options": (FORM, PART % (b"options", b" " * 70_000)),
    "scene twice": (FORM, (PART % (b"file", SMALL)) * 2 + b"--b--\r\n"),
    "truncated scene": (FORM, (PART % (b"file", SMALL))[:-2]),
    "options in two places": (FORM, OPTIONS + (PART % (b"file", SMALL)) + b"--b--\r\n"),
}


@pytest.mark.parametrize("kind", FORMS)
def test_invalid_forms(service, kind):
    content_type, body = FORMS[kind]
    params = {"options": "{}"} if kind == "options in two places" else {}
    answer = submit(service, body, headers={"Content-Type": content_type}, params=params)
    problem(answer, 422, "invalid-request")
    assert service.uploads() == []


def test_invalid_idempotency_keys(service):
    for key in ("x" * 256, "a b", "é"):
        problem(submit(service, headers={"Idempotency-Key": key.encode("latin-1")}), 422, "invalid-request")


def test_unknown_resources(service):
    unknown = "/v1/jobs/" + "0" * 32
    paths = unknown, f"{unknown}/result", "/v1/jobs/nope", "/v1/jobs/../../etc/passwd", "/v1/jobs/%00", "/nothing"
    for path in (*paths, "/static/..%2f..%2fapp.py", "/v1/problems/nothing"):
        problem(service.http.get(path), 404, "not-found")
    problem(service.http.post(f"{unknown}/cancel"), 404, "not-found")
    problem(service.http.delete(unknown), 404, "not-found")
    problem(service.http.put("/v1/jobs"), 405, "method-not-allowed")
    problem(service.http.delete("/v1/limits"), 405, "method-not-allowed")


def test_every_code_is_described(service):
    listed = service.http.get("/v1/problems").json()
    assert [kind["code"] for kind in listed] == list(PROBLEM_TYPES)
    for kind in listed:
        assert service.http.get(f"/v1/problems/{kind['code']}").json() == kind


def test_idempotency_keys_work_with_a_full_queue(start):
    service = start(KISSGS_MAX_QUEUE=1)
    service.hold()
    first = service.submit(**{"Idempotency-Key": "k"})
    assert service.submit(**{"Idempotency-Key": "k"})["id"] == first["id"]
    answer = submit(service)
    assert problem(answer, 429, "queue-full")["retryable"]
    assert 1 <= int(answer.headers["retry-after"]) <= 300
    with service.raw(HEAD % 500_000) as connection:
        assert read_response(connection).startswith(b"HTTP/1.1 429")  # before the body


def test_too_many_uploads(start):
    service = start(KISSGS_MAX_UPLOADS=1)
    with service.raw(HEAD % 500_000 + b"ply\n"):
        service.wait_for_uploads(1)
        problem(submit(service), 429, "too-many-uploads")
    wait_until(lambda: submit(service).status_code == 202)


@pytest.mark.quick(0)
def test_disk_limit(start):
    service = start(KISSGS_MAX_DISK_BYTES=2 * len(SMALL))
    job = service.ended(service.submit())
    assert "source" in job["links"]
    second = service.ended(service.submit(scene_bytes(300, seed=1)))  # the first job's upload is reclaimed
    assert second["state"] == "succeeded"
    assert "source" not in service.status(job)["links"]
    problem(service.http.get(f"/v1/jobs/{job['id']}/source"), 410, "gone")
    assert service.http.get(job["links"]["result"]).status_code == 200
    answer = submit(service, scene_bytes(700))
    assert problem(answer, 507, "disk-full")["retryable"]
    assert "retry-after" in answer.headers
    assert service.uploads() == []


def test_minimum_free_disk_space(start):
    service = start(KISSGS_MIN_FREE_BYTES="1000TB")
    problem(submit(service), 507, "disk-full")
    answer = service.http.get("/readyz")
    assert (answer.status_code, answer.json()["ready"]) == (503, False)
    assert "free bytes" in answer.json()["checks"]["disk"]
    assert service.http.get("/livez").status_code == 200


def test_stalled_and_slow_uploads(start):
    """Single bytes do not keep an upload alive."""
    service = start(upload_idle_seconds=0.4)
    with service.raw(HEAD % 500_000 + b"ply\n") as connection:
        answer = read_response(connection)
        assert answer.startswith(b"HTTP/1.1 408")
        assert b"upload-timeout" in answer
    assert service.uploads() == []
    with service.raw(HEAD % 500_000) as connection:
        connection.settimeout(0.05)
        answer = b""
        for byte in SMALL[:1200]:
            with contextlib.suppress(TimeoutError, ConnectionError):
                connection.send(bytes([byte]))
                answer += connection.recv(65536)
            if answer:
                break
        connection.settimeout(300)
        answer += read_response(connection)
    assert b"upload-timeout" in answer


def test_a_client_that_disconnects(service):
    def latest():
        return [job["id"] for job in service.http.get("/v1/jobs", params={"limit": 1}).json()["jobs"]]

    before = latest()
    with service.raw(HEAD % 500_000 + SMALL[:30_000]) as connection:
        connection.shutdown(socket.SHUT_RDWR)
    wait_until(lambda: not service.uploads())
    assert latest() == before
    service.wait_for_uploads(0)


def test_invalid_http(service):
    with service.raw(b"\x16\x03\x01\x02\x00\x01\x00 no HTTP at all\r\n\r\n") as connection:
        answer = read_response(connection)
        assert answer.startswith(b"HTTP/1.1 400")
        assert b"application/problem+json" in answer
        assert b'"code":"bad-http"' in answer
    with (
        service.raw(b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 200_000) as connection,
        contextlib.suppress(ConnectionError),
    ):
        assert read_response(connection).startswith(b"HTTP/1.1 4")
    assert httpx.get(f"{service.url}/livez").status_code == 200
