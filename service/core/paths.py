"""Where the files lie that do not belong to a Python package of the service."""

from __future__ import annotations

from pathlib import Path

_PACKAGE = Path(__file__).parents[1]

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""In a wheel they lie in the package, in a checkout beside it."""

WEB_DECODER = ROOT / "web_decoder"
VENDOR_SCRIPT = ROOT / "scripts" / "vendor"
