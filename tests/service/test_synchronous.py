"""POST /v1/compress, which answers with the container; oracles: kissgs.compress of the scene, and RFC 9110."""

import json
import re
import shutil
import subprocess
from urllib.parse import quote

import pytest
from helpers.service import FAST, ROOT, SLOW, SMALL, problem

from service.http.routes.jobs import accepts


def test_synchronous_compression(service, local):
    """Oracle for the headers: RFC 9110 13.1.2 and 14.2, 304 and ranges answer GET and HEAD only."""
    headers = {"If-None-Match": "*", "Range": "bytes=0-9"}
    answer = service.http.post("/v1/compress", content=SMALL, params={"options": FAST}, headers=headers)
    assert (answer.status_code, answer.content) == (200, local.to_zip())
    job = service.http.get(answer.headers["link"].split(";")[0].strip("<>")).json()
    assert job["links"]["result"] == answer.headers["content-location"]
    sog = json.dumps({"preset": "fast", "format": "sog"})
    for options, ending, kind in ((FAST, ".zip", "application/zip"), (sog, ".sog", "application/octet-stream")):
        answer = service.http.post("/v1/compress", files={"file": ("garden.ply", SMALL)}, data={"options": options})
        assert (answer.status_code, answer.headers["content-type"]) == (200, kind)
        assert f'filename="garden{ending}"' in answer.headers["content-disposition"]


def test_synchronous_compression_becomes_a_job_after_the_time_limit(start):
    service = start(sync_seconds=0.3)
    answer = service.http.post("/v1/compress", content=SMALL, params={"options": SLOW})
    assert answer.status_code == 202
    assert answer.headers["location"] == answer.json()["links"]["self"]
    assert answer.json()["state"] in ("queued", "running")
    assert service.status(answer.json())["state"] in ("queued", "running")

    only_zip = {"Accept": "application/zip"}
    answer = service.http.post("/v1/compress", content=SMALL, params={"options": FAST}, headers=only_zip)
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
@pytest.mark.quick(0)
def test_the_documented_command_never_overwrites_a_good_container(start, local, tmp_path):
    """A 202 answer once replaced a good scene.zip with the job's status, and curl exited with 0."""
    page = (ROOT / "docs" / "guide" / "service.md").read_text(encoding="utf-8")
    (command,) = re.findall(r"^\$ (curl .*/v1/compress.*)", page.replace("\\\n", ""), re.MULTILINE)
    service = start(sync_seconds=30)
    hasty = start(sync_seconds=0.5)
    target = tmp_path / "scene.zip"
    target.write_bytes(b"a good container")

    def run(service, scene, options):
        (tmp_path / "scene.ply").write_bytes(scene)
        address = f"'{service.url}/v1/compress?options={quote(options)}'"
        line = command.replace("localhost:8000/v1/compress", address)
        return subprocess.run(["sh", "-c", line], cwd=tmp_path, capture_output=True, check=False).returncode

    for scene, options, code in ((SMALL, SLOW, "not-finished"), (b"ply\n", FAST, "invalid-scene")):
        assert run(hasty, scene, options) != 0
        assert target.read_bytes() == b"a good container"
        assert json.loads((tmp_path / "scene.zip.part").read_text())["code"] == code
    assert run(service, SMALL, FAST) == 0
    assert target.read_bytes() == local.to_zip()
