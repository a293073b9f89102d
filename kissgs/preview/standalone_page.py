"""The preview page and a scene in one HTML file, which works from disk and without a network.

Modules cannot be imported from ``file:``. They are therefore embedded as text, in an order in which each comes after
those that it imports; ``web_decoder/standalone.js`` makes a blob of each, and their imports name the blobs' addresses.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import posixpath
import re
from pathlib import Path

from kissgs.preview.page_scene import PageScene, hash_source, import_map, page_files, read_page

_START, _PROGRAM, _STYLE = "standalone.js", "preview.js", "preview.css"

_COMMENT = re.compile(r"/\*\*.*?\*/", re.DOTALL)
"""Comments with types and examples, whose imports are none; minified files have no others than licences."""

_IMPORT = re.compile(r"""(\b(?:from|import)\s*\(?\s*)(["'])([^"'\n]+)\2""")
_WORKER = re.compile(r"""new URL\("([^"]+)", import\.meta\.url\)""")

_POLICY = (
    "default-src 'none'; script-src {script} blob: 'wasm-unsafe-eval'; worker-src blob:; style-src {style}; "
    "img-src data:; connect-src 'none'; form-action 'none'; base-uri 'none'"
)


def standalone_page(scene: PageScene) -> bytes:
    """Return the page with a container inside: UTF-8, equal bytes for equal input."""
    files = page_files()
    page = read_page(files)
    style, start = _text(files[_STYLE]), _text(files[_START])
    modules = _Modules(files, json.loads(import_map(page))["imports"])
    modules.add(_PROGRAM)
    packed = gzip.compress(json.dumps(modules.linked, ensure_ascii=False).encode(), compresslevel=9, mtime=0)
    title = html.escape(scene.name)
    policy = _POLICY.format(script=hash_source(start), style=hash_source(style))
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}" />\n    '
    blocks = (
        f'<script type="text/plain" id="modules">{_base64(packed)}</script>\n'
        f'<script type="text/plain" id="embedded-scene" data-name="{title}">{_base64(scene.data)}</script>\n'
    )
    for pattern, text in (
        (r'<meta charset="utf-8" />\n\s*', lambda found: found + meta),
        (r"<title>.*?</title>", lambda _: f"<title>{title} · kissgs</title>"),
        (r'<link rel="stylesheet"[^>]*>', lambda _: f"<style>{style}</style>"),
        (r'<script type="importmap">.*?</script>', lambda _: _licences(files)),
        (r'<script type="module" src=[^>]*></script>\n', lambda _: ""),
        (r"</body>", lambda found: f'{blocks}<script type="module">{start}</script>\n{found}'),
    ):
        page, count = re.subn(pattern, lambda match: text(match[0]), page, flags=re.DOTALL)  # noqa: B023  called at once
        assert count == 1, pattern  # noqa: S101
    return page.encode()


class _Modules:
    """Modules of the page in the order of their imports; ``linked`` holds names and texts."""

    def __init__(self, files: dict[str, Path], imports: dict[str, str]) -> None:
        self._files = files
        self._imports = imports
        self._begun: set[str] = set()
        self.linked: list[tuple[str, str]] = []

    def add(self, name: str) -> None:
        """Add a module after all modules that it imports."""
        if name in self._begun:
            assert any(name == known for known, _ in self.linked), f"{name} imports itself"  # noqa: S101
            return
        self._begun.add(name)
        text = _text(self._files[name])
        if not name.endswith(".min.js"):
            text = _COMMENT.sub("", text)
            text = _WORKER.sub(lambda match: self._link(name, match[1]) or match[0], text)
        text = _IMPORT.sub(lambda match: match[1] + (self._link(name, match[3]) or match[0][len(match[1]) :]), text)
        self.linked.append((name, text))

    def _link(self, name: str, specifier: str) -> str | None:
        """Return what a module's text imports instead of ``specifier``; None if that is no file of the page."""
        target = self._resolve(name, specifier)
        if target not in self._files:
            return None
        self.add(target)
        return f'"module:{target}"'

    def _resolve(self, name: str, specifier: str) -> str:
        for known, address in self._imports.items():
            if specifier == known or (known.endswith("/") and specifier.startswith(known)):
                return posixpath.normpath(address + specifier[len(known) :])
        return posixpath.normpath(posixpath.join(posixpath.dirname(name), specifier))


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8").replace("\r\n", "\n")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _licences(files: dict[str, Path]) -> str:
    """Return a comment with the licences of the libraries inside, which ask for that."""
    texts = [
        f"{name.split('/')[1]}: {_text(path).strip()}" for name, path in files.items() if name.endswith("/LICENSE")
    ]
    return "<!--\n" + "\n\n".join(texts).replace("--", "- -") + "\n-->"
