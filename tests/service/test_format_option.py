"""The option ``format``: SOG-XT or SOG; oracle: the library's own compression, and its reader."""

import json
from types import SimpleNamespace
from typing import get_args

import pytest
from helpers.service import FAST, SMALL, problem

import kissgs
from kissgs.formats import CONTAINERS, ENDINGS
from service.core.files import CONTAINER_FILES, Format
from service.core.schemas import JobOptions
from service.http.submission import Submission

SOG = json.dumps({"preset": "fast", "format": "sog"})


@pytest.fixture(scope="module")
def local():
    return kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"), container="sog")


def test_the_names_are_those_of_the_library():
    assert get_args(Format) == CONTAINERS == tuple(CONTAINER_FILES)
    assert {file.ending: name for name, file in CONTAINER_FILES.items()} == ENDINGS
    assert JobOptions().format == "sogxt"


def test_the_result_is_the_library_s(service, local, tmp_path):
    assert service.http.get("/v1/limits").json()["containers"] == ["sogxt", "sog"]
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


def test_a_key_belongs_to_one_format(service):
    first = service.submit(options=SOG, **{"Idempotency-Key": "format-1"})
    assert service.submit(options=SOG, **{"Idempotency-Key": "format-1"})["id"] == first["id"]
    answer = service.http.post(
        "/v1/jobs", content=SMALL, params={"options": FAST}, headers={"Idempotency-Key": "format-1"}
    )
    problem(answer, 422, "key-reused")
    default = service.submit(**{"Idempotency-Key": "format-2"})
    explicit = json.dumps({"preset": "fast", "format": "sogxt"})
    assert service.submit(options=explicit, **{"Idempotency-Key": "format-2"})["id"] == default["id"]


def test_fingerprints_include_the_format():
    received = SimpleNamespace(sha256="0" * 64)
    fingerprints = {Submission(received, JobOptions(format=name), "a", None).fingerprint for name in CONTAINERS}
    assert len(fingerprints) == len(CONTAINERS)


@pytest.mark.parametrize("value", ["spz", "", ["sog"]])
def test_other_formats_are_refused(service, value):
    answer = service.http.post("/v1/jobs", content=SMALL, params={"options": json.dumps({"format": value})})
    found = problem(answer, 422, "invalid-request")
    assert "format" in found["detail"]
    assert "'sogxt' or 'sog'" in str(found["errors"])
