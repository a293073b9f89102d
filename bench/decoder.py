"""Milliseconds of decoding a container in Chromium, beside libwebp compiled to WebAssembly.

    python bench/decoder.py scene.zip

Without a container, it makes one of 256,000 Gaussians. Needs a Chromium on the PATH.
"""

from __future__ import annotations

import functools
import http.server
import shutil
import statistics
import tempfile
import threading
from pathlib import Path

from playwright.sync_api import Browser, sync_playwright

import kissgs
from bench.common import head, parser_of, row, run, write

DECODER = Path(__file__).resolve().parents[1] / "web_decoder"
GAUSSIANS = 256_000
PAGES = 5
"""Number of fresh pages for each figure; the medians are reported."""
REPETITIONS = 8
"""Repetitions in each page. The first, with loading the code, is "at first"; the median of the last half is "then"."""

WAYS = {
    "javascript": "decode(), JavaScript alone, one thread",
    "workers": "decode(), JavaScript alone, workers",
    "native": "decode(), the browser's decoder where it is exact",
    "webp.js": "the images alone, webp.js",
    "libwebp": "the images alone, libwebp in WebAssembly",
}


class Files(http.server.SimpleHTTPRequestHandler):
    """The decoder's folder, and the container as ``scene.zip``."""

    def __init__(self, *args: object, scene: Path, **kwargs: object) -> None:
        self.scene = scene
        self.extensions_map = {
            ".js": "text/javascript",
            ".wasm": "application/wasm",
            ".html": "text/html",
            "": "text/plain",
        }
        super().__init__(*args, directory=str(DECODER), **kwargs)  # type: ignore[arg-type]

    def translate_path(self, path: str) -> str:
        """Return the path of a file, or that of the container."""
        return str(self.scene) if path == "/scene.zip" else super().translate_path(path)

    def log_message(self, *_: object) -> None:
        """Keep quiet."""


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("container", nargs="?", type=Path)
    given = parser.parse_args().container
    with tempfile.TemporaryDirectory() as folder:
        scene = given or make_scene(Path(folder) / "scene.zip")
        count = len(kissgs.decompress(scene))
        size = scene.stat().st_size
        write(f"{scene.name}: {count:,} Gaussians, {size:,} bytes; milliseconds, medians of {PAGES} pages")
        head("", "at first", "then")
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Files, scene=scene))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with sync_playwright() as driver:
            chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
            browser = driver.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
            runs: dict[str, tuple[list[float], list[float]]] = {way: ([], []) for way in WAYS}
            for _ in range(PAGES):
                for way, (first, later) in runs.items():
                    times = measure(browser, server.server_port, way)
                    first.append(times[0])
                    later.append(statistics.median(times[len(times) // 2 :]))
            for way, name in WAYS.items():
                first, later = runs[way]
                row(name, f"{statistics.median(first):.0f}", f"{statistics.median(later):.0f}")
            browser.close()
        server.shutdown()


def measure(browser: Browser, port: int, way: str) -> list[float]:
    """Times in a process of its own."""
    context = browser.new_context()
    page = context.new_page()
    page.goto(f"http://127.0.0.1:{port}/bench/bench.html")
    page.wait_for_function("window.measure !== undefined")
    times = page.evaluate("([way, n]) => measure(way, '/scene.zip', n)", [way, REPETITIONS])
    context.close()
    return list(times)


def make_scene(path: Path) -> Path:
    """A container of that many Gaussians."""
    splats = kissgs.sample_scene(GAUSSIANS)
    kissgs.compress(splats).save(path)
    return path


if __name__ == "__main__":
    run(main)
