"""A Chromium with software WebGL, and common actions of the tests of the preview page."""

import base64
import io
import re
import shutil
import time

import numpy as np
import pytest
from PIL import Image

from helpers.service import ROOT

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
VENDOR = ROOT / "web_decoder" / "vendor"
SOFTWARE = [
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]

BOOKS = """
const made = new Map();
let frames = 0;
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...others) {
  const context = getContext.call(this, kind, ...others);
  if (kind === "webgl2" && context && !made.has(context)) made.set(context, 0);
  return context;
};
const { createTexture, deleteTexture } = WebGL2RenderingContext.prototype;
const count = (context, more) => made.set(context, made.get(context) + more);
Object.assign(WebGL2RenderingContext.prototype, {
  createTexture(...all) { count(this, 1); return createTexture.apply(this, all); },
  deleteTexture(texture) { count(this, texture ? -1 : 0); return deleteTexture.call(this, texture); },
});
const request = window.requestAnimationFrame;
window.requestAnimationFrame = (call) => { frames++; return request(call); };
window.books = () => {
  const alive = [...made].filter(([context]) => !context.isContextLost());
  return { contexts: alive.length, textures: alive.reduce((sum, [, textures]) => sum + textures, 0), frames };
};
"""
"""Script that counts live WebGL contexts, their textures and requested animation frames."""


@pytest.fixture(scope="module")
def software_browser():
    playwright = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    if not VENDOR.exists():
        pytest.skip("scripts/vendor has not run")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield browser
        browser.close()


class Preview:
    """A tab with the preview page, and what went wrong in it."""

    def __init__(self, browser, **options):
        self.context = browser.new_context(**{"viewport": {"width": 820, "height": 400}, **options})
        self.page = self.context.new_page()
        self.page.set_default_timeout(20_000)
        self.page.add_init_script(BOOKS)
        self.requests, self.wrong, self.origin = [], [], ""
        self.page.on("request", self._request)
        self.page.on("pageerror", lambda error: self.wrong.append(f"page error: {error}"))
        self.page.on("requestfailed", self._failed)
        self.page.on(
            "response", lambda answer: answer.status < 400 or self.wrong.append(f"{answer.status} {answer.url}")
        )
        self.page.on("console", self._console)

    def _request(self, asked):
        self.requests.append((asked.method, asked.url))
        if not asked.url.startswith((self.origin, "blob:", "data:")):
            self.wrong.append(f"elsewhere: {asked.url}")

    def _failed(self, asked):
        if "ERR_ABORTED" not in asked.failure:  # by the page itself, or by leaving it
            self.wrong.append(f"failed: {asked.url} {asked.failure}")

    def _console(self, said):
        if said.type == "error" or "Content Security Policy" in said.text or "too many" in said.text.lower():
            self.wrong.append(said.text)

    def forgive(self, *patterns):
        """Take these off the list of what went wrong; each must be on it."""
        for pattern in patterns:
            found = [line for line in self.wrong if re.search(pattern, line)]
            assert found, (pattern, self.wrong)
            self.wrong = [line for line in self.wrong if line not in found]

    def open(self, service, path=""):
        self.origin = service.url
        self.page.goto(f"{service.url}/preview/{path}")
        return self

    def shown(self, gaussians):
        """Wait for the scene and its final image; return that."""
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

    def still_image(self, seconds=20, still=3):
        """Return a screenshot once ``still`` ones, 0.2 s apart, are equal: Spark may still be sorting."""
        end = time.monotonic() + seconds
        seen = [self.pixels()]
        while time.monotonic() < end:
            self.page.wait_for_timeout(200)
            seen = [*seen[1 - still :], self.pixels()]
            if len(seen) == still and all(np.array_equal(seen[0], other) for other in seen[1:]):
                return seen[-1]
        raise AssertionError("the image does not become still")

    def health_problem(self, *words):
        """The one sentence, which has these words."""
        said = self.page.locator("#trouble:visible p")
        said.wait_for()
        text = said.inner_text()
        assert all(word in text for word in words), text
        assert re.fullmatch(r"[^\n]{10,250}[.]", text), text
        assert "fault of its own" not in text
        return text

    def choose(self, *files, button="#open"):
        """Through the dialog that a button opens; files are pairs of name and bytes."""
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
    """``preview(**options)`` opens a tab; at the end nothing may have gone wrong that was not forgiven."""
    tabs = []

    def begin(**options):
        tabs.append(Preview(software_browser, **options))
        return tabs[-1]

    yield begin
    for tab in tabs:
        tab.context.close()
    wrong = [line for tab in tabs for line in tab.wrong]
    assert not wrong, wrong


def looks_like(one, other):
    """Return the PSNR of two images."""
    return -10 * np.log10(max(np.mean((one - other) ** 2) / 255**2, 1e-10))


def colours(image):
    return len(np.unique(image.reshape(-1, 3), axis=0))
