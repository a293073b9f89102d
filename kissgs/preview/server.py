"""A server of the preview page and one scene, for browsers on this machine."""

from __future__ import annotations

import sys
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote, urlsplit

from kissgs._version import __version__
from kissgs.core.errors import UnsupportedError
from kissgs.io.files import reason_of
from kissgs.preview.page_scene import PAGE, PageScene, StreamedFolder, hash_source, import_map, page_files, read_page

HOST = "127.0.0.1"
SLOWEST_SECONDS = 60
"""A client that sends or takes nothing for this long is disconnected."""

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
_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' {hash}; worker-src 'self' blob:; style-src 'self'; "
    "img-src 'self' data:; connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
"""Spark sorts in WebAssembly, in workers that it creates from blobs; the hash is that of the inline import map."""


class PageServer(ThreadingHTTPServer):
    """Server of the page at ``/``, of its files and of the scene, and of nothing else.

    Only requests whose ``Host`` is this machine by number or as ``localhost`` are answered, so that a web site whose
    name resolves to 127.0.0.1 cannot read the scene. Port 0 is a free one.
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, scene: PageScene | StreamedFolder, port: int = 0) -> None:
        files = page_files()
        page = read_page(files)
        self.contents: dict[str, bytes | Path] = {f"/{name}": path for name, path in files.items()}
        self.contents |= {"/": page.encode(), f"/{PAGE}": page.encode()}
        address = f"scene/{scene.name}"
        if isinstance(scene, StreamedFolder):
            self.contents |= {f"/{address}/{name}": path for name, path in scene.files.items()}
            address = f"{address}/{scene.manifest}"
        else:
            self.contents[f"/{address}"] = scene.data
        self.policy = _POLICY.format(hash=hash_source(import_map(page)))
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
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        status, content, media_type = self._find()
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", media_type)
        self.send_header("Content-Length", str(len(content)))
        if media_type == _TYPES[".html"]:
            self.send_header("Content-Security-Policy", self.server.policy)
        self.end_headers()
        if body:
            self.wfile.write(content)

    def _find(self) -> tuple[HTTPStatus, bytes, str]:
        """Return the status, the content and its media type for the path of this request."""
        path = unquote(urlsplit(self.path).path)
        if self.headers.get("Host") not in self.server.hosts:
            return HTTPStatus.FORBIDDEN, b"this server answers requests to this machine only\n", _TYPES[""]
        found = self.server.contents.get(path)
        if found is None:
            return HTTPStatus.NOT_FOUND, b"there is no such file\n", _TYPES[""]
        suffix = ".html" if path == "/" else Path(path).suffix
        try:
            content = found if isinstance(found, bytes) else found.read_bytes()
        except OSError:  # a file of a streamed scene that has been removed meanwhile
            return HTTPStatus.NOT_FOUND, b"there is no such file\n", _TYPES[""]
        return HTTPStatus.OK, content, _TYPES.get(suffix, "application/octet-stream")

    def version_string(self) -> str:
        """Return the header ``Server``."""
        return f"kissgs/{__version__}"

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing for a request."""
