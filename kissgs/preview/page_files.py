"""Files of the preview page: where they are, which belong to it, and its content security policy."""

from __future__ import annotations

import base64
import hashlib
import re
import subprocess
import sys
from pathlib import Path

from kissgs.core.errors import UnsupportedError

_PACKAGE = Path(__file__).parents[1]

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of ``web_decoder`` and ``scripts``: the package itself in a wheel, the folder around it in a checkout."""

PAGE = "preview.html"

_FILE = re.compile(r"(preview/)?[\w-]+\.(js|css)|vendor/([\w-]+/)+([\w.-]+\.js|LICENSE)", re.ASCII)
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def page_files() -> dict[str, Path]:
    """Return the files of the page by their paths from it, such as ``vendor/three/build/three.module.min.js``.

    Raises:
        UnsupportedError: the page, or Spark or three.js, which draw the scene, are not installed.
    """
    folder = ROOT / "web_decoder"
    if not (folder / PAGE).is_file():
        raise UnsupportedError(
            f"this installation has no preview page: {folder / PAGE} is missing; install kissgs again"
        )
    if not (folder / "vendor" / "versions.json").is_file():
        raise UnsupportedError(
            "Spark and three.js, which draw the scene, are not installed; add --fetch-viewer to download them once"
        )
    paths = {path.relative_to(folder).as_posix(): path for path in _candidates(folder)}
    return {PAGE: folder / PAGE, **{name: path for name, path in sorted(paths.items()) if _FILE.fullmatch(name)}}


def _candidates(folder: Path) -> list[Path]:
    return [path for part in ("*", "preview/*", "vendor/**/*") for path in folder.glob(part) if path.is_file()]


def fetch_viewer() -> None:
    """Download Spark and three.js, at the versions and hashes that this version of kissgs names, if they are missing.

    Raises:
        UnsupportedError: they cannot be downloaded; the script's own message stands before.
    """
    done = subprocess.run([sys.executable, ROOT / "scripts" / "vendor"], stdout=sys.stderr, check=False)
    if done.returncode:
        raise UnsupportedError("Spark and three.js could not be downloaded; the reason is above")


def read_page(files: dict[str, Path]) -> str:
    """Return the page as browsers see it, with ``\\n`` at the ends of lines."""
    return files[PAGE].read_text(encoding="utf-8").replace("\r\n", "\n")


def import_map(page: str) -> str:
    """Return the text of the page's import map, JSON."""
    found = _IMPORT_MAP.search(page)
    assert found is not None, "the preview page has an import map"  # noqa: S101
    return found[1]


def hash_source(text: str) -> str:
    """Return the source expression of a content security policy for an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
