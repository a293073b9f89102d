"""The option ``format``: SOG-XT or SOG; oracle: the library's own compression, and its reader."""

import json
from types import SimpleNamespace
from typing import get_args

import numpy as np
import pytest
from helpers.service import FAST, SMALL, problem

import kissgs
from kissgs.core.splats import ATTRIBUTES
from kissgs.formats import CONTAINERS, ENDINGS
from service.core.files import CONTAINER_FILES, Format
from service.core.schemas import JobOptions
from service.http.submission import Submission

SOG = json.dumps({"preset": "fast", "format": "sog"})


def compressed(container):
    return kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"), container=container)


@pytest.fixture(scope="module")
def local():
    return compressed("sog")


@pytest.fixture(scope="module")
def job(service):
    return service.ended(service.submit(options=SOG))


def test_the_names_are_those_of_the_library():
    assert get_args(Format) == CONTAINERS == tuple(CONTAINER_FILES)
    assert {file.ending: name for name, file in CONTAINER_FILES.items()} == ENDINGS
    assert JobOptions().format == "sogxt"


def test_the_limits_name_the_containers(service):
    assert service.http.get("/v1/limits").json()["containers"] == ["sogxt", "sog"]


def test_the_result_is_the_library_s(service, job, local):
    assert job["options"]["format"] == "sog"
    answer = service.http.get(job["links"]["result"])
    assert answer.content == local.to_zip()
    assert answer.headers["content-type"] == "application/octet-stream"
    assert answer.headers["content-disposition"].startswith('attachment; filename="a scene.sog"')
    assert job["sizes"]["container"] == len(answer.content)
    assert job["sizes"]["files"] == local.report.file_bytes
    assert service.http.head(job["links"]["result"]).headers["content-type"] == "application/octet-stream"


def test_the_files_and_the_decoded_scene(service, job, local, tmp_path):
    for name, data in local.files.items():
        answer = service.http.get(job["links"]["files"].replace("{name}", name))
        assert answer.content == data
        kinds = {"webp": "image/webp", "json": "application/json"}
        assert answer.headers["content-type"].split(";")[0] == kinds[name.rsplit(".")[-1]]
    answer = service.http.get(job["links"]["decoded"])
    assert 'filename="a scene.decoded.ply"' in answer.headers["content-disposition"]
    (tmp_path / "decoded.ply").write_bytes(answer.content)
    found, wanted = kissgs.load(tmp_path / "decoded.ply"), kissgs.decompress(local.to_zip())
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


@pytest.mark.parametrize(
    ("options", "ending", "media_type"),
    [
        (FAST, ".zip", "application/zip"),
        (SOG, ".sog", "application/octet-stream"),
    ],
)
def test_compression_while_waiting(service, options, ending, media_type):
    answer = service.http.post("/v1/compress", files={"file": ("garden.ply", SMALL)}, data={"options": options})
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == media_type
    assert f'filename="garden{ending}"' in answer.headers["content-disposition"]
    assert answer.content == compressed(ENDINGS[ending]).to_zip()


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


@pytest.mark.parametrize("value", ["spz", "sog-xt", "SOG", "", None, 3, ["sog"]])
def test_other_formats_are_refused(service, value):
    answer = service.http.post("/v1/jobs", content=SMALL, params={"options": json.dumps({"format": value})})
    found = problem(answer, 422, "invalid-request")
    assert "format" in found["detail"]
    assert "'sogxt' or 'sog'" in str(found["errors"])
