"""Make docs/images/page.webp and preview.webp: screenshots of a service of its own that compresses the sample scene.

Needs Chromium, scripts/vendor, and playwright of the extra ``dev``. Takes two minutes: Chromium draws in software.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import kissgs

HERE = Path(__file__).parent
PAGE, PREVIEW = {"width": 760, "height": 1200}, {"width": 1280, "height": 800}
SOFTWARE = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox"]
KEYS = ["+"] * 16 + ["ArrowLeft"] * 4 + ["ArrowUp"] * 2
GAUSSIANS = 60_000


def main() -> None:
    """Start a service, compress the sample scene, and save screenshots of both pages."""
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        scene = Path(folder) / "sample.ply"
        kissgs.save(kissgs.sample_scene(GAUSSIANS), scene)
        service = subprocess.Popen(
            [sys.executable, "-m", "service"],
            env={**os.environ, "KISSGS_PORT": "0", "KISSGS_DATA_DIR": f"{folder}/data", "PYTHONUNBUFFERED": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            address = next(found[0] for line in service.stdout if (found := re.search(r"http://\S+:\d+", line)))
            with kissgs.Remote(address) as remote:
                job = remote.compress(scene, Path(folder) / "sample.zip", evaluate=True)
            browser = driver.chromium.launch(executable_path=chromium, args=SOFTWARE)
            page = browser.new_page(viewport=PAGE)
            page.goto(f"{address}/#{job['id']}")
            page.get_by_text("Where the bytes go").wait_for()
            save(page.screenshot(), "page.webp")
            page = browser.new_page(viewport=PREVIEW, color_scheme="dark", reduced_motion="reduce")
            page.set_default_timeout(120_000)
            page.goto(f"{address}/preview/{job['id']}")
            save(pose(page), "preview.webp")
        finally:
            service.terminate()
            service.wait()


def save(screenshot: bytes, name: str) -> None:
    """Save a screenshot as WebP in docs/images."""
    Image.open(io.BytesIO(screenshot)).convert("RGB").save(HERE / "images" / name, quality=90, method=6)


def pose(page: Page) -> bytes:
    """Move the camera to where the objects are large, and return a screenshot."""
    page.locator("#live", has_text="Gaussians").wait_for(state="attached")
    for key in KEYS:
        page.keyboard.press(key)
    return settled(page)


def settled(page: Page) -> bytes:
    """Return a screenshot once two in a row are identical."""
    before, after = b"", page.screenshot()
    while before != after:
        page.wait_for_timeout(1000)
        before, after = after, page.screenshot()
    return after


if __name__ == "__main__":
    main()
