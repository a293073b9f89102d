"""Authorisation by keys, origins and host names; oracle: SHA-256 of the standard library."""

import contextlib
import hashlib

import pytest
from helpers.running import wait_until
from helpers.service import FAST, SLOW, SMALL, problem, scene_bytes
from starlette.requests import Request

from service.core.problems import ProblemError
from service.core.settings import ServiceSettings
from service.http.submission import _address
from service.jobs.admission import Admission

KEYS = {"alice": ["kissgs_a1", "kissgs_a2"], "bob": ["kissgs_b"]}


def bearer(key):
    return {"Authorization": f"Bearer {key}"}


@pytest.fixture
def guarded(start):
    entries = [f"{owner}:{hashlib.sha256(key.encode()).hexdigest()}" for owner, keys in KEYS.items() for key in keys]
    return start(KISSGS_KEYS=", ".join(entries), KISSGS_MAX_JOBS_PER_KEY=2)


def test_a_missing_or_unknown_key(guarded):
    for headers in (
        {},
        bearer("kissgs_x"),
        {"Authorization": "Bearer"},
        {"Authorization": "Basic a2lzc2dzX2E="},
        bearer("é"),
    ):
        raw = {name: value.encode() for name, value in headers.items()}
        for method, path in (
            ("POST", "/v1/jobs"),
            ("POST", "/v1/compress"),
            ("GET", "/v1/jobs"),
            ("GET", "/v1/jobs/" + "0" * 32),
        ):
            answer = guarded.http.request(method, path, headers=raw)
            problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"].startswith("Bearer")
    for open_to_all in ("/", "/livez", "/readyz", "/version", "/v1/limits", "/v1/presets", "/openapi.json"):
        assert guarded.http.get(open_to_all).status_code == 200
    assert guarded.http.get("/v1/limits").json()["keys_required"] is True


def test_a_body_is_not_read_without_a_key(guarded):
    with guarded.raw(b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 500000\r\n\r\n") as connection:
        assert connection.recv(65536).startswith(b"HTTP/1.1 401")


def test_jobs_are_private_to_their_owner(guarded):
    """All keys of an owner give access, so that keys can be replaced; keys of other owners do not."""
    alice, bob = bearer("kissgs_a1"), bearer("kissgs_b")
    params = {"options": FAST}
    job = guarded.http.post("/v1/jobs", content=SMALL, params=params, headers={**alice, "Idempotency-Key": "k"}).json()
    here = f"/v1/jobs/{job['id']}"
    assert guarded.http.get(here, params={"wait": 30}, headers=bearer("kissgs_a2")).json()["state"] == "succeeded"
    paths = ["", "/result", "/events", "/report", "/decoded", "/source", "/files/meta.json"]
    for path in paths:
        assert guarded.http.get(here + path, headers=alice).status_code == 200
        problem(guarded.http.get(here + path, headers=bob), 404, "not-found")
    problem(guarded.http.post(f"{here}/cancel", headers=bob), 404, "not-found")
    problem(guarded.http.delete(here, headers=bob), 404, "not-found")
    assert guarded.http.get("/v1/jobs", headers=bob).json() == {"jobs": []}
    other = guarded.http.post("/v1/jobs", content=SMALL, params=params, headers={**bob, "Idempotency-Key": "k"}).json()
    assert other["id"] != job["id"]
    for key in ("kissgs_a1", "kissgs_b"):
        assert key not in guarded.log.read_text()


def test_jobs_of_one_key_are_limited(guarded):
    alice, bob = bearer("kissgs_a1"), bearer("kissgs_b")
    for _ in range(2):
        answer = guarded.http.post("/v1/jobs", content=scene_bytes(20_000, 3), params={"options": SLOW}, headers=alice)
        assert answer.status_code == 202
    answer = guarded.http.post("/v1/jobs", content=SMALL, headers=bearer("kissgs_a2"))
    assert problem(answer, 429, "too-many-jobs")["retryable"]
    assert "retry-after" in answer.headers
    assert guarded.http.post("/v1/jobs", content=SMALL, headers=bob).status_code == 202


def test_other_origins(start, service):
    asked = {"Origin": "https://example.org", "Access-Control-Request-Method": "POST"}
    assert "access-control-allow-origin" not in service.http.get("/version", headers=asked).headers
    allowed = start(KISSGS_CORS_ORIGINS="https://example.org")
    assert allowed.http.get("/version", headers=asked).headers["access-control-allow-origin"] == "https://example.org"
    other = allowed.http.get("/version", headers={**asked, "Origin": "https://example.com"})
    assert "access-control-allow-origin" not in other.headers
    assert allowed.http.options("/v1/jobs", headers=asked).status_code == 200


def test_pages_of_other_sites_are_refused(service, start):
    """Browsers send forms to other sites without a preflight request, but with the origin of the page."""
    form = {"file": ("x.ply", SMALL)}
    for origin in ("https://evil.example", "null", service.url.replace("127.0.0.1", "localhost")):
        answer = service.http.post("/v1/jobs", files=form, headers={"Origin": origin})
        problem(answer, 403, "foreign")
    for method, path in (("POST", "/v1/jobs/" + "0" * 32 + "/cancel"), ("DELETE", "/v1/jobs/" + "0" * 32)):
        problem(service.http.request(method, path, headers={"Origin": "https://evil.example"}), 403, "foreign")
    assert service.http.post("/v1/jobs", files=form, headers={"Origin": service.url}).status_code == 202
    for origin, host in (("LOCALHOST", "localhost"), ("localhost", "LocalHost")):  # host names are case-insensitive
        headers = {"Origin": f"http://{origin}:{service.port}", "Host": f"{host}:{service.port}"}
        assert service.http.post("/v1/jobs", files=form, headers=headers).status_code == 202
    allowed = start(KISSGS_CORS_ORIGINS="https://Good.example")
    assert allowed.http.post("/v1/jobs", files=form, headers={"Origin": "https://good.example"}).status_code == 202


def test_unknown_host_names_are_refused(service, start):
    """DNS rebinding: pages of a foreign name that resolves to this address would count as the same origin."""
    for host in ("evil.example", f"evil.example:{service.port}", "127.0.0.1.evil.example", ""):
        problem(service.http.get("/v1/jobs", headers={"Host": host}), 403, "foreign")
    for host in ("localhost", f"LOCALHOST:{service.port}", "127.0.0.1", f"[::1]:{service.port}"):
        assert service.http.get("/v1/jobs", headers={"Host": host}).status_code == 200
    named = start(KISSGS_NAMES="splats.example.org")
    assert named.http.get("/v1/jobs", headers={"Host": "splats.example.org"}).status_code == 200
    problem(named.http.get("/v1/jobs", headers={"Host": "evil.example"}), 403, "foreign")


def test_nobody_holds_all_upload_slots(start):
    """One key once held all of them, with uploads of 9 kB/s."""
    entries = [f"{owner}:{hashlib.sha256(owner.encode()).hexdigest()}" for owner in ("alice", "bob")]
    service = start(KISSGS_KEYS=", ".join(entries), KISSGS_MAX_UPLOADS=6)
    head = (
        "POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer alice\r\nContent-Length: 5000\r\n\r\nply\n"
    )
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(service.raw(head.encode()))
        wait_until(lambda: "kissgs_uploads_in_flight 2.0" in service.http.get("/metrics").text)
        answer = service.http.post("/v1/jobs", content=SMALL, headers=bearer("alice"))
        assert "this key" in problem(answer, 429, "too-many-uploads")["detail"]
        assert service.http.post("/v1/jobs", content=SMALL, headers=bearer("bob")).status_code == 202
    wait_until(lambda: service.http.post("/v1/jobs", content=SMALL, headers=bearer("alice")).status_code == 202)


def test_an_address_has_a_quarter_of_the_upload_slots():
    admission = Admission(ServiceSettings(max_uploads=8), None, None, None)
    with admission.slot("192.0.2.1"), admission.slot("192.0.2.1"):
        with pytest.raises(ProblemError, match="this address"), admission.slot("192.0.2.1"):
            pass
        with admission.slot("192.0.2.2"):
            assert admission.uploads == 3
    with admission.slot("192.0.2.1"):
        assert admission.uploads == 1


@pytest.mark.parametrize(
    ("host", "counted"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2::9", "2001:db8:1:2::/64"),
        ("fe80::1%eth0", "fe80::/64"),
    ],
)
def test_an_ipv6_client_counts_by_its_network(host, counted):
    """Oracle: RFC 6177, by which a site has at least a /64."""
    assert _address(Request({"type": "http", "client": (host, 1), "headers": []})) == counted
