"""The service under both of its names, and its command; reference: docs/decisions.md."""

import io
import subprocess
import sys

import pytest
from helpers.service import ROOT

from service.__main__ import main


def test_the_installed_name(tmp_path):
    """An absolute import of the service works in a checkout, and fails in a wheel, where it has another name."""
    sources = (path.relative_to(ROOT).with_suffix("") for path in (ROOT / "service").rglob("*.py"))
    imported = ", ".join(f"kissgs_{'.'.join(path.parts).removesuffix('.__init__')}" for path in sources)
    code = f"import sys, {imported}; sys.exit('service' in sys.modules)"
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, check=True)


def test_the_command_escapes_what_standard_output_cannot_encode(monkeypatch):
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "argv", ["kissgs-serve", "--help"])
    with pytest.raises(SystemExit):
        main()
    out.flush()
    assert b"KISSGS_KEYS=\\u2026" in out.buffer.getvalue()
