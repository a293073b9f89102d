"""Paths of files that belong to no Python package."""

from __future__ import annotations

from pathlib import Path

import kissgs

_PACKAGE = Path(kissgs.__file__).parent

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of these files: the package ``kissgs`` in a wheel, the folder around it in a checkout."""

WEB_DECODER = ROOT / "web_decoder"
VENDOR_SCRIPT = ROOT / "scripts" / "vendor"
