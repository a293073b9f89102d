"""Files of succeeded jobs over HTTP; oracles: kissgs.compress of the scene, and the specifications of HTTP headers."""

import base64
import dataclasses
import hashlib
import io
import json
import zipfile

import numpy as np
import pytest
from helpers.service import SMALL, ply_bytes, problem
from PIL import Image

import kissgs
from kissgs.rendering.camera import look_at

SCENE = kissgs.sample_scene(300, sh_degree=1)


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
    assert job["links"]["preview"] == f"/preview/{job['id']}"


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
    assert without(head.headers, "date", "x-request-id") == without(get.headers, "date", "x-request-id")
    assert int(head.headers["content-length"]) == len(get.content)


def without(values, *names):
    return {name: value for name, value in values.items() if name not in names}


def test_ranges(service, job, local):
    full = local.to_zip()
    last = len(full) - 7
    for requested, start, end in (("0-3", 0, 4), ("10-", 10, None), ("-7", last, None), ("5-99999999", 5, None)):
        answer = service.http.get(job["links"]["result"], headers={"Range": f"bytes={requested}"})
        assert (answer.status_code, answer.content) == (206, full[start:end])
        assert answer.headers["content-range"] == f"bytes {start}-{start + len(answer.content) - 1}/{len(full)}"
        assert "content-digest" not in answer.headers  # it would be the digest of the range
        assert "repr-digest" in answer.headers
    for requested in ("bytes=99999999-", "bytes=-0"):
        answer = service.http.get(job["links"]["result"], headers={"Range": requested})
        problem(answer, 416, "range")
        assert answer.headers["content-range"] == f"bytes */{len(full)}"
    tag = service.http.head(job["links"]["result"]).headers["etag"]
    same = service.http.get(job["links"]["result"], headers={"Range": "bytes=0-3", "If-Range": tag})
    assert same.status_code == 206
    ignored = "bytes=3-1", "bytes=a-b", "lines=1-2", "bytes=0-1,4-5", "bytes", "bytes=-", "bytes=" + "9" * 50 + "-"
    for headers in ({"Range": "bytes=0-3", "If-Range": '"other"'}, *({"Range": each} for each in ignored)):
        answer = service.http.get(job["links"]["result"], headers=headers)
        assert (answer.status_code, answer.content) == (200, full), headers


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


def test_unknown_file_names(service, job):
    others = "summary.json", "nothing", "META.JSON", "files", "%00"
    for name in (*others, "..%2fscene.zip", "..%2Freport.json", "%2e%2e%2f%2e%2e"):
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
    assert without(report, *volatile) == without(expected, *volatile)


def thumbnail_of(service, job):
    answer = service.http.get(f"/v1/jobs/{job['id']}/thumbnail.webp")
    assert (answer.status_code, answer.headers["content-type"]) == (200, "image/webp")
    assert job["links"]["thumbnail"].endswith("/thumbnail.webp")
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGB"), np.float32) / 255


@pytest.mark.parametrize("origin", [None, "auto"])
def test_the_thumbnail_is_the_recorded_view(service, origin):
    """Oracle: the decoded container, drawn from the view in its metadata as format.md defines it."""
    few = {"sensitivity_views": 4, "sensitivity_view_size": 48}
    options = {"encode": few, "origin": origin, "for_research": True}
    far = dataclasses.replace(SCENE, means=SCENE.means + np.float32([4000, 0, 0]))
    job = service.ended(service.submit(ply_bytes(far), json.dumps(options)))
    own = service.http.get(job["links"]["files"].replace("{name}", "meta.json")).json()["kissgs"]
    assert ("origin" in own) == (origin is not None)
    view = {name: np.array(value) for name, value in own["view"].items()}
    angle = 2 * np.arctan(np.tan(np.radians(view["fov"]) / 2) * 4 / 3)  # from side to side
    camera = look_at(view["eye"], view["target"], view["up"], fov=angle, width=320, height=240)
    splats = kissgs.decompress(service.http.get(job["links"]["result"]).content)
    near = dataclasses.replace(splats, means=splats.means - np.float32(own.get("origin", (0, 0, 0))))
    expected = np.clip(kissgs.render(near, camera)[0], 0, 1)
    assert expected.std() > 0.05
    assert np.abs(thumbnail_of(service, job) - expected).mean() < 0.01


def test_every_result_with_gaussians_has_a_thumbnail(service, job):
    assert thumbnail_of(service, job).std() > 0.05  # the preset fast records no view
    empty = dataclasses.replace(SCENE, opacities=np.full_like(SCENE.opacities, -30))
    job = service.ended(service.submit(ply_bytes(empty)))
    assert (job["kept"], "thumbnail" in job["links"]) == (0, False)
    problem(service.http.get(f"/v1/jobs/{job['id']}/thumbnail.webp"), 404, "not-found")


def test_a_job_succeeds_without_a_thumbnail(service, monkeypatch):
    """Regression: a job whose result was complete failed where its image could not be drawn."""

    def fail(*given):
        raise MemoryError

    monkeypatch.setattr("service.jobs.job_process._thumbnail", fail)
    job = service.ended(service.submit())
    assert (job["state"], "thumbnail" in job["links"]) == ("succeeded", False)
    problem(service.http.get(f"/v1/jobs/{job['id']}/thumbnail.webp"), 404, "not-found")
