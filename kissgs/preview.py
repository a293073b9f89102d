"""The preview page: scenes in the forms that it reads, as one file, or served on this machine."""

from __future__ import annotations

import base64
import contextlib
import gzip
import hashlib
import html
import io
import json
import os
import posixpath
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from kissgs._version import __version__
from kissgs.core.context import Context, JobProgress, Progress, silent
from kissgs.core.errors import InvalidSceneError, KissgsError, UnsupportedError
from kissgs.core.positions import WORLD
from kissgs.formats import CONTAINERS, ending_of
from kissgs.io.containers import META_NAME, open_source, zip_bytes
from kissgs.io.files import reason_of
from kissgs.io.ply import write_ply
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, ReadOptions
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.scene_files import open_scene, recognise, scene_root
from kissgs.sog import decode as sog
from kissgs.sog.metadata import read_layout
from kissgs.sogxt import decode as sogxt

PAGE_GAUSSIANS = 1_000_000  # largest number in the level that a page of one file gets, so that phones open it


@dataclass(frozen=True)
class StreamedFolder:
    """A streamed scene whose files are read when the page asks for them."""

    name: str  # of the folder
    manifest: str
    files: dict[str, Path]  # by their paths from the folder, the manifest included
    missing: tuple[str, ...]
    unusable: tuple[str, ...]  # no files, or links that lead out of the folder or nowhere


STREAMED = {"streamed-sog": sog.STREAMED, "streamed-sogxt": sogxt.STREAMED}


def streamed_folder(source: Path) -> StreamedFolder | None:
    """Return the files of a streamed scene, given its folder or its manifest; None for other scenes, and for a zip. The
    page names those that cannot be reached, and shows the rest."""
    folder = scene_root(source)
    kind = STREAMED.get(recognise(source)) if folder.is_dir() else None
    if kind is None:
        return None
    with kind.open(folder) as opened:
        tree, names = kind.read_manifest(opened), [kind.manifest]
        for name in (*tree.filenames, *([tree.environment] if tree.environment else [])):
            names.append(name)
            parent, _, last = name.rpartition("/")
            if last == META_NAME:  # a container in a folder
                with contextlib.suppress(KissgsError):
                    names += [f"{parent}/{image}" if parent else image for image in read_layout(opened, name).images]
    root = folder.resolve()
    inside = dict[str, Path]()
    for name in names:
        with contextlib.suppress(OSError, RuntimeError):  # a closed folder; a link to itself
            path = (root / name).resolve()
            if path.is_relative_to(root) and path.is_file():
                inside[name] = path
    others = [name for name in names if name not in inside]
    unusable = tuple(name for name in others if os.path.lexists(root / name))
    missing = tuple(name for name in others if name not in unusable)
    return StreamedFolder(_stem(root), kind.manifest, inside, missing, unusable)


def fitting_level(source: Path | bytes, max_gaussians: int | None = None) -> tuple[int, int] | None:
    """Return the finest level of a streamed scene that fits into a page of one file, or else the coarsest, and the
    number of levels; None for other scenes."""
    kind = STREAMED.get(recognise(source))
    if kind is None:
        return None
    with kind.open(scene_root(source) if isinstance(source, Path) else source) as files:
        tree = kind.read_manifest(files)
        environment = 0 if tree.environment is None else kind.opened(files, tree.environment).count
    most = (PAGE_GAUSSIANS if max_gaussians is None else min(max_gaussians, PAGE_GAUSSIANS)) - environment
    fitting = (level for level in range(tree.levels) if tree.count(level) <= most)
    return next(fitting, tree.levels - 1), tree.levels


# Files of the preview page.

_PACKAGE = Path(__file__).parent

ROOT = _PACKAGE if (_PACKAGE / "web_decoder").is_dir() else _PACKAGE.parent
"""Folder of ``web_decoder`` and ``scripts``: the package itself in a wheel, the folder around it in a checkout."""

PAGE = "preview.html"

_FILE = re.compile(r"(preview/)?[\w-]+\.(js|css)|vendor/([\w-]+/)+([\w.-]+\.js|LICENSE)", re.ASCII)
_IMPORT_MAP = re.compile(r'<script type="importmap">(.*?)</script>', re.DOTALL)


def page_files() -> dict[str, Path]:
    """Return the files of the page by their paths from it, such as ``vendor/three/build/three.module.min.js``."""
    folder = ROOT / "web_decoder"
    if not (folder / PAGE).is_file():
        raise UnsupportedError(f"there is no preview page: {folder / PAGE} is missing; install kissgs again")
    if not (folder / "vendor" / "versions.json").is_file():
        raise UnsupportedError(
            "Spark and three.js, which draw the scene, are not installed; add --fetch-viewer to download them once"
        )
    found = [path for part in ("*", "preview/*", "vendor/**/*") for path in folder.glob(part) if path.is_file()]
    paths = {path.relative_to(folder).as_posix(): path for path in found}
    return {PAGE: folder / PAGE, **{name: path for name, path in sorted(paths.items()) if _FILE.fullmatch(name)}}


def fetch_viewer() -> None:
    """Download Spark and three.js if they are missing, at the versions and hashes that this version of kissgs names."""
    done = subprocess.run([sys.executable, ROOT / "scripts" / "vendor"], stdout=sys.stderr, check=False)
    if done.returncode:
        raise UnsupportedError("Spark and three.js could not be downloaded; the reason is above")


def import_map(page: str) -> str:
    """Return the text of the page's import map, JSON."""
    found = _IMPORT_MAP.search(page)
    assert found is not None, "the preview page has an import map"  # noqa: S101
    return found[1]


def hash_source(text: str) -> str:
    """Return the source expression of a content security policy for an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# Scenes in the forms that the preview page reads: containers as they are, all others as ``.ply``.

_MAX_FILE_BYTES = 1 << 30
_FILE_ENDINGS = (".webp", ".json", ".yaml", ".yml")


@dataclass(frozen=True)
class PageScene:
    """A file for the page, which recognises its format by the ending of its name."""

    name: str  # ends in .zip, .sog or .ply
    data: bytes
    converted: bool  # from another format
    notes: tuple[str, ...] = ()  # what reading the scene left out or changed


def page_scene(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene for the page: a SOG-XT or SOG container unchanged, any other as a ``.ply`` of equal values."""
    progress = JobProgress(progress, [("read", 1.0), ("kernels", 1.0), ("cameras", 2.0), ("write", 1.0)])
    splats, cleaned, _ = open_scene(source, reading, threads, progress)
    found = _as_container(source, reading)
    if found is None:
        from kissgs.cameras.virtual.first_view import first_view_of  # loads the rasteriser

        file = io.BytesIO()
        view = first_view_of(splats, Context(threads, progress=progress))
        comment = "" if view is None else f"comment kissgs view {json.dumps(view)}"
        near = replace(splats, origin=WORLD)  # viewers draw a scene better near the origin
        write_ply(file, near, progress=progress, comment=comment)
        found = PageScene(f"{_stem(source)}.ply", file.getvalue(), converted=recognise(source) != "ply")
    progress.stop()
    return replace(found, notes=(*splats.notes, *cleaned.notes))


def page_container(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, *, threads: int = 0, progress: Progress = silent
) -> PageScene:
    """Return a scene as a container: SOG-XT or SOG unchanged, any other compressed by the preset ``balanced``."""
    if _as_container(source, reading) is not None:  # decoded, too: whoever gets the page cannot mend a damaged one
        return page_scene(source, reading, threads=threads, progress=progress)
    result = compress(source, reading=reading, threads=threads, progress=progress)
    notes = tuple(filter(None, (result.report.note, *result.report.cleaned.notes)))
    return PageScene(f"{_stem(source)}.zip", result.to_zip(), converted=True, notes=notes)


def _as_container(source: Path | bytes, reading: ReadOptions) -> PageScene | None:
    """Return the zip of a container, None for other formats. The files of a folder are packed. A container is not shown
    as it is if its mark of antialiasing does not count."""
    found = recognise(source)
    kind = next((kind for kind in CONTAINERS if kind == found), None)
    if kind is None or reading.antialiased is not None:
        return None
    root = scene_root(source) if isinstance(source, Path) else source
    if isinstance(root, bytes):
        data = root
    elif root.is_dir():
        with open_source(root) as files:
            names = sorted(name for name in files.names() if name.endswith(_FILE_ENDINGS))
            data = zip_bytes({name: files.read(name, _MAX_FILE_BYTES) for name in names})
    else:
        try:
            data = root.read_bytes()
        except OSError as error:
            raise InvalidSceneError(f"cannot read {root!s:.100}: {reason_of(error)}") from error
    return PageScene(f"{_stem(source)}{ending_of(kind)}", data, converted=False)


def _stem(source: Path | bytes) -> str:
    """Return the name of a scene without its ending, in characters that UTF-8 has."""
    if isinstance(source, bytes):
        return "scene"
    root = scene_root(source).absolute()
    return os.fsencode(root.name if root.is_dir() else root.stem).decode(errors="replace") or "scene"


# The preview page and a scene in one HTML file. Modules cannot be imported from ``file:``. They are therefore embedded
# as text, in an order in which each comes after those that it imports; ``web_decoder/standalone.js`` makes a blob of
# each, and their imports name the blobs' addresses.

_COMMENT = re.compile(r"/\*\*.*?\*/", re.DOTALL)  # with examples, whose imports are none; not of minified files

_IMPORT = re.compile(r"""(\b(?:from|import)\s*\(?\s*)(["'])([^"'\n]+)\2""")
_WORKER = re.compile(r"""new URL\("([^"]+)", import\.meta\.url\)""")

_STANDALONE_POLICY = (
    "default-src 'none'; script-src {script} blob: 'wasm-unsafe-eval'; worker-src blob:; style-src {style}; "
    "img-src data:; connect-src 'none'; form-action 'none'; base-uri 'none'"
)


def standalone_page(scene: PageScene) -> bytes:
    """Return the page with a container inside: UTF-8, equal bytes for equal input."""
    files = page_files()
    page = _text(files[PAGE])
    style, start = _text(files["preview.css"]), _text(files["standalone.js"])
    modules = _linked_modules(files, json.loads(import_map(page))["imports"], "preview.js")
    packed = gzip.compress(json.dumps(modules, ensure_ascii=False).encode(), compresslevel=9, mtime=0)
    title = html.escape(scene.name)
    policy = _STANDALONE_POLICY.format(script=hash_source(start), style=hash_source(style))
    meta = f'<meta http-equiv="Content-Security-Policy" content="{policy}" />\n    '
    blocks = (
        f'<script type="text/plain" id="modules">{_base64(packed)}</script>\n'
        f'<script type="text/plain" id="embedded-scene" data-name="{title}">{_base64(scene.data)}</script>\n'
    )
    texts = (
        f"{name.split('/')[1]}: {_text(path).strip()}" for name, path in files.items() if name.endswith("/LICENSE")
    )
    licences = "\n\n".join(texts).replace("--", "- -")  # of the libraries inside, which ask for that
    for pattern, text in (
        (r'<meta charset="utf-8" />\n\s*', lambda found: found + meta),
        (r"<title>.*?</title>", lambda _: f"<title>{title} · kissgs</title>"),
        (r'<link rel="stylesheet"[^>]*>', lambda _: f"<style>{style}</style>"),
        (r'<script type="importmap">.*?</script>', lambda _: f"<!--\n{licences}\n-->"),
        (r'<script type="module" src=[^>]*></script>\n', lambda _: ""),
        (r"</body>", lambda found: f'{blocks}<script type="module">{start}</script>\n{found}'),
    ):
        page, count = re.subn(pattern, lambda match: text(match[0]), page, flags=re.DOTALL)  # noqa: B023  called at once
        assert count == 1, pattern  # noqa: S101
    return page.encode()


def _linked_modules(files: dict[str, Path], imports: dict[str, str], program: str) -> list[tuple[str, str]]:
    """Return the names and texts of a module and of all that it imports, each after those that it imports itself."""
    begun, linked = set[str](), dict[str, str]()

    def address(specifier: str, importer: str) -> str | None:
        """Return what a module's text imports instead of ``specifier``; None if that is no file of the page."""
        target = posixpath.join(posixpath.dirname(importer), specifier)
        for known, place in imports.items():
            if specifier == known or (known.endswith("/") and specifier.startswith(known)):
                target = place + specifier[len(known) :]
                break
        target = posixpath.normpath(target)
        if target not in files:
            return None
        add(target)
        return f'"module:{target}"'

    def add(name: str) -> None:
        if name in begun:
            assert name in linked, f"{name} imports itself"  # noqa: S101
            return
        begun.add(name)
        text = _text(files[name])
        if not name.endswith(".min.js"):
            text = _COMMENT.sub("", text)
            text = _WORKER.sub(lambda match: address(match[1], name) or match[0], text)
        text = _IMPORT.sub(lambda match: match[1] + (address(match[3], name) or match[0][len(match[1]) :]), text)
        linked[name] = text

    add(program)
    return list(linked.items())


def _text(path: Path) -> str:
    """Return a text as browsers see it, with ``\\n`` at the ends of lines."""
    return path.read_text(encoding="utf-8").replace("\r\n", "\n")


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


# A server of the preview page and one scene.

HOST = "127.0.0.1"
SLOWEST_SECONDS = 60  # a client that sends or takes nothing for this long is disconnected

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    "": "text/plain; charset=utf-8",
}
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}
_SERVED_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' {hash}; worker-src 'self' blob:; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Spark sorts in WebAssembly, in workers that it creates from blobs; the hash is that of the inline import map."""


class PageServer(ThreadingHTTPServer):
    """Server of the page at ``/``, of its files and of the scene, and of nothing else. Only requests whose ``Host`` is
    this machine by number or as ``localhost`` are answered, so that a web site whose name resolves to 127.0.0.1 cannot
    read the scene. Port 0 is a free one."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, scene: PageScene | StreamedFolder, port: int = 0) -> None:
        files = page_files()
        page = _text(files[PAGE])
        self.contents: dict[str, bytes | Path] = {f"/{name}": path for name, path in files.items()}
        self.contents |= {"/": page.encode(), f"/{PAGE}": page.encode()}
        address = f"scene/{scene.name}"
        if isinstance(scene, StreamedFolder):
            self.contents |= {f"/{address}/{name}": path for name, path in scene.files.items()}
            address = f"{address}/{scene.manifest}"
        else:
            self.contents[f"/{address}"] = scene.data
        self.policy = _SERVED_POLICY.format(hash=hash_source(import_map(page)))
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise UnsupportedError(
                f"cannot serve on port {port}: {reason_of(error)}; choose another --port, or none"
            ) from error
        self.port: int = self.server_address[1]
        self.hosts = {f"{name}:{self.port}" for name in (HOST, "localhost")} | ({HOST} if self.port == 80 else set())
        self.url = f"http://{HOST}:{self.port}/?src={quote(quote(address))}"

    def handle_error(self, request: Any, client_address: Any) -> None:  # noqa: ANN401  as in the base class
        """Let a connection that breaks pass in silence."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    protocol_version = "HTTP/1.1"
    timeout = SLOWEST_SECONDS

    def do_GET(self) -> None:
        path, status, content, suffix = unquote(urlsplit(self.path).path), HTTPStatus.OK, b"", ""
        if self.headers.get("Host") not in self.server.hosts:
            status, content = HTTPStatus.FORBIDDEN, b"this server answers requests to this machine only\n"
        else:
            try:
                found = self.server.contents[path]
                content = found if isinstance(found, bytes) else found.read_bytes()
                suffix = ".html" if path == "/" else Path(path).suffix
            except (KeyError, OSError):  # a file of a streamed scene may have been removed meanwhile
                status, content = HTTPStatus.NOT_FOUND, b"there is no such file\n"
        media_type = _TYPES.get(suffix, "application/octet-stream")
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        if media_type == _TYPES[".html"]:
            self.send_header("Content-Security-Policy", self.server.policy)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    do_HEAD = do_GET

    def version_string(self) -> str:
        """Return the header ``Server``."""
        return f"kissgs/{__version__}"

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing for a request."""
