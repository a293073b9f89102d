"""Formats of uploads and of containers; oracle: the library's own compression of the same file."""

import dataclasses
import json

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_gltf import attributes, data_uri, document, glb_bytes
from helpers.reference_sog import sog_files, zip_of
from helpers.reference_splat import ksplat_bytes, splat_bytes
from helpers.reference_spz import spz_bytes
from helpers.service import FAST, SMALL, problem
from helpers.streamed_scenes import KINDS

import kissgs
from kissgs import Settings

SCENE = made_scene(40, 1, extremes=False)
FILES = {
    "a.sog": ("sog", zip_of(sog_files(SCENE))),
    "a3.spz": ("spz", spz_bytes(SCENE, 3)),
    "a4.spz": ("spz", spz_bytes(SCENE, 4)),
    "a.splat": ("splat", splat_bytes(SCENE)),
    "a.ksplat": ("ksplat", ksplat_bytes([SCENE], 1)),
    "a.glb": ("gltf", glb_bytes(*document(attributes(SCENE)))),
}


def send(service, name, data):
    return service.http.post("/v1/jobs", files={"file": (name, data)}, data={"options": FAST})


@pytest.mark.parametrize("name", FILES)
@pytest.mark.quick(2)
def test_uploads_of_every_format(service, name, tmp_path):
    kind, data = FILES[name]
    if kind == "sog":
        answer = service.http.post("/v1/jobs", content=data, params={"options": FAST, "name": name})
    else:
        answer = send(service, name, data)
    assert answer.status_code == 202, answer.text
    status = service.ended(answer.json())
    assert status["state"] == "succeeded", status
    assert (status["gaussians"], status["sh_degree"]) == (40, 0 if kind == "splat" else 1)
    assert (status["name"], status["source_format"]) == (name.split(".")[0], kind)
    (tmp_path / name).write_bytes(data)
    local = kissgs.compress(tmp_path / name, settings=Settings.from_preset("fast"))
    assert service.http.get(status["links"]["result"]).content == local.to_zip()
    source = service.http.get(status["links"]["source"])
    assert source.content == data
    assert f'filename="{name}"' in source.headers["content-disposition"]


def test_a_splat_that_begins_like_json(service):
    """The first byte of the file is a brace, and none of its first 512 bytes is zero."""
    data = b"{" + bytes(range(1, 32)) * 17
    assert service.ended(send(service, "a.splat", data[: 16 * 32]).json())["source_format"] == "splat"


ROOT, BUFFER = document(attributes(SCENE))
TEXT = json.dumps({**ROOT, "buffers": [{"byteLength": len(BUFFER), "uri": data_uri(BUFFER)}]}).encode()

REFUSED = {  # what is damaged is tested in tests/io; here, that the sentence names the upload and not its path
    **{f"a zip of levels, {name}": ("a.zip", zip_of(kind.files([[SCENE]]))) for name, kind in KINDS.items()},
    "a container": ("a.zip", kissgs.compress(SCENE, settings=Settings.from_preset("fast")).to_zip()),
    "a checkpoint, which needs torch": ("a.ckpt", zip_of({"archive/data.pkl": b""})),
    "text with the name of a .glb": ("a.glb", TEXT),
    "a .splat without its name": ("a.bin", splat_bytes(SCENE)),
    "half a .sog": ("a.sog", FILES["a.sog"][1][:-40]),
    "too many": ("a.spz", FILES["a4.spz"][1][:8] + (30_000).to_bytes(4, "little") + FILES["a4.spz"][1][12:]),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_refused_files_get_one_sentence(service, kind):
    answer = send(service, *REFUSED[kind])
    found = problem(answer, 422, answer.json()["code"])
    assert found["code"] in ("invalid-scene", "unsupported")
    assert "the upload" in found["detail"] or "the scene has 30,000 Gaussians" in found["detail"]
    assert ".part" not in found["detail"]
    assert "\n" not in found["detail"]


def test_damage_behind_the_headers_fails_the_job(service):
    """Headers are checked on arrival, the rest by the job."""
    damaged = FILES["a3.spz"][1][:-60]
    status = service.ended(send(service, "a.spz", damaged).json())
    assert (status["state"], status["problem"]["code"]) == ("failed", "invalid-scene")
    detail = status["problem"]["detail"]
    assert "is cut short" in detail
    assert "/" not in detail
    answer = service.http.get(f"/v1/jobs/{status['id']}/result")
    assert detail in problem(answer, 409, "not-succeeded")["detail"]
    direct = service.http.post("/v1/compress", content=damaged)
    assert problem(direct, 422, "invalid-scene")["detail"] == detail


def test_the_limits_name_the_formats(service):
    limits = service.http.get("/v1/limits").json()
    assert limits["formats"] == ["ply", "sog", "spz", "splat", "ksplat", "glb", "compressed.ply", "spz.glb"]
    assert limits["containers"] == ["sogxt", "sog", "spz", "compressed.ply"]


SOG = json.dumps({"preset": "fast", "format": "sog"})


def test_a_container_of_sog(service, tmp_path):
    local = kissgs.compress(SMALL, settings=Settings.from_preset("fast"), container="sog")
    job = service.ended(service.submit(options=SOG))
    assert job["options"]["format"] == "sog"
    answer = service.http.get(job["links"]["result"])
    assert answer.content == local.to_zip()
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"].startswith('attachment; filename="a scene.sog"')
    assert job["sizes"]["container"] == len(answer.content)
    assert job["sizes"]["files"] == local.report.file_bytes
    for name, data in local.files.items():
        assert service.http.get(job["links"]["files"].replace("{name}", name)).content == data
    answer = service.http.get(job["links"]["decoded"])
    assert 'filename="a scene.decoded.ply"' in answer.headers["content-disposition"]
    kissgs.decompress(local.to_zip(), tmp_path / "expected.ply")
    assert answer.content == (tmp_path / "expected.ply").read_bytes()


LARGE = dataclasses.replace(kissgs.sample_scene(60, sh_degree=1), scales=np.full((60, 3), 7.0, np.float32))


@pytest.mark.parametrize("kind", ["spz", "compressed.ply"])
def test_a_scene_in_another_format(service, kind, tmp_path):
    """Oracle: what kissgs convert writes and says, and kissgs evaluate of its file."""
    losses = kissgs.save(LARGE, tmp_path / f"x.{kind}")
    kissgs.save(LARGE, tmp_path / "x.ply")
    data = (tmp_path / "x.ply").read_bytes()
    job = service.ended(service.submit(data, json.dumps({"format": kind, "evaluate": True})))
    answer = service.http.get(job["links"]["result"])
    assert answer.content == (tmp_path / f"x.{kind}").read_bytes()
    assert f'filename="a scene.{kind}"' in answer.headers["content-disposition"]
    assert (job["kept"], job["sizes"]["container"], job["sizes"]["files"]) == (60, len(answer.content), {})
    assert "files" not in job["links"]
    assert job.get("note", "") == "; ".join(losses)
    assert bool(losses) == (kind == "spz")
    written = kissgs.load(tmp_path / f"x.{kind}")
    expected = kissgs.evaluate(LARGE, written).mean.candidate_vs_reference
    assert job["evaluation"]["psnr"] == pytest.approx(expected.psnr)
    kissgs.save(written, tmp_path / "decoded.ply")
    assert service.http.get(job["links"]["decoded"]).content == (tmp_path / "decoded.ply").read_bytes()


def test_a_scene_that_was_moved_is_compared_in_its_place(service, tmp_path):
    """Regression: PSNR of 12 dB, because the file does not record its origin."""
    scene = kissgs.sample_scene(60, sh_degree=1)
    kissgs.save(dataclasses.replace(scene, means=scene.means + np.float32([4000, 0, 0])), tmp_path / "x.ply")
    options = {"format": "compressed.ply", "evaluate": True, "origin": "auto"}
    job = service.ended(service.submit((tmp_path / "x.ply").read_bytes(), json.dumps(options)))
    assert job["evaluation"]["psnr"] > 40


CHANGES = {
    "a goal": {"encode": {"quality": "same"}},
    "an offset": {"encode": {"quality_offset_db": 3}},
    "a time limit": {"time_limit": 9},
    "fine-tuning": {"finetune": {"enabled": True}},
    "compaction": {"compact": {"ratio": 0.5}},
}


@pytest.mark.parametrize("change", CHANGES)
def test_other_formats_hold_the_scene_as_it_is(service, change):
    options = json.dumps({"format": "spz", **CHANGES[change]})
    answer = service.http.post("/v1/jobs", content=SMALL, params={"options": options})
    assert "format spz holds the scene as it is" in problem(answer, 422, "invalid-request")["detail"]
