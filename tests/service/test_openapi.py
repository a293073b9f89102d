"""The OpenAPI document; oracles: the snapshot in docs/, and schemathesis, which tests the service against it."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.service import ROOT, ServiceProcess


def test_the_document_equals_the_snapshot(service):
    """A change affects every client: review the difference, then run `make docs`."""
    expected = json.loads((ROOT / "docs" / "reference" / "openapi.json").read_text(encoding="utf-8"))
    found = service.http.get("/openapi.json").json()
    lines, wanted = (json.dumps(document, indent=1, sort_keys=True).splitlines() for document in (found, expected))
    assert lines == wanted


def test_all_codes_of_problems_are_listed(service):
    known = {problem["code"] for problem in service.http.get("/v1/problems").json()}
    sources = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "service").rglob("*.py"))
    named = set(re.findall(r'(?:ProblemError|problem)\(\s*"([a-z-]+)"', sources))
    assert len(named) > 15
    assert named <= known


def test_keys_are_documented(start):
    guarded = start(KISSGS_KEYS=f"alice:{'0' * 64}").http.get("/openapi.json").json()
    assert guarded["paths"]["/v1/jobs"]["post"]["security"] == [{"HTTPBearer": []}]


@pytest.mark.parametrize("seed", [1])
@pytest.mark.quick(0)
def test_schemathesis(tmp_path, seed):
    """Run its examples, boundary values, fuzzing and stateful tests along the links between responses and requests."""
    with ServiceProcess(tmp_path / "data") as service:
        found = subprocess.run(
            [
                *(Path(sys.executable).with_name("schemathesis"), "--config-file", ROOT / "schemathesis.toml", "run"),
                *(f"{service.url}/openapi.json", "--seed", str(seed), "--max-examples", "5", "--no-color"),
                *("--suppress-health-check", "all", "--generation-database", "none", "--request-timeout", "60"),
            ],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": f"{ROOT / 'tests'}:{ROOT}", "SCHEMATHESIS_HOOKS": "helpers.schema_hooks"},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert found.returncode == 0, "\n".join(line[:300] for line in found.stdout.splitlines()[-80:])
        assert service.http.get("/readyz").json()["ready"]
        assert "Traceback" not in service.log.read_text()
