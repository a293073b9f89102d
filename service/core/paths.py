"""Paths of files that do not belong to a Python package of the service."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of these files: the package itself in a wheel, the folder around it in a checkout."""

WEB_DECODER = ROOT / "web_decoder"
VENDOR_SCRIPT = ROOT / "scripts" / "vendor"
