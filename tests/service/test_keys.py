"""Authorisation by keys, origins and host names; oracle: SHA-256 of the standard library."""

import hashlib

import pytest
from helpers.service import FAST, SLOW, SMALL, problem

KEYS = {"alice": ["kissgs_a1", "kissgs_a2"], "bob": ["kissgs_b"]}


def bearer(key):
    return {"Authorization": f"Bearer {key}"}


@pytest.fixture
def guarded(start):
    entries = [f"{owner}:{hashlib.sha256(key.encode()).hexdigest()}" for owner, keys in KEYS.items() for key in keys]
    return start(KISSGS_KEYS=", ".join(entries), KISSGS_MAX_JOBS_PER_KEY=2)


def test_a_missing_or_unknown_key(guarded):
    refused = "GET /v1/jobs", "POST /v1/jobs", "POST /v1/compress", "GET /v1/jobs/" + "0" * 32
    for given in (None, "Bearer kissgs_x", "Bearer", "Basic a2lzc2dzX2E=", "Bearer é"):
        headers = {} if given is None else {"Authorization": given.encode()}
        for request in refused:
            answer = guarded.http.request(*request.split(), headers=headers)
            problem(answer, 401, "unauthorized")
            assert answer.headers["www-authenticate"].startswith("Bearer")
    for open_to_all in ("/", "/livez", "/readyz", "/version", "/v1/limits", "/v1/presets", "/openapi.json"):
        assert guarded.http.get(open_to_all).status_code == 200
    assert guarded.http.get("/v1/limits").json()["keys_required"] is True
    with guarded.raw(b"POST /v1/jobs HTTP/1.1\r\nHost: localhost\r\nContent-Length: 500000\r\n\r\n") as connection:
        assert connection.recv(65536).startswith(b"HTTP/1.1 401")  # the body is not read


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
        answer = guarded.http.post("/v1/jobs", content=SMALL, params={"options": SLOW}, headers=alice)
        assert answer.status_code == 202
    answer = guarded.http.post("/v1/jobs", content=SMALL, headers=bearer("kissgs_a2"))
    assert problem(answer, 429, "too-many-jobs")["retryable"]
    assert "retry-after" in answer.headers
    assert guarded.http.post("/v1/jobs", content=SMALL, params={"options": FAST}, headers=bob).status_code == 202


def test_pages_of_other_sites_are_refused(service, start):
    """Browsers send forms to other sites without a preflight request, but with the origin of the page."""
    form = {"files": {"file": ("x.ply", SMALL)}, "data": {"options": FAST}}
    for origin in ("https://evil.example", "null", service.url.replace("127.0.0.1", "localhost")):
        answer = service.http.post("/v1/jobs", **form, headers={"Origin": origin})
        problem(answer, 403, "foreign")
    for method, path in (("POST", "/v1/jobs/" + "0" * 32 + "/cancel"), ("DELETE", "/v1/jobs/" + "0" * 32)):
        problem(service.http.request(method, path, headers={"Origin": "https://evil.example"}), 403, "foreign")
    accepted = [{"Origin": service.url}]
    for origin, host in (("LOCALHOST", "localhost"), ("localhost", "LocalHost")):  # host names are case-insensitive
        accepted.append({"Origin": f"http://{origin}:{service.port}", "Host": f"{host}:{service.port}"})
    for headers in accepted:
        answer = service.http.post("/v1/jobs", **form, headers=headers)
        assert answer.status_code == 202
        service.cancel(answer.json())
    asked = {"Origin": "https://good.example", "Access-Control-Request-Method": "POST"}
    assert "access-control-allow-origin" not in service.http.get("/version", headers=asked).headers
    allowed = start(KISSGS_CORS_ORIGINS="https://Good.example", KISSGS_NAMES="splats.example.org")
    answer = allowed.http.post("/v1/jobs", **form, headers={"Origin": "https://good.example"})
    assert answer.status_code == 202
    assert allowed.http.get("/version", headers=asked).headers["access-control-allow-origin"] == "https://good.example"
    other = allowed.http.get("/version", headers={**asked, "Origin": "https://example.com"})
    assert "access-control-allow-origin" not in other.headers
    assert allowed.http.options("/v1/jobs", headers=asked).status_code == 200
    assert allowed.http.get("/v1/jobs", headers={"Host": "splats.example.org"}).status_code == 200
    problem(allowed.http.get("/v1/jobs", headers={"Host": "evil.example"}), 403, "foreign")


def test_unknown_host_names_are_refused(service):
    """DNS rebinding: pages of a foreign name that resolves to this address would count as the same origin."""
    for host in ("evil.example", f"evil.example:{service.port}", "127.0.0.1.evil.example", ""):
        problem(service.http.get("/v1/jobs", headers={"Host": host}), 403, "foreign")
    for host in ("localhost", f"LOCALHOST:{service.port}", "127.0.0.1", f"[::1]:{service.port}"):
        assert service.http.get("/v1/jobs", headers={"Host": host}).status_code == 200
