"""The service under both of its names, and its command; reference: docs/decisions.md."""

import io
import re
import subprocess
import sys

import pytest
from helpers.service import ROOT

from service.__main__ import main


def test_the_service_does_not_know_its_own_name():
    """An absolute import works in a checkout and fails in a wheel, where the package is called kissgs_service."""
    absolute = re.compile(r"^\s*(from|import) service\b", re.MULTILINE)
    sources = (ROOT / "service").rglob("*.py")
    assert [path for path in sources if absolute.search(path.read_text(encoding="utf-8"))] == []


def test_the_installed_name(tmp_path):
    code = "import sys, kissgs_service.http.app, kissgs_service.jobs.job_process; sys.exit('service' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)


def test_the_command_escapes_what_standard_output_cannot_encode(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "argv", ["kissgs-serve", "--help"])
    with pytest.raises(SystemExit):
        main()
    out.flush()
    assert b"KISSGS_KEYS=\\u2026" in out.buffer.getvalue()
