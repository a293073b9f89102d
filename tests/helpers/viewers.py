"""Viewers that others wrote, in real Chromium: pages that draw files to given cameras."""

import base64
import contextlib
import shutil

import numpy as np
import pytest

from helpers.web_tools import DECODER, Site
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
QUIET = ["--no-sandbox", "--disable-background-networking", "--disable-component-update", "--disable-sync"]
SOFTWARE = [*QUIET, "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
NO_GPU = [*QUIET, "--disable-gpu"]
SPARK = "vendor/spark/dist/spark.module.min.js"
PLAYCANVAS = "node_modules/playcanvas/build/playcanvas.min.mjs"
PAGE = f"""<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><body>
<script type="importmap">{{"imports": {{
  "three": "/web_decoder/vendor/three/build/three.module.min.js",
  "three/addons/": "/web_decoder/vendor/three/examples/jsm/",
  "@sparkjsdev/spark": "/web_decoder/{SPARK}",
  "playcanvas": "/web_decoder/{PLAYCANVAS}"}}}}</script>
<script type="module" src="/tests/web/NAME_viewer.mjs"></script>"""


def scattered(count, degree):
    """Return a scene whose Gaussians rarely overlap, because viewers sort coarsely, with colours of 24 kinds."""
    rng = np.random.default_rng(degree)
    quats = rng.normal(size=(count, 4))
    kinds = rng.normal(0, 0.2, (24, (degree + 1) ** 2 - 1, 3))
    values = {
        "means": rng.uniform(-1, 1, (count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rng.normal(-3, 0.4, (count, 3)),
        "opacities": rng.normal(1, 2, count),
        "sh0": rng.normal(0, 0.8, (count, 3)),
        "shN": kinds[rng.integers(24, size=count)],
    }
    return Splats(**{name: np.ascontiguousarray(value, np.float32) for name, value in values.items()})


def seen_from(position, size=(300, 200), target=(0, 0, 0)):
    place, at = np.array(position, float), np.array(target, float)
    return look_at(place, at, np.array([0, -1.0, 0]), fov=0.9, width=size[0], height=size[1])


def skewed(camera, right=0.07, up=0.05):
    """Return a camera whose principal point is moved by shares of the image, and whose pixels are not square."""
    K = camera.K.copy()
    K[0, 0] *= 1.25
    K[:2, 2] += (right * camera.width, -up * camera.height)
    return Camera(camera.viewmat, K, camera.width, camera.height)


def pinhole(camera):
    """Return a camera as JSON."""
    return {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def image_of(text, camera):
    """Return the image of 0 to 1 that a viewer sent as text."""
    pixels = np.frombuffer(base64.b64decode(text), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[::-1, :, :3] / 255


def page_camera(view, size=(200, 100), focal=100.0):
    """Return the camera of a 4 x 4 view matrix, with y up and z backwards, in the form of our page."""
    width, height = size
    projection = [[2 * focal / width, 0, 0, 0], [0, 2 * focal / height, 0, 0], [0, 0, -1, -0.02], [0, 0, -1, 0]]
    eye = -view[:3, :3].T @ view[:3, 3]
    matrix = (np.array(projection) @ view).T.ravel()
    return {"matrix": matrix.tolist(), "eye": eye.tolist(), "focal": focal, "pixels": width * height}


class Viewer:
    """Page of a viewer, which draws files."""

    def __init__(self, name, page):
        self.name, self.page = name, page

    def draw(self, file, ending, cameras, background="#000000"):
        """Return the number of Gaussians, and an image of 0 to 1 for each camera."""
        job = {"file": base64.b64encode(file).decode(), "ending": ending, **self._cameras(cameras, background)}
        found = self.page.evaluate("job => draw(job)", job)
        return found["count"], list(map(image_of, found["images"], cameras))

    def draw_level(self, url, level, cameras, background="#000000"):
        """Return images of one level of a streamed scene."""
        job = {"url": url, "level": level, **self._cameras(cameras, background)}
        return list(map(image_of, self.page.evaluate("job => drawLevel(job)", job), cameras))

    def first_image(self, url, camera):
        """Return the first image with content of a streamed scene, and the name and bytes of each file read for it."""
        found = self.page.evaluate("job => firstImage(job)", {"url": url, "camera": pinhole(camera)})
        return image_of(found["image"], camera), found["files"]

    def _cameras(self, cameras, background):
        return {"cameras": list(map(pinhole, cameras)), "background": background}


def psnr(a, b):
    return -10 * np.log10(max(np.mean((a - b) ** 2), 1e-10))


@contextlib.contextmanager
def chromium(arguments=SOFTWARE):
    """Yield a browser; skip the test where there is none."""
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


def is_failure(message):
    """Return whether a line of the console is an error of a script; that of a missing file is not."""
    return message.type == "error" and "status of 404" not in message.text


@contextlib.contextmanager
def opened(name, browser, query=""):
    """Yield a viewer, "spark", "playcanvas", or our "preview" or "streaming", and the site that its page is from.

    The query "?defaults" leaves a viewer's own settings. No script may fail meanwhile.
    """
    needed, how = (PLAYCANVAS, "scripts/setup dev") if name == "playcanvas" else (SPARK, "scripts/vendor")
    if not (DECODER / needed).exists():
        pytest.skip(f"{how} has not run")
    errors = []
    site = Site()
    site.files["/"] = PAGE.replace("NAME", name).encode()
    site.headers["/"] = {"Content-Type": "text/html"}
    page = browser.new_page()
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text) if is_failure(message) else None)
    page.goto(f"{site.url}/{query}")
    page.wait_for_function("() => 'draw' in window")
    yield Viewer(name, page), site
    page.close()
    site.close()
    assert errors == []
