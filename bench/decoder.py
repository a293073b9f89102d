"""Milliseconds of decoding a container in Chromium, beside libwebp compiled to WebAssembly.

    python bench/decoder.py scene.zip

Without a container, it makes one of 256,000 Gaussians. Needs Chromium, and what scripts/setup dev installs.
"""

from __future__ import annotations

import statistics
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.viewers import NO_GPU, chromium
from helpers.web_tools import DECODER, Site

import kissgs
from bench.common import head, parser_of, row, run, write

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
PAGE, LIBWEBP = "web_decoder/bench/bench.html", "web_decoder/node_modules/@jsquash/webp/codec/dec/webp_dec.wasm"


def main() -> None:
    """Measure and print."""
    parser = parser_of(__doc__)
    parser.add_argument("container", nargs="?", type=Path)
    given = parser.parse_args().container
    made = given or kissgs.compress(kissgs.sample_scene(GAUSSIANS)).to_zip()
    count = len(kissgs.decompress(made))
    container = made if isinstance(made, bytes) else made.read_bytes()
    write(f"{count:,} Gaussians, {len(container):,} bytes; milliseconds, medians of {PAGES} pages")
    runs: dict[str, list[list[float]]] = {way: [] for way in WAYS}
    site = Site()
    site.files = {f"/{name}": (DECODER.parent / name).read_bytes() for name in (PAGE, LIBWEBP)}
    site.files["/scene.zip"] = container
    try:
        with chromium(NO_GPU) as browser:
            for _ in range(PAGES):
                for way, times in runs.items():
                    context = browser.new_context()  # a process of its own
                    page = context.new_page()
                    page.goto(f"{site.url}/{PAGE}")
                    page.wait_for_function("window.measure !== undefined")
                    times.append(page.evaluate("([way, n]) => measure(way, '/scene.zip', n)", [way, REPETITIONS]))
                    context.close()
    except pytest.skip.Exception as error:
        raise kissgs.KissgsError(str(error)) from error
    head("", "at first", "then")
    for way, name in WAYS.items():
        first = statistics.median(times[0] for times in runs[way])
        then = statistics.median(statistics.median(times[REPETITIONS // 2 :]) for times in runs[way])
        row(name, f"{first:.0f}", f"{then:.0f}")


if __name__ == "__main__":
    run(main)
