"""Chromium with software WebGL, and common actions of the tests of the preview page."""

import base64
import io
import re
import time

import numpy as np
import pytest
from PIL import Image

from helpers.viewers import chromium
from helpers.web_tools import ROOT
from kissgs.core.splats import SH_C0

VENDOR = ROOT / "web_decoder" / "vendor"

COUNT_RESOURCES = """
const contexts = new Map();
let frames = 0;
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...others) {
  const context = getContext.call(this, kind, ...others);
  if (kind === "webgl2" && context && !contexts.has(context)) contexts.set(context, 0);
  return context;
};
const { createTexture, deleteTexture } = WebGL2RenderingContext.prototype;
const count = (context, more) => contexts.set(context, contexts.get(context) + more);
Object.assign(WebGL2RenderingContext.prototype, {
  createTexture(...all) { count(this, 1); return createTexture.apply(this, all); },
  deleteTexture(texture) { count(this, texture ? -1 : 0); return deleteTexture.call(this, texture); },
});
const request = window.requestAnimationFrame;
window.requestAnimationFrame = (call) => { frames++; return request(call); };
// Spark sorts in a worker, which answers a request of a number with the same number, after perhaps some "status".
const asked = new Set();
window.Worker = class extends Worker {
  #requests = new Map();
  constructor(...all) {
    super(...all);
    this.addEventListener("message", ({ data }) => data?.status ?? asked.delete(this.#requests.get(data?.id)));
  }
  postMessage(message, ...others) {
    super.postMessage(message, ...others);
    if (message?.id === undefined) return;
    const request = {};
    this.#requests.set(message.id, request);
    asked.add(request);
  }
  terminate() {
    for (const request of this.#requests.values()) asked.delete(request);
    super.terminate();
  }
};
window.resourceCounts = () => {
  const alive = [...contexts].filter(([context]) => !context.isContextLost());
  const textures = alive.reduce((sum, [, textures]) => sum + textures, 0);
  return { contexts: alive.length, textures, frames, asked: asked.size };
};
"""
"""Script that counts live WebGL contexts, their textures, requested animation frames, and requests to Spark's worker
without an answer."""


@pytest.fixture(scope="module")
def software_browser():
    if not VENDOR.exists():
        pytest.skip("scripts/vendor has not run")
    with chromium() as browser:
        yield browser


class Preview:
    """Tab with the preview page; ``errors`` are all errors in it."""

    def __init__(self, browser, **options):
        self.context = browser.new_context(**{"viewport": {"width": 820, "height": 400}, **options})
        self.page = self.context.new_page()
        self.page.set_default_timeout(120_000)
        self.page.add_init_script(COUNT_RESOURCES)
        self.requests, self.errors, self.origin = [], [], ""
        self.page.on("request", self._request)
        self.page.on("pageerror", lambda error: self.errors.append(f"page error: {error}"))
        self.page.on("requestfailed", self._failed)
        self.page.on(
            "response", lambda answer: answer.status < 400 or self.errors.append(f"{answer.status} {answer.url}")
        )
        self.page.on("console", self._console)

    def _request(self, request):
        self.requests.append((request.method, request.url))
        if not request.url.startswith((self.origin, "blob:", "data:")):
            self.errors.append(f"other host: {request.url}")

    def _failed(self, request):
        if "ERR_ABORTED" not in request.failure:  # aborted by the page, or because it was left
            self.errors.append(f"failed: {request.url} {request.failure}")

    def _console(self, line):
        if line.type == "error" or "Content Security Policy" in line.text or "too many" in line.text.lower():
            self.errors.append(line.text)

    def expect_errors(self, *patterns):
        """Remove errors that match; each pattern must match at least one."""
        for pattern in patterns:
            found = [line for line in self.errors if re.search(pattern, line)]
            assert found, (pattern, self.errors)
            self.errors = [line for line in self.errors if line not in found]

    def open(self, service, path=""):
        self.origin = service.url
        self.page.goto(f"{service.url}/preview/{path}")
        return self

    def visit(self, server):
        """Open the page of ``kissgs view``."""
        self.origin = server.url.partition("?")[0]
        self.page.goto(server.url)
        return self

    def shown(self, gaussians):
        """Wait for the scene and return its final image."""
        self.fact("Gaussians", f"{gaussians:,}")
        self.page.locator("#loading").wait_for(state="hidden")
        self.page.locator("#viewport").wait_for()
        return self.still_image()

    def fact(self, name, value):
        exactly = re.compile(f"^{re.escape(name)}{re.escape(value)}$")
        self.page.locator("#statistics .facts > div").filter(has_text=exactly).wait_for()

    def pixels(self):
        """Return a screenshot of the canvas and everything over it."""
        screenshot = self.page.locator("#stage").screenshot(animations="disabled")
        return np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB")).astype(int)

    def still_image(self, seconds=300):
        """Return a screenshot when Spark has sorted, and no frame has been requested for 0.3 s."""
        end, frames, still = time.monotonic() + seconds, -1, 0
        while time.monotonic() < end:
            counts = self.page.evaluate("resourceCounts()")
            still = still + 1 if counts["frames"] == frames and not counts["asked"] else 0
            frames = counts["frames"]
            if still == 3:
                return self.pixels()
            self.page.wait_for_timeout(100)
        raise AssertionError("the image keeps changing")

    def error_message(self, *words):
        """Return the error message, which must be one sentence with these words."""
        message = self.page.locator("#problem:visible p")
        message.wait_for()
        text = message.inner_text()
        assert all(word in text for word in words), text
        assert re.fullmatch(r"[^\n]{10,250}[.]", text), text
        assert "bug in it" not in text
        return text

    def choose(self, *files, button="#open"):
        """Choose files in the dialog that a button opens; files are pairs of name and bytes."""
        with self.page.expect_file_chooser() as chooser:
            self.page.locator(button).click()
        kind = "application/octet-stream"
        chooser.value.set_files([{"name": name, "mimeType": kind, "buffer": data} for name, data in files])

    def drop(self, *files):
        """Drag files over the page and drop them."""
        pairs = [[name, base64.b64encode(data).decode()] for name, data in files]
        transfer = self.page.evaluate_handle(
            """(files) => {
              const transfer = new DataTransfer();
              for (const [name, text] of files)
                transfer.items.add(new File([Uint8Array.from(atob(text), (byte) => byte.charCodeAt(0))], name));
              return transfer;
            }""",
            pairs,
        )
        self.page.dispatch_event("body", "dragover", {"dataTransfer": transfer})
        assert self.page.locator(".veil").is_visible()
        self.page.dispatch_event("body", "drop", {"dataTransfer": transfer})
        assert not self.page.locator(".veil").is_visible()


@pytest.fixture
def preview(software_browser):
    """``preview(**options)`` opens a tab; errors that were not expected fail the test."""
    tabs = []

    def begin(**options):
        tabs.append(Preview(software_browser, **options))
        return tabs[-1]

    yield begin
    for tab in tabs:
        tab.context.close()
    errors = [line for tab in tabs for line in tab.errors]
    assert not errors, errors


def psnr(one, other):
    """Return the PSNR of two images."""
    return -10 * np.log10(max(np.mean((one - other) ** 2) / 255**2, 1e-10))


def colours(image):
    return len(np.unique(image.reshape(-1, 3), axis=0))


def numbers(text):
    return [float(part) for part in text.replace("−", "-").replace(",", "").split()]


def assert_readout(readout, decoded, index, levels, *, rotation):
    """Assert that the readout of a plane has the values of a Gaussian; return its entry of the SH codebook."""
    shown = dict(zip(readout.locator("dt").all_inner_texts(), readout.locator("dd").all_inner_texts(), strict=True))
    assert numbers(shown["Position"]) == pytest.approx(decoded.means[index], rel=6e-3, abs=1e-9)
    assert numbers(shown["Deviations"]) == pytest.approx(np.exp(decoded.scales[index]), rel=6e-3)
    quat = decoded.quats[index] / np.linalg.norm(decoded.quats[index])
    assert numbers(shown["Quaternion"]) == pytest.approx(quat, abs=rotation)
    assert numbers(shown["Colour"]) == pytest.approx(255 * (0.5 + SH_C0 * decoded.sh0[index]), abs=0.51)
    opacity = 100 / (1 + np.exp(-decoded.opacities[index]))
    assert float(shown["Opacity"].strip("%")) == pytest.approx(opacity, abs=0.06)
    assert numbers(shown["Levels RGBA"]) == [*levels, 255]
    return numbers(shown["SH entry"])
