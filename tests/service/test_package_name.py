"""The service under both of its names; reference: docs/decisions/0010-top-level-packages.md."""

import re
import subprocess
import sys

from helpers.service import ROOT


def test_the_service_does_not_know_its_own_name():
    """An absolute import works in a checkout and fails in a wheel, where the package is called kissgs_service."""
    absolute = re.compile(r"^\s*(from|import) service\b", re.MULTILINE)
    sources = (ROOT / "service").rglob("*.py")
    assert [path for path in sources if absolute.search(path.read_text(encoding="utf-8"))] == []


def test_the_installed_name(tmp_path):
    code = "import sys, kissgs_service.http.app, kissgs_service.jobs.job_process; sys.exit('service' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)
