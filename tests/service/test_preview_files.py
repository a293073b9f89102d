"""The preview of local files in Chromium, and its accessibility; oracle: the files decoded in Python."""

import io
import json
import re
import zipfile

import numpy as np
import pytest
from helpers.preview_browser import colours, psnr
from helpers.service import scene_bytes
from PIL import Image

import kissgs

PLY = scene_bytes(800, 1, seed=3)
ZIP = kissgs.compress(PLY, settings=kissgs.Settings(preset="fast")).to_zip()
COUNT = len(kissgs.decompress(ZIP))
OTHER = kissgs.compress(scene_bytes(400, 0, seed=5), settings=kissgs.Settings(preset="fast")).to_zip()
OTHERS = len(kissgs.decompress(OTHER))


def test_choosing_files(preview, service):
    tab = preview().open(service)
    page = tab.page
    tab.choose(("garden.zip", ZIP), button="#choose")
    alone = tab.shown(COUNT)
    assert colours(alone) > 3000
    assert page.get_by_role("heading", name="garden").is_visible()
    tab.fact("Original", "not known")
    assert f"{len(ZIP):,}" in page.locator("#statistics").inner_text()
    asked = len(tab.requests)
    tab.choose(("garden.ply", PLY), button="#compare")
    page.get_by_role("slider").wait_for()
    tab.fact("Original", f"{len(PLY) / len(ZIP):.3g}×of {len(PLY) / 1000:.3g} kB")
    tab.choose(("b.zip", OTHER))
    tab.shown(OTHERS)
    assert page.get_by_role("slider").count() == 0
    code = re.compile(f"blob:|data:|{service.url}/preview/[a-z]+[.]js$")  # of workers
    assert [url for method, url in tab.requests[asked:] if method != "GET" or not code.match(url)] == []
    assert not any("/v1/" in url for _, url in tab.requests)
    assert not page.locator("#problem").is_visible()
    page.evaluate(
        "document.querySelector('#viewport').getContext('webgl2').getExtension('WEBGL_lose_context').loseContext()"
    )
    tab.error_message("graphics driver has reset", "reload the page")
    tab.drop(("a.zip", ZIP))
    tab.fact("Gaussians", f"{COUNT:,}")
    tab.error_message("graphics driver has reset")


UNSUITABLE = {
    "letter.txt": (b"Dear reader,\n" * 99, ["zip"]),
    "half.zip": (ZIP[: len(ZIP) // 2], ["zip"]),
    "half.ply": (PLY[: len(PLY) // 2], ["half.ply"]),
    "garden.glb": (b"anything", ["does not open glTF", '"kissgs view garden.glb"']),
    "mesh.ply": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", ["mesh.ply"]),
}


def test_what_cannot_be_shown(preview, service):
    """Invalid addresses, files of other kinds, a scene without Gaussians, a small file that claims to be a large scene;
    a scene that is shown stays."""
    tab = preview()
    for address in ("%25E0%25A4%25A.zip", "http://[bad"):
        tab.open(service, f"?src={address}").error_message("not an address")
        assert tab.page.locator("#empty").is_visible()
    tab.open(service)
    assert_progress_never_decreases(tab.page)
    for name, (data, words) in UNSUITABLE.items():
        tab.drop((name, data))
        tab.error_message(*words)
        assert tab.page.locator("#empty").is_visible()
    tab.drop(("b.zip", OTHER))
    before = tab.shown(OTHERS)
    assert not tab.page.locator("#problem").is_visible()
    for name, (data, words) in UNSUITABLE.items():
        tab.drop((name, data))
        tab.error_message(*words)
        tab.page.get_by_role("button", name="Dismiss").click()
    assert psnr(tab.shown(OTHERS), before) > 60

    none = kissgs.compress(scene_bytes(0, 0), settings=kissgs.Settings(preset="fast")).to_zip()
    tab.drop(("none.zip", none))
    tab.shown(0)
    tab.fact("Per Gaussian", "none")
    assert not tab.page.locator("#problem").is_visible()
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(ZIP)) as original, zipfile.ZipFile(file, "w") as other:
        meta = json.loads(original.read("meta.json")) | {"count": 11_000_000, "gridSide": 3400}
        for name in original.namelist():
            other.writestr(name, json.dumps(meta) if name == "meta.json" else original.read(name))
    tab.drop(("large.zip", file.getvalue()))
    assert "10000000" in re.sub("[ ,]", "", tab.error_message("arger than", "Gaussians"))


@pytest.mark.quick(0)
def test_one_scene_after_the_other_releases_the_first(preview, service):
    """Browsers limit the number of WebGL contexts to 16."""
    tab = preview().open(service)
    first, counts = None, []
    for turn in range(20):
        name, data, count = [("a", ZIP, COUNT), ("b", OTHER, OTHERS)][turn % 2]
        tab.drop((f"{name}{turn}.zip", data), (f"{name}.ply", PLY))
        tab.page.locator("#title", has_text=f"{name}{turn}").wait_for()
        tab.page.get_by_role("slider").wait_for()
        tab.page.locator("#loading").wait_for(state="hidden")
        tab.fact("Gaussians", f"{count:,}")
        if turn in (1, 19):
            tab.page.locator("#compare").click()  # ends it
            image = tab.still_image()
            first = image if first is None else first
            counts.append(tab.page.evaluate("resourceCounts()"))
    assert colours(first) > 3000
    assert psnr(image, first) > 60
    assert counts[1]["contexts"] == counts[0]["contexts"] <= 2
    assert counts[1]["textures"] <= counts[0]["textures"] + 8


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.quick(1)
def test_accessibility(preview, service, scheme):
    tab = preview(color_scheme=scheme, reduced_motion="reduce", viewport={"width": 820, "height": 700}).open(service)
    page = tab.page
    assert [node for node in controls(tab) if not node[1]] == []
    page.set_viewport_size({"width": 360, "height": 500})
    assert page.evaluate("document.documentElement.scrollWidth") <= 360
    page.set_viewport_size({"width": 820, "height": 700})
    tab.drop(("a.zip", ZIP), ("a.ply", PLY))
    page.get_by_role("slider").wait_for()
    tab.fact("Gaussians", f"{COUNT:,}")
    page.locator("#loading").wait_for(state="hidden")
    assert_focus_is_visible(page)
    tab.drop(("letter.txt", b"Dear reader"))
    tab.error_message("zip")
    found = controls(tab)
    assert {"button", "slider", "link"} <= {role for role, _ in found}
    assert [node for node in found if not node[1]] == []
    assert len(found) > 15
    assert page.get_by_role("slider").get_attribute("aria-valuenow") == "50"
    assert page.evaluate(LOW_CONTRAST) == []
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).map(Number)")
    assert (np.mean(dark) < 60) == (scheme == "dark")
    assert page.evaluate(ANIMATED) == []
    assert_no_horizontal_overflow(tab)


def assert_no_horizontal_overflow(tab):
    tab.drop((f"{'a-very-long-name' * 9}.zip", OTHER))
    tab.fact("Gaussians", f"{OTHERS:,}")
    tab.page.locator("#loading").wait_for(state="hidden")
    for width in (360, 1400):
        tab.page.set_viewport_size({"width": width, "height": 500})
        assert tab.page.evaluate("document.documentElement.scrollWidth") <= width
        assert tab.page.locator("#panel").evaluate("(it) => it.scrollWidth <= it.clientWidth")
        tools = tab.page.locator("#tools").bounding_box()
        assert tools["x"] >= 0
        assert tools["x"] + tools["width"] <= width


def assert_focus_is_visible(page):
    """Assert that the tabulator key reaches every control, and that its focus is seen."""
    page.locator("#home").focus()
    seen = []
    for _ in range(40):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(
            """() => {
              const at = document.activeElement;
              const seen = at.classList.contains("handle") ? at.querySelector("span") : at;
              const { outlineStyle, outlineWidth } = getComputedStyle(seen);
              return [at.id || at.className || at.tagName, outlineStyle === "none" ? "0" : outlineWidth];
            }"""
        )
        if name == "BODY":
            break
        assert re.fullmatch(r"[2-9]px", outline), name
        seen.append(name)
    wanted = {"open", "viewport", "handle", "compare", "reset", "background", "fullscreen", "panels", "help", "thumb"}
    assert wanted <= set(seen)
    assert seen.count("thumb") == 9
    assert "file" not in seen


def controls(tab):
    """Return role and name of all controls in the accessibility tree."""
    tree = tab.context.new_cdp_session(tab.page).send("Accessibility.getFullAXTree")["nodes"]
    roles = ("button", "slider", "link", "application", "textbox")
    nodes = [(node.get("role", {}).get("value"), node.get("name", {}).get("value")) for node in tree]
    return [(role, name) for role, name in nodes if role in roles]


LOW_CONTRAST = """() => {
  const parts = (colour) => {
    const [r, g, b, a = 1] = colour.match(/[0-9.]+/g).map(Number);
    return [r, g, b, a];
  };
  const over = ([r, g, b, a], below) => [r, g, b].map((part, i) => part * a + below[i] * (1 - a));
  const light = (rgb) => {
    const [r, g, b] = rgb.map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const ground = (element) => {
    if (!element) return [255, 255, 255];
    const colour = parts(getComputedStyle(element).backgroundColor);
    return colour[3] === 1 ? colour.slice(0, 3) : over(colour, ground(element.parentElement));
  };
  const faint = [];
  for (const element of document.querySelectorAll(".top *, .panel *, .tools *, .problem *, .side")) {
    const text = [...element.childNodes].some((node) => node.nodeType === 3 && node.data.trim());
    if (!text || !element.checkVisibility()) continue;
    const below = ground(element);
    const ink = over(parts(getComputedStyle(element).color), below);
    const [dark, bright] = [light(ink), light(below)].sort((a, b) => a - b);
    if ((bright + 0.05) / (dark + 0.05) < 4.5) faint.push(element.textContent);
  }
  return faint;
}"""

ANIMATED = """() => [...document.querySelectorAll("*")].filter((element) => {
  const { transitionDuration, transitionProperty, animationName } = getComputedStyle(element);
  return (transitionProperty !== "none" && parseFloat(transitionDuration) > 0) || animationName !== "none";
}).map((element) => element.outerHTML)"""


def assert_progress_never_decreases(page):
    states = [(0, 400, 0), (200, 400, 0), (200, 4000, 0), (400, 4000, 3), (4500, 4000, 9)]
    shares, texts = zip(*page.evaluate(PROGRESS, states), strict=True)
    assert shares == (None, 0.25, 0.25, 0.25, 1)
    assert texts[1] == "200 bytes of 400 bytes · 0 of 9 planes"
    assert page.evaluate(PROGRESS, [(0, 0, 0), (0, 0, 3), (70, 0, 6)]) == [
        [None, "0 of 9 planes"],
        [pytest.approx(1 / 3), "3 of 9 planes"],
        [pytest.approx(2 / 3), "70 bytes · 6 of 9 planes"],
    ]


PROGRESS = """async (states) => {
  const { loader } = await import("./preview/loading.js");
  const { progress, done } = loader().begin("A test");
  const [bar, amount] = ["#loading-bar", "#loading-amount"].map((id) => document.querySelector(id));
  const seen = states.map(([received, total, decoded]) => {
    progress({ received, total, decoded, planes: 9 });
    return [bar.getAttribute("value") && bar.value, amount.textContent];
  });
  done();
  return seen;
}"""


def levels_of(file):
    with zipfile.ZipFile(io.BytesIO(ZIP)) as archive:
        return np.asarray(Image.open(io.BytesIO(archive.read(file))).convert("RGBA"))


@pytest.mark.quick(0)
def test_touch_marks_a_gaussian(preview, service):
    tab = preview(viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True).open(service)
    tab.drop(("a.zip", ZIP))
    before = tab.shown(COUNT)
    canvas, readout = tab.page.locator(".plane canvas"), tab.page.locator(".readout")
    assert "tap" in readout.inner_text()
    canvas.scroll_into_view_if_needed()
    size = canvas.bounding_box()["width"]
    side = int(canvas.get_attribute("width"))
    splats = kissgs.decompress(ZIP)
    index = np.argmin(np.linalg.norm(splats.means, axis=1))  # in the image
    mask = levels_of("active_mask.webp")[..., 0]
    row, column = divmod(int(np.flatnonzero(mask)[index]), side)
    canvas.tap(position={"x": (column + 0.5) / side * size, "y": (row + 0.5) / side * size})
    readout.get_by_text(f"Column {column}, row {row}: Gaussian {index}").wait_for()
    assert psnr(tab.still_image(), before) < 50  # the marker is visible
    box = canvas.bounding_box()
    finger = tab.context.new_cdp_session(tab.page)
    for kind, across in (("touchStart", 0.1), *(("touchMove", 0.1 * step) for step in range(2, 9)), ("touchEnd", None)):
        points = [] if across is None else [{"x": box["x"] + across * size, "y": box["y"] + 0.2 * size}]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    assert f"Column {int(0.8 * side)}, row {int(0.2 * side)}: " in readout.inner_text()
    tab.page.wait_for_timeout(200)
    assert tab.page.locator(".cursor").is_visible()


IDLE = """
window.waiting = [];
window.requestIdleCallback = (call) => waiting.push(call);
window.painted = () =>
  [...document.querySelectorAll(".thumb canvas")].map((canvas) => pixelsOf(canvas).some(Boolean));
window.pixelsOf = (canvas) => [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
"""


@pytest.mark.parametrize("idle", [True, False])
@pytest.mark.quick(1)
def test_planes_show_their_levels(preview, service, idle):
    tab = preview()
    if not idle:
        tab.page.add_init_script("delete window.requestIdleCallback")
    tab.page.add_init_script(IDLE.replace("window.requestIdleCallback =", "window.unused ="))
    tab.open(service)
    tab.drop(("a.zip", ZIP))
    tab.shown(COUNT)
    tab.page.wait_for_function("painted().length === 9 && painted().every(Boolean)")
    for name, file in (("Mask", "active_mask"), ("Rotations", "quaternions"), ("Base colours", "f_dc")):
        levels = levels_of(f"{file}.webp").astype(float)
        levels[..., :3] = np.rint(255 * levels[..., :3] / levels[..., :3].max())
        levels[..., 3] = 255
        thumb = tab.page.get_by_role("button", name=name, exact=True)
        assert thumb.locator("canvas").evaluate("(it) => pixelsOf(it)") == levels.ravel().tolist()
        thumb.click()
        assert tab.page.locator(".plane canvas").evaluate("(it) => pixelsOf(it)") == levels.ravel().tolist()
