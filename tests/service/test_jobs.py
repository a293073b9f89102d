"""Jobs over HTTP; oracles: kissgs.compress of the scene, and the specifications of HTTP headers."""

import base64
import hashlib
import io
import json
import re
import shutil
import subprocess
import time
import zipfile
from urllib.parse import quote

import pytest
from helpers.service import FAST, ROOT, SLOW, SMALL, events, problem, scene_bytes

import kissgs
from service.core.problems import ProblemError
from service.http.routes.common import accepts
from service.http.submission import parse_options


@pytest.fixture(scope="module")
def job(service):
    return service.ended(service.submit())


@pytest.fixture(scope="module")
def local():
    """Compress the scene without a service."""
    return kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"))


def test_submitting_a_raw_body(service):
    answer = service.http.post("/v1/jobs", content=SMALL, params={"options": FAST, "name": "/etc/pass wd.PLY"})
    assert answer.status_code == 202
    status = answer.json()
    assert answer.headers["location"] == status["links"]["self"] == f"/v1/jobs/{status['id']}"
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    assert (status["name"], status["gaussians"], status["sh_degree"]) == ("pass wd", 300, 1)
    assert status["options"]["preset"] == "fast"
    assert status["state"] in ("queued", "running")
    assert service.ended(status)["state"] == "succeeded"


@pytest.mark.parametrize("first", ["file", "options"])
@pytest.mark.quick(1)
def test_submitting_a_form(service, first):
    parts = {"file": ("Schloß.ply", SMALL), "options": (None, '{"preset": "small", "encode": {"seed": 3}}')}
    parts = dict(sorted(parts.items(), reverse=first == "options"))
    answer = service.http.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    status = answer.json()
    assert (status["name"], status["options"]["preset"], status["options"]["encode"]["seed"]) == ("Schloß", "small", 3)
    status = service.ended(status)
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.from_preset("small", seed=3)).to_zip()
    assert service.http.get(status["links"]["result"]).content == expected


def test_fewer_gaussians(service):
    options = {"preset": "fast", "compact": {"ratio": 0.5, "views": 24, "view_size": 48}}
    status = service.ended(service.submit(options=json.dumps(options)))
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(options))
    assert (status["compacted"], status["kept"]) == (150, expected.report.count)
    assert service.http.get(status["links"]["result"]).content == expected.to_zip()
    report = service.http.get(status["links"]["report"]).json()
    assert [step["count"] for step in report["compaction"]["steps"]] == [300, 150]


def test_training_in_a_job(service):
    changes = {"count": 100, "sparsify_steps": 4, "refine_steps": 4, "views": 24, "view_size": 48}
    status = service.ended(service.submit(options=json.dumps({"preset": "fast", "compact": changes})))
    assert (status["state"], status["compacted"]) == ("succeeded", 200)
    assert status["timings"]["stages"].keys() >= {"score", "targets", "sparsify", "refine"}


@pytest.mark.parametrize(
    "compact",
    [{"ratio": 2}, {"count": 0}, {"count": 5, "ratio": 0.1}, {"max_psnr_drop": -1}, {"speed": 1}, {"auto_count": True}],
)
def test_invalid_budgets_are_refused(service, compact):
    answer = service.http.post("/v1/jobs", content=SMALL, params={"options": json.dumps({"compact": compact})})
    problem(answer, 422, "invalid-request")


def test_training_needs_torch(monkeypatch):
    monkeypatch.setattr("service.http.submission.can_train", lambda: False)
    with pytest.raises(ProblemError, match="need torch, which this server does not have"):
        parse_options('{"compact": {"ratio": 0.2}}')
    assert parse_options('{"preset": "fast", "compact": {"ratio": 0.2}}').kind == "fast+compact"
    assert parse_options("{}").kind == "balanced"
    assert parse_options('{"encode": {"target_size": "1MB"}}').kind == "balanced+search"


@pytest.mark.parametrize(
    ("compact", "resumable"),
    [({"ratio": 0.2}, True), ({"count": 9}, True), ({"max_psnr_drop": 0.2}, False), ({}, False)],
)
def test_resumable_options(compact, resumable):
    assert parse_options(json.dumps({"compact": compact})).resumable == resumable
    assert not parse_options(json.dumps({"preset": "fast", "compact": compact})).resumable


@pytest.mark.quick(0)
def test_goals_and_count_search(service):
    prune = {
        "auto_count": True,
        "max_compactions": 1,
        "sparsify_steps": 0,
        "refine_steps": 0,
        "views": 24,
        "view_size": 48,
    }
    options = {"encode": {"target_size": "6kB", "sensitivity_views": 4, "sensitivity_view_size": 48}, "compact": prune}
    assert not parse_options(json.dumps(options)).resumable
    status = service.ended(service.submit(options=json.dumps(options)))
    assert status["state"] == "succeeded", status
    assert status["sizes"]["container"] <= 6000
    report = service.http.get(status["links"]["report"]).json()
    assert len({trial["count"] for trial in report["trials"]}) > 1
    lost = service.ended(service.submit(options=json.dumps({"encode": {"max_psnr_drop": 0.5, "sensitivity_views": 4}})))
    assert lost["state"] == "succeeded", lost


def test_limits_say_if_training_is_possible(service):
    assert service.http.get("/v1/limits").json()["training"] is True


def test_the_options_are_optional(service):
    status = service.http.post("/v1/jobs", files={"file": ("x.ply", SMALL)}).json()
    assert (status["options"]["preset"], status["options"]["evaluate"]) == ("balanced", False)


def test_a_body_without_a_length(service):
    answer = service.http.post("/v1/jobs", content=iter([SMALL[:5000], SMALL[5000:]]), params={"options": FAST})
    assert answer.request.headers["transfer-encoding"] == "chunked"
    assert service.ended(answer.json())["state"] == "succeeded"


def test_the_status_equals_the_report(service, job, local):
    report = local.report
    assert (job["state"], job["kept"], job["invisible"]) == ("succeeded", report.count, report.invisible)
    assert job["cleaned"] == report.as_dict()["cleaned"]
    assert job["sizes"]["files"] == report.file_bytes
    assert job["sizes"]["container"] == report.container_bytes
    assert job["upload_bytes"] == len(SMALL)
    assert job["sizes"]["ratio"] == pytest.approx(report.ratio)
    assert set(job["timings"]["stages"]) >= {"read", "order", "images"}
    assert job["timings"]["created_at"] <= job["timings"]["started_at"] <= job["timings"]["finished_at"]
    assert job["timings"]["finished_at"] < job["expires_at"]
    assert "progress" not in job
    assert "estimate" not in job
    assert "cancel" not in job["links"]


def test_every_link_works(service, job):
    for name, link in job["links"].items():
        for file in job["sizes"]["files"] if name == "files" else [""]:
            answer = service.http.get(link.replace("{name}", file))
            assert answer.status_code == 200, (name, answer.text)


def test_the_result_is_the_container_of_the_library(service, job, local):
    answer = service.http.get(job["links"]["result"])
    assert answer.content == local.to_zip()
    assert answer.headers["content-type"] == "application/zip"
    assert (
        answer.headers["content-disposition"] == "attachment; filename=\"a scene.zip\"; filename*=UTF-8''a%20scene.zip"
    )
    digest = hashlib.sha256(answer.content)
    assert answer.headers["etag"] == f'"{digest.hexdigest()}"'
    expected = f"sha-256=:{base64.b64encode(digest.digest()).decode()}:"
    assert answer.headers["content-digest"] == answer.headers["repr-digest"] == expected
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None


@pytest.mark.parametrize("name", ["result", "report", "source", "decoded"])
def test_head_equals_get_without_a_body(service, job, name):
    get, head = service.http.get(job["links"][name]), service.http.head(job["links"][name])
    assert head.content == b""
    volatile = ("date", "x-request-id")
    assert {k: v for k, v in head.headers.items() if k not in volatile} == {
        k: v for k, v in get.headers.items() if k not in volatile
    }
    assert int(head.headers["content-length"]) == len(get.content)


@pytest.mark.parametrize(
    ("requested", "slice_"),
    [
        ("bytes=0-3", slice(0, 4)),
        ("bytes=10-", slice(10, None)),
        ("bytes=-7", slice(-7, None)),
        ("bytes=5-99999999", slice(5, None)),
    ],
)
def test_ranges(service, job, local, requested, slice_):
    answer = service.http.get(job["links"]["result"], headers={"Range": requested})
    full = local.to_zip()
    assert (answer.status_code, answer.content) == (206, full[slice_])
    start = slice_.indices(len(full))[0]
    assert answer.headers["content-range"] == f"bytes {start}-{start + len(answer.content) - 1}/{len(full)}"
    assert "content-digest" not in answer.headers  # it would be the digest of the range
    assert "repr-digest" in answer.headers


def test_if_range(service, job, local):
    tag = service.http.head(job["links"]["result"]).headers["etag"]
    same = service.http.get(job["links"]["result"], headers={"Range": "bytes=0-3", "If-Range": tag})
    other = service.http.get(job["links"]["result"], headers={"Range": "bytes=0-3", "If-Range": '"other"'})
    assert (same.status_code, other.status_code) == (206, 200)
    assert other.content == local.to_zip()


@pytest.mark.parametrize(
    "requested", ["bytes=3-1", "bytes=a-b", "lines=1-2", "bytes=0-1,4-5", "bytes", "bytes=-", "bytes=" + "9" * 50 + "-"]
)
def test_invalid_ranges_are_ignored(service, job, local, requested):
    answer = service.http.get(job["links"]["result"], headers={"Range": requested})
    assert (answer.status_code, answer.content) == (200, local.to_zip())


@pytest.mark.parametrize("requested", ["bytes=99999999-", "bytes=-0"])
def test_ranges_outside_the_file(service, job, requested):
    answer = service.http.get(job["links"]["result"], headers={"Range": requested})
    problem(answer, 416, "range")
    assert answer.headers["content-range"] == f"bytes */{job['sizes']['container']}"


def test_if_none_match(service, job):
    tag = service.http.head(job["links"]["result"]).headers["etag"]
    for sent in (tag, f'"x", W/{tag}', "*"):
        answer = service.http.get(job["links"]["result"], headers={"If-None-Match": sent})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", tag)
    assert service.http.get(job["links"]["result"], headers={"If-None-Match": '"x"'}).status_code == 200


def test_files_by_name(service, job, local):
    for name, data in local.files.items():
        answer = service.http.get(job["links"]["files"].replace("{name}", name))
        assert answer.content == data
        assert "immutable" in answer.headers["cache-control"]
        kinds = {"webp": "image/webp", "json": "application/json", "yaml": "application/yaml"}
        assert answer.headers["content-type"].split(";")[0] == kinds[name.rsplit(".")[-1]]


@pytest.mark.parametrize(
    "name",
    ["summary.json", "..%2fscene.zip", "..%2Freport.json", "%2e%2e%2f%2e%2e", "nothing", "META.JSON", "files", "%00"],
)
def test_unknown_file_names(service, job, name):
    problem(service.http.get(f"/v1/jobs/{job['id']}/files/{name}"), 404, "not-found")


def test_the_decoded_scene(service, job, local, tmp_path):
    answer = service.http.get(job["links"]["decoded"])
    kissgs.decompress(local.files, tmp_path / "expected.ply")
    assert answer.content == (tmp_path / "expected.ply").read_bytes()
    again = service.http.get(job["links"]["decoded"])
    assert again.headers["etag"] == answer.headers["etag"] == f'"{hashlib.sha256(again.content).hexdigest()}"'


def test_the_source_and_the_report(service, job, local):
    assert service.http.get(job["links"]["source"]).content == SMALL
    report = service.http.get(job["links"]["report"]).json()
    expected = json.loads(json.dumps(local.report.as_dict()))
    volatile = ("seconds", "cpu_seconds", "peak_memory")
    assert {k: v for k, v in report.items() if k not in volatile} == {
        k: v for k, v in expected.items() if k not in volatile
    }


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
    assert all(0 <= data["fraction"] <= 1 for _, kind, data in found if kind == "progress")
    assert found[-1][2]["job"]["sizes"] == service.status(job)["sizes"]


def test_events_resume_after_the_last_id(service, job):
    all_events = events(service.http.get(job["links"]["events"]).text)
    for last in range(1, len(all_events)):
        rest = service.http.get(job["links"]["events"], headers={"Last-Event-ID": str(last)})
        assert events(rest.text) == all_events[last:]
    over = service.http.get(job["links"]["events"], headers={"Last-Event-ID": str(len(all_events))})
    assert (over.status_code, over.content) == (204, b"")
    problem(service.http.get(job["links"]["events"], headers={"Last-Event-ID": "x"}), 422, "invalid-request")


def test_events_arrive_as_they_happen(start):
    service = start()
    job = service.submit(scene_bytes(20_000, 3), SLOW)
    with service.http.stream("GET", job["links"]["events"]) as answer:
        for line in answer.iter_lines():
            if line.startswith("data: ") and json.loads(line[6:]).get("stage") == "order":
                break
        assert service.status(job)["state"] == "running"
    service.http.post(job["links"]["cancel"])


def test_a_long_poll_ends_with_the_job(service):
    job = service.submit()
    assert service.status(job, wait=30)["state"] == "succeeded"
    begun = time.monotonic()
    assert service.status(job, wait=30)["state"] == "succeeded"
    assert time.monotonic() - begun < 5


def test_a_long_poll_ends_with_its_time(start):
    service = start()
    job = service.submit(scene_bytes(20_000, 3), SLOW)
    begun = time.monotonic()
    assert service.status(job, wait=1)["state"] in ("queued", "running")
    assert 0.9 < time.monotonic() - begun < 5


def test_listing(start):
    service = start()
    submitted = [service.ended(service.submit())["id"] for _ in range(3)]
    page = service.http.get("/v1/jobs", params={"limit": 2}).json()
    assert [job["id"] for job in page["jobs"]] == submitted[:0:-1]
    rest = service.http.get("/v1/jobs", params={"limit": 2, "cursor": page["next"]}).json()
    assert [job["id"] for job in rest["jobs"]] == submitted[:1]
    assert "next" not in rest
    assert service.http.get("/v1/jobs", params={"state": "failed"}).json() == {"jobs": []}
    assert len(service.http.get("/v1/jobs", params={"state": "succeeded"}).json()["jobs"]) == 3
    for wrong in ({"limit": 0}, {"limit": 101}, {"cursor": "x"}, {"state": "lost"}):
        problem(service.http.get("/v1/jobs", params=wrong), 422, "invalid-request")


def test_the_queue_is_in_order_and_has_positions(start):
    service = start()
    first, *others = service.occupy()
    waiting = [service.submit() for _ in range(3)]
    assert [service.status(job)["position"] for job in waiting] == [1, 2, 3]
    left = [service.status(job)["estimate"]["seconds_left"] for job in (first, *waiting)]
    assert left == sorted(left)
    for job in (first, *others):
        service.http.post(job["links"]["cancel"])
    ended = [service.ended(job) for job in waiting]
    started = [job["timings"]["started_at"] for job in ended]
    assert started == sorted(started)


def test_cancelling_stops_the_work(start):
    service = start()
    job = service.submit(scene_bytes(20_000, 3), SLOW)
    service.running(job)
    begun = time.monotonic()
    answer = service.http.post(job["links"]["cancel"])
    assert time.monotonic() - begun < 2
    assert answer.json()["state"] == "cancelled"
    assert service.children() == []
    assert "problem" not in answer.json()
    assert service.http.post(job["links"]["cancel"] or "").json()["state"] == "cancelled"  # no change
    problem(service.http.get(f"/v1/jobs/{job['id']}/result"), 409, "not-succeeded")
    assert job["id"] not in service.stored()
    assert service.ended(service.submit())["state"] == "succeeded"  # the worker continues


def test_cancelling_queued_and_ended_jobs(start):
    service = start()
    running, waiting = service.submit(scene_bytes(20_000, 3), SLOW), service.submit()
    assert service.http.post(waiting["links"]["cancel"]).json()["state"] == "cancelled"
    service.http.post(running["links"]["cancel"])
    done = service.ended(service.submit())
    assert service.http.post(f"/v1/jobs/{done['id']}/cancel").json() == service.status(done)


def test_deleting(start):
    service = start()
    done, running = service.ended(service.submit()), service.submit(scene_bytes(20_000, 3), SLOW)
    service.running(running)
    for job in (done, running):
        assert service.http.delete(f"/v1/jobs/{job['id']}").status_code == 204
        problem(service.http.get(f"/v1/jobs/{job['id']}"), 404, "not-found")
        problem(service.http.delete(f"/v1/jobs/{job['id']}"), 404, "not-found")
    assert service.children() == []
    assert service.stored() == set()


def test_results_of_active_jobs(start):
    service = start()
    job = service.submit(scene_bytes(20_000, 3), SLOW)
    for name in ("result", "report", "decoded", "source", "files/meta.json"):
        answer = service.http.get(f"/v1/jobs/{job['id']}/{name}")
        assert problem(answer, 409, "not-finished")["retryable"]
        assert int(answer.headers["retry-after"]) >= 1


def test_synchronous_compression(service, local):
    answer = service.http.post("/v1/compress", content=SMALL, params={"options": FAST})
    assert (answer.status_code, answer.content) == (200, local.to_zip())
    job = service.http.get(answer.headers["link"].split(";")[0].strip("<>")).json()
    assert job["links"]["result"] == answer.headers["content-location"]


def test_synchronous_compression_becomes_a_job_after_the_time_limit(start):
    service = start(KISSGS_SYNC_SECONDS=0.5)
    answer = service.http.post("/v1/compress", content=scene_bytes(20_000, 3), params={"options": SLOW})
    assert answer.status_code == 202
    assert answer.headers["location"] == answer.json()["links"]["self"]
    assert answer.json()["state"] in ("queued", "running")
    assert service.status(answer.json())["state"] in ("queued", "running")


def test_a_client_that_only_accepts_zip_gets_an_error_after_the_time_limit(start):
    service = start(KISSGS_SYNC_SECONDS=0.5)
    answer = service.http.post(
        "/v1/compress",
        content=scene_bytes(20_000, 3),
        params={"options": SLOW},
        headers={"Accept": "application/zip"},
    )
    found = problem(answer, 409, "not-finished")
    assert int(answer.headers["retry-after"]) >= 1
    job = service.http.get(answer.headers["location"]).json()
    assert job["state"] in ("queued", "running")
    assert job["links"]["self"] in found["detail"]


@pytest.mark.parametrize(
    ("headers", "allowed"),
    [
        ([], True),
        ([""], True),
        (["*/*"], True),
        (["application/zip"], False),
        (["application/zip, */*"], True),
        (["application/zip", "application/json"], True),
        (["application/*"], True),
        (["Application/JSON; charset=utf-8"], True),
        (["application/json;q=0, */*"], False),
        (["application/json; Q=0.000, application/*"], False),
        (["application/*;q=0, application/json;q=0.1"], True),
        (["text/html, application/problem+json"], False),
        (["application/json;q=nonsense"], True),
        (["*/*;q=0"], False),
        ([",;,;q=1"], True),
    ],
)
def test_accept_headers(headers, allowed):
    """Oracle: RFC 9110, section 12.5.1."""
    assert accepts(headers, "application/json") is allowed


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_documented_command_never_overwrites_a_good_container(start, local, tmp_path):
    """A 202 answer once replaced a good scene.zip with the job's status, and curl exited with 0."""
    page = (ROOT / "docs" / "guide" / "service.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^\$ (curl .*/v1/compress.*)", page.replace("\\\n", ""), re.MULTILINE)
    service = start(KISSGS_SYNC_SECONDS=30)
    hasty = start(KISSGS_SYNC_SECONDS=0.5)
    target = tmp_path / "scene.zip"
    target.write_bytes(b"a good container")

    def run(service, scene, options):
        (tmp_path / "scene.ply").write_bytes(scene)
        address = f"'{service.url}/v1/compress?options={quote(options)}'"
        line = command.replace("localhost:8000/v1/compress", address)
        return subprocess.run(["sh", "-c", line], cwd=tmp_path, capture_output=True, check=False).returncode

    for scene, options, code in ((scene_bytes(20_000, 3), SLOW, "not-finished"), (b"ply\n", FAST, "invalid-scene")):
        assert run(hasty, scene, options) != 0
        assert target.read_bytes() == b"a good container"
        assert json.loads((tmp_path / "scene.zip.part").read_text())["code"] == code
    assert run(service, SMALL, FAST) == 0
    assert target.read_bytes() == local.to_zip()


def test_evaluating(service):
    job = service.submit(options='{"preset": "fast", "evaluate": true}')
    evaluation = service.ended(job, seconds=120)["evaluation"]
    expected = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"), evaluate=True).report.evaluation
    assert evaluation["psnr"] == pytest.approx(expected.mean.candidate_vs_reference.psnr, abs=1e-6)
    assert evaluation["worst"] == json.loads(json.dumps(expected.worst.pose_as_dict()))
    assert evaluation["fifth_percentile"] == pytest.approx(expected.fifth_percentile, abs=1e-6)
    assert evaluation["shown"] == pytest.approx(expected.shown)


def test_an_idempotency_key_makes_one_job(service):
    first = service.submit(**{"Idempotency-Key": "key-1"})
    again = service.submit(**{"Idempotency-Key": "key-1"})
    assert first["id"] == again["id"]
    assert service.submit(**{"Idempotency-Key": "key-2"})["id"] != first["id"]
    for data, options in ((SMALL, "{}"), (scene_bytes(seed=1), FAST)):
        answer = service.http.post(
            "/v1/jobs", content=data, params={"options": options}, headers={"Idempotency-Key": "key-1"}
        )
        problem(answer, 422, "key-reused")
    assert service.uploads() == []


def test_names_are_sanitised(service):
    for name, kept in {
        "../../x.ply": "x",
        "a\\b.ply": "b",
        "c.compressed.ply": "c",
        "d.spz.glb": "d",
        "e.ply.spz": "e.ply",
        "…": "…",
        "\u202etxt": "txt",
        "": "scene",
        ".ply": "scene",
    }.items():
        answer = service.http.post("/v1/jobs", content=SMALL, params={"options": FAST, "name": name})
        assert answer.json()["name"] == kept
