"""The first frame of the page. Oracle: where the pixels of a subject of a known colour are."""

import numpy as np
import pytest
from helpers.hollow_scenes import box, surface
from helpers.page_server import serving, with_view
from helpers.preview_browser import colours, preview, psnr, software_browser  # noqa: F401  fixtures

import kissgs
from kissgs.core.splats import concatenate
from kissgs.preview import PageScene, page_scene

CENTRE = np.array([3.0, 2.0, -1.0])
COUNT = 2100
RECORD = {"eye": [7.0, 2.5, 0.5], "target": [3.0, 2.0, -1.0], "up": [0.0, 0.1, 0.995], "fov": 40}

TIMES = """
const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
window.events = [];
WebGL2RenderingContext.prototype.drawElementsInstanced = function (...all) {
  if (all[4] > 1000) window.events.push("scene");
  window.latest = all[4];
  return draw.apply(this, all);
};
new MutationObserver(() => {
  for (const id of ["statistics", "planes"])
    if (document.getElementById(id)?.childElementCount && !window.events.includes(id)) window.events.push(id);
  window.before = document.getElementById("statistics")?.childElementCount ? (window.before ?? window.latest) : null;
}).observe(document, { childList: true, subtree: true });
"""
"""Script that notes the order in which the scene, its statistics and its planes appear.

``before`` is the number of Gaussians in the latest frame before the statistics.
"""


@pytest.fixture(scope="module")
def container():
    """A container: a green box whose z points up, beside the origin, and red floaters far from it."""
    subject = box((0.3, 0.4, 0.9), 2000, 0.05)
    rng = np.random.default_rng(0)
    floaters = surface(rng.normal(size=(100, 3)) * 20, np.zeros(100, int), 0.02)
    scene = concatenate([subject, floaters])
    scene.means[:] += np.float32(CENTRE)
    scene.sh0[:2000] = [-1.7, 1.7, -1.7]
    scene.sh0[2000:] = [1.7, -1.7, -1.7]
    return kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip()


def page_with(container, view):
    return PageScene("scene.zip", with_view(container, view), converted=False)


@pytest.fixture
def opened(preview):  # noqa: F811
    """``opened(scene, **options)`` opens a scene in a tab, and returns it with the image."""

    def begin(scene, **options):
        tab = preview(**options)
        tab.page.add_init_script(TIMES)
        with serving(scene) as server:
            return tab, tab.visit(server).shown(COUNT)

    return begin


def extent(tab, image):
    """Return the box around the green pixels, as shares of the canvas above the buttons: left, right, top, bottom."""
    stage, tools = (tab.page.locator(name).bounding_box() for name in ("#stage", "#tools"))
    rows, columns = np.nonzero((image[:, :, 1] > 100) & (image[:, :, 0] < 90))
    free = tools["y"] - stage["y"]
    return (
        np.array([columns.min(), columns.max(), rows.min(), rows.max()])
        / [stage["width"]]
        * np.array([1, 1, stage["width"] / free, stage["width"] / free])
    )


def assert_whole(box, tolerance=0.06):
    left, right, top, bottom = box
    assert left > 0.01
    assert right < 0.99
    assert top > 0.01
    assert bottom < 0.99
    assert abs(left + right - 1) < tolerance
    assert abs(top + bottom - 1) < tolerance


def test_the_recorded_view_is_whole_and_home_and_the_centre_of_orbits(container, opened, tmp_path):
    tab, image = opened(page_with(container, RECORD))
    assert_whole(extent(tab, image))
    assert np.ptp(extent(tab, image)[2:]) > 0.3, "z is up, so that the box is tall"
    assert tab.page.evaluate(
        "events.indexOf('scene') < Math.min(...['statistics', 'planes'].map((id) => events.indexOf(id)))"
    )
    tab.page.locator("#viewport").focus()
    for _ in range(4):
        tab.page.keyboard.press("ArrowLeft", delay=60)
    turned = tab.still_image()
    assert psnr(turned, image) < 40
    assert_whole(extent(tab, turned))
    tab.page.keyboard.press("Home")
    inside = slice(8, -8)  # without the mark of the focus
    assert psnr(tab.still_image()[inside, inside], image[inside, inside]) > 50
    kissgs.save(kissgs.decompress(container), tmp_path / "scene.ply")
    tab.drop(("scene.ply", (tmp_path / "scene.ply").read_bytes()))
    tab.page.get_by_role("slider").wait_for()
    tab.page.locator("#viewport").focus()
    tab.page.keyboard.press("ArrowLeft")
    turned = tab.still_image()
    for height in (500, 400):
        tab.page.set_viewport_size({"width": 820, "height": height})
        resized = tab.still_image()
    assert psnr(resized, turned) > 50, "the original keeps the recorded angle of view"
    smaller = kissgs.compress(box((0.3, 0.4, 0.9), 600, 0.05), settings=kissgs.Settings(preset="fast"))
    tab.drop(("smaller.zip", smaller.to_zip()))
    tab.shown(600)
    assert 0 < tab.page.evaluate("before") <= 600, "its frame, not one of the former scene, is before its statistics"


def test_narrow_windows_show_it_whole(container, opened):
    tab, image = opened(page_with(container, {**RECORD, "fov": 30}), viewport={"width": 375, "height": 700})
    assert_whole(extent(tab, image))


def test_without_a_possible_record_what_is_dense_is_framed(container, opened, tmp_path):
    tab, image = opened(page_with(container, {**RECORD, "target": RECORD["eye"]}))
    assert_whole(extent(tab, image), 0.2)  # what is near is larger
    assert colours(image) > 20
    kissgs.save(kissgs.decompress(container), tmp_path / "scene.ply")
    scene = page_scene(tmp_path / "scene.ply")
    assert b"\ncomment kissgs view {" in scene.data[:2000]
    tab, image = opened(scene)
    assert_whole(extent(tab, image), 0.3)  # what is near is larger
