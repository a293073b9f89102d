"""``kissgs view`` in Chromium, served and from disk; reference: a ``.ply`` of equal values that Spark itself reads."""

import json

import pytest
from helpers.page_server import serving, with_view
from helpers.preview_browser import colours, preview, psnr, software_browser  # noqa: F401  fixtures

import kissgs
from kissgs.preview import PageScene, page_scene, standalone_page

VIEW = {"eye": [0.0, -15.0, -60.0], "target": [0.0, 0.0, 0.0], "up": [0.0, -1.0, 0.0], "fov": 50.0}
NAME = "a 'b' <i>&amp; 100%41 \N{SNOWMAN}"


@pytest.fixture(scope="module")
def container():
    """Container with more pixels per image than the page decodes without a worker."""
    scene = kissgs.sample_scene(17_000, sh_degree=1)
    return with_view(kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip(), VIEW)


@pytest.fixture(autouse=True)
def same_view(monkeypatch):
    monkeypatch.setattr("kissgs.cameras.virtual.first_view.first_view_of", lambda *_: VIEW)


@pytest.fixture
def shown(preview):  # noqa: F811
    """``shown(scene, count)`` serves a scene and returns the page's image of it."""

    def show(scene, count):
        with serving(scene) as server:
            tab = preview().visit(server)
            image = tab.shown(count)
            assert tab.page.locator("#title").inner_text() == scene.name
        return image

    return show


REACH_OUT = """async () => {
  const reasons = [];
  addEventListener("securitypolicyviolation", (event) => reasons.push(event.effectiveDirective));
  await fetch("http://127.0.0.1:9/").catch(() => {});
  const image = new Image();
  await new Promise((done) => { image.onerror = done; image.src = "http://127.0.0.1:9/x.png"; });
  const script = document.createElement("script");
  script.textContent = "window.ran = true";
  document.body.append(script);
  await new Promise((done) => setTimeout(done));  // violations are reported later
  return JSON.stringify([reasons, window.ran ?? false]);
}"""
"""Function that tries to reach another host and to run a script, and returns what was blocked."""


def test_served_and_from_disk(tmp_path, container, shown, preview):  # noqa: F811
    splats = kissgs.decompress(container)
    served = shown(PageScene(f"{NAME}.zip", container, converted=False), len(splats))
    assert colours(served) > 1000
    kissgs.save(splats, tmp_path / "scene.ply")
    read = shown(page_scene(tmp_path / "scene.ply"), len(splats))
    assert psnr(read[:-80], served[:-80]) > 40  # below are the buttons, which differ

    path = tmp_path / "page # of.html"
    path.write_bytes(standalone_page(PageScene(f"{NAME}.zip", container, converted=False)))
    tab = preview(offline=True)
    tab.origin = path.as_uri()
    workers = []
    tab.page.on("worker", lambda worker: workers.append(worker.url))
    tab.page.goto(tab.origin)
    assert psnr(tab.shown(len(splats)), served) > 60
    assert tab.page.title() == f"{NAME}.zip · kissgs"
    assert len(workers) > 1  # one that decodes, one that sorts
    assert [url for _, url in tab.requests if not url.startswith("blob:")] == [tab.origin]
    blocked = tab.page.evaluate(REACH_OUT)
    assert json.loads(blocked) == [["connect-src", "img-src", "script-src-elem"], False]
    tab.expect_errors("^Fetch API cannot load", "^other host: .*/x.png", "^failed: .*/x.png csp", "violates")
