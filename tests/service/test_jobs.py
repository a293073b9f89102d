"""Submission of jobs over HTTP, with every kind of options; oracle: kissgs.compress of the scene."""

import json

import pytest
from helpers.service import FAST, SMALL, problem, scene_bytes

import kissgs
from service.core.problems import ProblemError
from service.http.submission import parse_options
from service.http.uploads import scene_name


def test_submitting_a_raw_body(service):
    body = iter([SMALL[:5000], SMALL[5000:]])
    answer = service.http.post("/v1/jobs", content=body, params={"options": FAST, "name": "/etc/pass wd.PLY"})
    assert answer.request.headers["transfer-encoding"] == "chunked"
    assert answer.status_code == 202
    status = answer.json()
    assert answer.headers["location"] == status["links"]["self"] == f"/v1/jobs/{status['id']}"
    assert 1 <= int(answer.headers["retry-after"]) <= 60
    assert (status["name"], status["gaussians"], status["sh_degree"]) == ("pass wd", 300, 1)
    assert status["options"]["preset"] == "fast"
    assert status["state"] in ("queued", "running")
    assert service.ended(status)["state"] == "succeeded"
    assert service.http.get("/v1/limits").json()["training"] is True
    held = service.hold()  # so that the next one need not run
    status = service.http.post("/v1/jobs", files={"file": ("x.ply", SMALL)}).json()
    assert (status["options"]["preset"], status["options"]["evaluate"]) == ("balanced", False)
    service.cancel(status)
    service.cancel(held)


@pytest.mark.parametrize("first", ["file", "options"])
@pytest.mark.quick(1)
def test_submitting_a_form(service, first):
    parts = {"file": ("Schloß.ply", SMALL), "options": (None, '{"preset": "fast", "encode": {"seed": 3}}')}
    parts = dict(sorted(parts.items(), reverse=first == "options"))
    answer = service.http.post("/v1/jobs", files=parts)
    assert answer.status_code == 202, answer.text
    status = answer.json()
    assert (status["name"], status["options"]["preset"], status["options"]["encode"]["seed"]) == ("Schloß", "fast", 3)
    status = service.ended(status)
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.from_preset("fast", seed=3)).to_zip()
    assert service.http.get(status["links"]["result"]).content == expected


def test_fewer_gaussians(service):
    changes = {"method": "prune", "count": 100, "sparsify_steps": 4, "refine_steps": 4, "views": 24, "view_size": 48}
    options = {"preset": "fast", "compact": changes, "for_research": True}
    status = service.ended(service.submit(options=json.dumps(options)))
    expected = kissgs.compress(SMALL, settings=kissgs.Settings.model_validate(options))
    assert (status["state"], status["compacted"], status["kept"]) == ("succeeded", 200, expected.report.count)
    assert status["timings"]["stages"].keys() >= {"score", "targets", "sparsify", "refine"}
    assert service.http.get(status["links"]["result"]).content == expected.to_zip()
    report = service.http.get(status["links"]["report"]).json()
    counts = [step["count"] for step in report["compaction"]["steps"]]
    assert (counts[0], counts[-1]) == (300, 100)


def test_training_needs_torch(monkeypatch):
    monkeypatch.setattr("service.http.submission.can_train", lambda: False)
    with pytest.raises(ProblemError, match="need torch, which this server does not have"):
        parse_options('{"compact": {"ratio": 0.2}}')
    assert parse_options('{"preset": "fast", "compact": {"ratio": 0.2}}').kind == "fast+compact"
    assert parse_options("{}").kind == "balanced"
    assert parse_options('{"encode": {"target_size": "1MB"}}').kind == "balanced+search"
    monkeypatch.undo()
    assert parse_options('{"encode": {"max_psnr_drop": 0.5}}').kind == "balanced+compact+finetune+search"
    for compact, resumable in (({"ratio": 0.2}, True), ({"count": 9}, True), ({"max_psnr_drop": 0.2}, False)):
        assert parse_options(json.dumps({"compact": compact})).resumable == resumable
        assert not parse_options(json.dumps({"preset": "fast", "compact": compact})).resumable
    assert not parse_options('{"encode": {"psnr": 40}, "compact": {"auto_count": true}}').resumable


def test_evaluating(service):
    job = service.submit(options='{"preset": "fast", "evaluate": true}')
    evaluation = service.ended(job, seconds=120)["evaluation"]
    expected = kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"), evaluate=True).report.evaluation
    assert evaluation["psnr"] == pytest.approx(expected.mean.candidate_vs_reference.psnr, abs=1e-6)
    assert evaluation["worst"] == json.loads(json.dumps(expected.worst.pose_as_dict()))
    assert evaluation["fifth_percentile"] == pytest.approx(expected.fifth_percentile, abs=1e-6)
    assert evaluation["detail"]["worst"] == pytest.approx(expected.detail.worst, abs=1e-6)
    assert evaluation["shown"] == pytest.approx(expected.shown)


def test_an_idempotency_key_makes_one_job(service):
    formats = [json.dumps({"preset": "fast", "format": name}) for name in ("sogxt", "sog")]
    first = service.submit(**{"Idempotency-Key": "key-1"})
    for options in (FAST, formats[0]):  # which is the default
        assert service.submit(options=options, **{"Idempotency-Key": "key-1"})["id"] == first["id"]
    other = service.submit(**{"Idempotency-Key": "key-2"})
    assert other["id"] != first["id"]
    service.cancel(other)
    headers = {"Idempotency-Key": "key-1"}
    for data, options in ((SMALL, "{}"), (SMALL, formats[1]), (scene_bytes(seed=1), FAST)):
        answer = service.http.post("/v1/jobs", content=data, params={"options": options}, headers=headers)
        problem(answer, 422, "key-reused")
    assert service.uploads() == []


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        *(
            ("../../x.ply", "x"),
            ("a\\b.ply", "b"),
            ("c.compressed.ply", "c"),
            ("d.spz.glb", "d"),
            ("e.ply.spz", "e.ply"),
        ),
        *(("…", "…"), ("\u202etxt", "txt"), ("", "scene"), (".ply", "scene")),
        *(("n" * 300 + ".ply", "n" * 100), ("a\r\nX: 1\0.ply", "aX 1"), ('<b>".ply', "b"), ("/", "scene")),
    ],
)
def test_names_are_sanitised(given, kept):
    assert scene_name(given) == kept
