"""The preview of a job in Chromium; oracles: the container decoded in Python, and a ``.ply`` that Spark reads."""

import io
import json
import zipfile
from dataclasses import dataclass

import numpy as np
import pytest
from helpers.preview_browser import assert_readout, colours, psnr
from helpers.running import wait_until
from helpers.service import FAST, keys_of, scene_bytes
from PIL import Image

import kissgs


@dataclass
class Shown:
    """A job, and its container, decoded."""

    job: dict
    files: dict[str, bytes]
    splats: kissgs.Splats

    def levels(self, name):
        return np.asarray(Image.open(io.BytesIO(self.files[name])))


def shown_job(service, options):
    job = service.ended(service.submit(scene_bytes(1500, 3), options=options))
    container = service.http.get(job["links"]["result"]).content
    with zipfile.ZipFile(io.BytesIO(container)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    return Shown(job, files, kissgs.decompress(container))


@pytest.fixture(scope="module")
def xt(service):
    return shown_job(service, FAST)


@pytest.fixture(scope="module")
def sog(service):
    return shown_job(service, json.dumps({"preset": "fast", "format": "sog"}))


def assert_job_is_shown(tab, shown, planes, names):
    """Assert that the page has the facts of a job, its files and its planes."""
    page, job, count = tab.page, shown.job, len(shown.splats)
    assert page.get_by_role("heading", name="a scene").is_visible()
    assert page.title() == "a scene · kissgs"
    assert page.locator("#live").inner_text() == f"a scene: {count:,} Gaussians."
    facts = page.locator("#statistics .facts").inner_text()
    assert f"{job['sizes']['container']:,}" in facts
    assert f"{job['sizes']['ratio']:.3g}×" in facts
    sizes = [in_bytes(text) for text in page.locator(".bytes tbody td:nth-child(3)").all_inner_texts()]
    assert sum(sizes) == pytest.approx(job["sizes"]["container"], rel=0.002)
    shares = [float(text.strip("<% ")) for text in page.locator(".bytes tbody td:nth-child(4)").all_inner_texts()]
    assert sum(shares) == pytest.approx(100, abs=0.6)
    thumbs = page.locator(".thumb span").all_inner_texts()
    assert (len(thumbs), names - set(thumbs)) == (planes, set())


def test_a_job_of_sog(preview, service, sog, tmp_path):
    tab = preview().open(service, sog.job["id"])
    image = tab.shown(len(sog.splats))
    assert colours(image) > 5000
    assert (image.max(axis=2) > 40).mean() > 0.3
    assert_job_is_shown(tab, sog, 7, {"Positions, high bytes"})
    rows = {"Colours, opacities", "Rotations", "SH codebook", "SH labels", "Metadata"}
    assert set(tab.page.locator(".bytes tbody th").all_inner_texts()) >= rows
    kissgs.save(sog.splats, tmp_path / "scene.ply")
    read = preview().open(service)
    read.drop(("scene.ply", (tmp_path / "scene.ply").read_bytes()))
    assert psnr(read.shown(len(sog.splats))[:-80], image[:-80]) > 40  # below are the buttons, which differ


def test_jobs_in_other_formats(preview, service):
    tab = preview()
    for kind in ("spz", "compressed.ply"):
        job = service.ended(service.submit(scene_bytes(1500, 3), options=json.dumps({"format": kind})))
        tab.open(service, job["id"])
        assert colours(tab.shown(1500)) > 3000, kind
        assert f"{job['sizes']['container']:,}" in tab.page.locator("#statistics").inner_text()


def in_bytes(text):
    number, unit = text.split()
    return float(number.replace(",", "")) * {"byte": 1, "bytes": 1, "kB": 1e3, "MB": 1e6}[unit]


@pytest.mark.quick(0)
def test_keys_and_mouse_move_the_camera(preview, service, xt):
    tab = preview().open(service, xt.job["id"])
    page, press = tab.page, tab.page.keyboard.press
    home = tab.shown(len(xt.splats))
    page.locator("#viewport").focus()
    still = tab.still_image()
    frames = page.evaluate("resourceCounts().frames")
    page.wait_for_timeout(700)
    assert page.evaluate("resourceCounts().frames") == frames  # nothing moves, so nothing is drawn
    assert (tab.pixels() == still).all()
    for key in ("ArrowLeft", "a"):
        press(key)
        moved = tab.still_image()
        assert psnr(moved, still) < 40, key
        press("Home")
        assert psnr(tab.still_image(), still) > 60, key
    for key, least, most in (("+", 1.3, 3), ("-", 0.3, 0.8)):
        for _ in range(8):
            press(key)
        assert least < red(tab.still_image()) / red(still) < most, key
        press("r")
    assert psnr(tab.still_image(), still) > 60
    middle = page.locator("#viewport").bounding_box()
    at = (middle["x"] + middle["width"] / 2, middle["y"] + middle["height"] / 2)
    page.mouse.move(*at)
    page.mouse.wheel(0, -300)
    assert psnr(tab.still_image(), still) < 35
    page.locator("#reset").click()
    page.mouse.move(*at)
    page.mouse.down()
    page.mouse.move(at[0] + 60, at[1], steps=3)
    page.mouse.up()
    assert psnr(tab.still_image(), home) < 35


def red(image):
    """Return the number of red pixels, which belong to the ball."""
    return ((image[..., 0] > 120) & (image[..., 1] < 80) & (image[..., 2] < 80)).sum()


@pytest.mark.quick(0)
def test_panels_and_help(preview, service, xt):
    tab = preview().open(service, xt.job["id"])
    page = tab.page
    narrow = tab.shown(len(xt.splats))
    page.locator("#viewport").focus()
    page.keyboard.press("h")
    assert not page.locator("#panel").is_visible()
    assert page.locator("#panels").get_attribute("aria-pressed") == "true"
    wide = tab.still_image()
    assert wide.shape == (400, 820, 3) > narrow.shape
    assert colours(wide) > 5000
    page.locator("#panels").click()
    assert page.locator("#panel").is_visible()
    page.locator("#viewport").focus()
    page.keyboard.press("?")
    assert page.get_by_role("dialog").get_by_text("Reset the view").is_visible()
    page.keyboard.press("Escape")
    assert not page.get_by_role("dialog").is_visible()
    page.locator("#background").click()
    assert tab.page.locator("#background").get_attribute("aria-pressed") == "true"
    before, after = ((image[:-80].max(axis=2) < 40).sum() for image in (narrow, tab.still_image()))
    assert after < before / 2


def test_a_job_of_sogxt_and_its_original(preview, service, xt):
    tab = preview().open(service, xt.job["id"])
    page = tab.page
    before = tab.shown(len(xt.splats))
    assert colours(before) > 5000
    assert (before.max(axis=2) > 40).mean() > 0.3
    assert_job_is_shown(tab, xt, 9, {"Mask", "Base colours", "Rotations"})
    page.get_by_role("button", name="Compare with original").click()
    handle = page.get_by_role("slider", name="original")
    handle.wait_for()
    page.locator("#loading").wait_for(state="hidden")
    assert page.locator(".original-side", has_text="original").is_visible()
    assert page.locator(".compressed-side", has_text="compressed").is_visible()

    def share():
        return int(handle.get_attribute("aria-valuenow"))

    assert share() == 50
    handle.focus()
    for key, place in (("ArrowRight", 52), ("ArrowDown", 50), ("PageUp", 60), ("PageDown", 50), ("Home", 0)):
        page.keyboard.press(key)
        assert share() == place
    free = np.s_[60:-80, 60:-60]  # without the handle, labels and tools
    compressed = tab.still_image()
    assert psnr(compressed[free], before[free]) > 60
    page.keyboard.press("End")
    assert share() == 100
    original = tab.still_image()
    between = psnr(original[free], compressed[free])
    assert 20 < between < 50
    for turned in (original[free][:, ::-1], original[free][::-1]):
        assert psnr(turned, compressed[free]) < between - 5
    box, stage = handle.bounding_box(), page.locator("#stage").bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2 - 5, stage["y"] + 200)
    page.mouse.down()
    page.mouse.move(stage["x"] + 0.25 * stage["width"], stage["y"] + 200, steps=3)
    page.mouse.up()
    assert share() == 25
    both, width = tab.still_image(), before.shape[1]
    left, right = np.s_[60:-80, 20 : int(0.25 * width) - 30], np.s_[60:-80, int(0.25 * width) + 30 : -20]
    assert psnr(both[left], original[left]) > 60
    assert psnr(both[right], compressed[right]) > 60
    page.locator("#viewport").focus()
    page.keyboard.press("ArrowLeft")  # both scenes rotate
    turned = tab.still_image()
    assert psnr(turned[left], both[left]) < 45
    assert psnr(turned[right], both[right]) < 45
    page.get_by_role("button", name="End comparison").click()
    assert page.get_by_role("slider").count() == 0
    assert page.get_by_role("button", name="Compare with original").is_visible()
    page.locator("#home").click()
    page.get_by_text("smaller").first.wait_for()


ORANGE = (255, 176, 32)


def marked(image, before):
    """Return the marker's column, row and extent, pixels."""
    orange = np.abs(image - ORANGE).max(axis=2) < 60
    rows, columns = np.nonzero(orange & (np.abs(image - before).max(axis=2) > 30))
    assert len(columns) > 20
    return np.median(columns), np.median(rows), max(columns.std(), rows.std())


@pytest.mark.quick(0)
def test_hovering_over_a_plane(preview, service, xt):
    tab = preview(viewport={"width": 820, "height": 760}).open(service, xt.job["id"])
    page = tab.page
    before = tab.shown(len(xt.splats))
    decoded, mask = xt.splats, xt.levels("active_mask.webp")
    labels, levels = xt.levels("f_rest_labels.webp"), xt.levels("scales.webp")
    book = len(xt.levels("f_rest_centroids.webp")) // 3
    side = len(mask)
    cells = np.flatnonzero(mask.reshape(side * side, -1)[:, 0])
    page.get_by_role("button", name="Scales").click()
    canvas = page.locator(".plane canvas")

    def point_at(cell):
        box = canvas.bounding_box()
        size = box["width"] / side
        canvas.hover(position={"x": (cell % side + 0.5) * size, "y": (cell // side + 0.5) * size})
        return page.locator(".readout")

    central = np.flatnonzero((np.linalg.norm(decoded.means, axis=1) < 2.5) & (decoded.opacities > 2))
    leftmost, rightmost, lowest = (
        central[at(decoded.means[central, axis])] for axis, at in ((0, np.argmin), (0, np.argmax), (1, np.argmax))
    )
    markers = {}
    for index in (leftmost, rightmost, lowest):
        readout = point_at(cells[index])
        column, row = cells[index] % side, cells[index] // side
        readout.get_by_text(f"Column {column}, row {row}: Gaussian {index:,}").wait_for()
        entry = assert_readout(readout, decoded, index, levels[row, column], rotation=6e-4)
        assert entry == [labels[row, column, 0] + book * labels[row, column, 1]]
        markers[index] = marked(tab.still_image(), before)
        assert markers[index][2] < 40
    assert markers[leftmost][0] < markers[rightmost][0] - 50
    assert markers[lowest][1] > min(markers[leftmost][1], markers[rightmost][1])
    padding = np.flatnonzero(mask.reshape(side * side, -1)[:, 0] == 0)[-1]
    assert "padding" in point_at(padding).inner_text()
    assert psnr(tab.still_image(), before) > 60
    canvas.press("ArrowLeft")
    assert f"Column {padding % side - 1}" in page.locator(".readout").inner_text()
    page.get_by_role("button", name="SH codebook").click()
    assert "Enlarge" in page.locator(".plane").inner_text()
    page.locator(".plane canvas").hover(position={"x": 2, "y": 2})
    assert "Entry 0, coefficient 1" in page.locator(".readout").inner_text()


@pytest.mark.quick(0)
def test_pointing_at_planes_of_sog(preview, service, sog):
    decoded, labels, levels = sog.splats, sog.levels("shN_labels.webp").astype(int), sog.levels("scales.webp")
    height, width = levels.shape[:2]
    tab = preview(viewport={"width": 820, "height": 760}).open(service, sog.job["id"])
    page = tab.page
    tab.shown(len(decoded))
    page.get_by_role("button", name="Scales").click()

    def point_at(x, y, columns):
        canvas = page.locator(".plane canvas")
        size = canvas.bounding_box()["width"] / columns
        canvas.hover(position={"x": (x + 0.5) * size, "y": (y + 0.5) * size})
        return page.locator(".readout")

    for index in (0, 700, len(decoded) - 1):
        x, y = index % width, index // width
        readout = point_at(x, y, width)
        readout.get_by_text(f"Column {x}, row {y}: Gaussian {index:,}").wait_for()
        entry = assert_readout(readout, decoded, index, levels[y, x], rotation=2e-3)
        assert entry == [labels[y, x, 0] + 256 * labels[y, x, 1]]
    if width * height > len(decoded):
        assert "padding" in point_at(width - 1, height - 1, width).inner_text()
    page.get_by_role("button", name="SH codebook").click()
    canvas = page.locator(".plane canvas")
    canvas.focus()
    for _ in range(16):
        canvas.press("ArrowRight")
    text = page.locator(".readout").inner_text()
    assert "Entry 1, coefficient 2: " in text  # 15 pixels of entry 0 come first
    assert "levels " + " ".join(map(str, sog.levels("shN_centroids.webp")[0, 16])) in text
    used = labels[..., 0].ravel()[: len(decoded)] + 256 * labels[..., 1].ravel()[: len(decoded)] == 1
    assert f"used by {used.sum():,} Gaussians" in text


def flipped(body):
    return body[: len(body) // 2] + bytes([body[len(body) // 2] ^ 0x55]) + body[len(body) // 2 + 1 :]


def halved(body):
    return body[: len(body) // 2]


def wrong_magic(body):
    return b"RIFF" + body[5:]


@pytest.mark.parametrize(
    ("kind", "file", "damage"),
    [
        ("xt", "f_dc.webp", flipped),
        ("sog", "quats.webp", halved),
        ("xt", "scales.webp", halved),
        ("xt", "f_rest_centroids.webp", None),
        ("sog", "shN_centroids.webp", halved),
        ("sog", "sh0.webp", halved),
        ("xt", "means_bytes_1.webp", flipped),
        ("sog", "meta.json", halved),
        ("xt", "meta.json", halved),
        ("xt", "active_mask.webp", wrong_magic),
    ],
)
@pytest.mark.quick(2)
def test_the_message_names_a_damaged_file(preview, service, request, kind, file, damage):
    """The rest of the scene is drawn, if there are positions."""
    shown = request.getfixturevalue(kind)
    tab = preview()

    def respond(route):
        answer = route.fetch()
        status, body = (200, damage(answer.body())) if damage else (404, b"{}")
        route.fulfill(status=status, body=body)

    tab.page.route(f"**/files/{file}", respond)
    tab.open(service, shown.job["id"])
    tab.error_message(file, *(() if damage else ("404",)))
    tab.page.locator("#loading").wait_for(state="hidden")
    if file in ("meta.json", "active_mask.webp", "means_bytes_1.webp"):
        tab.page.locator("#empty").wait_for()
        assert not tab.page.locator("#viewport").is_visible()
        if file != "meta.json":
            assert tab.page.locator("#planes .thumb").count() == (8 if file.startswith("means") else 0)
    else:
        tab.shown(len(shown.splats))
        tab.fact("Loaded in", "cut short")
    if damage is None:
        tab.expect_errors("^404 ", "Failed to load resource.*404")
    tab.page.get_by_role("button", name="Dismiss").click()
    assert not tab.page.locator("#problem").is_visible()


@pytest.mark.quick(0)
def test_the_scene_is_drawn_without_damaged_planes(preview, service, xt):
    tab = preview(viewport={"width": 820, "height": 760})

    def opened(damaged=None):
        tab.page.unroute_all()
        if damaged:
            tab.page.route(f"**/files/{damaged}.webp", lambda route: route.fulfill(body=flipped(route.fetch().body())))
        tab.open(service, xt.job["id"])
        if damaged:
            tab.error_message(f"{damaged}.webp")
            tab.fact("Loaded in", "cut short")
            assert tab.page.locator("#planes .thumb").count() == 8
            tab.page.get_by_role("button", name="Dismiss").click()
        return tab.shown(len(xt.splats))

    def readout():
        tab.page.locator(".plane canvas").hover(position={"x": 3, "y": 3})
        return tab.page.locator(".readout").inner_text()

    def bright(image):
        return (image[:-80].max(axis=2) > 40).mean()

    def saturation(image):
        return (image.max(axis=2) - image.min(axis=2)).mean()

    intact = opened()
    assert "not known" not in readout()
    grey = opened("f_dc")
    assert readout().count("not known") == 1
    assert bright(grey) > 0.6
    assert saturation(grey) < saturation(intact) / 3
    assert 0.1 < bright(opened("scales")) < 0.4
    for file in ("opacities", "quaternions", "means_bytes_0"):
        assert 22 < psnr(opened(file), intact) < 40, file
    base = [opened(file) for file in ("f_rest_labels", "f_rest_centroids")]
    assert 30 < psnr(base[0], intact) < 45
    assert psnr(*base) > 60


def test_jobs_without_a_result(start, preview):
    service = start()
    job = service.hold()
    tab = preview().open(service, job["id"])
    assert "running" in tab.error_message("no container")
    service.cancel(job)
    tab.open(service, job["id"])
    assert "cancelled" in tab.error_message("no container")
    tab.open(service, "0" * 32)
    tab.error_message("does not have this")
    assert tab.page.locator("#empty").is_visible()
    tab.expect_errors("^404 ", "Failed to load resource.*404")


@pytest.mark.quick(0)
def test_with_keys(start, preview):
    service = start(KISSGS_KEYS=keys_of(alice="secret", bob="other"))
    service.http.headers["Authorization"] = "Bearer secret"
    job = service.ended(service.submit())
    tab = preview().open(service, job["id"])
    tab.error_message("key", "enter it on its page")
    tab.expect_errors("^401 ", "Failed to load resource.*401")
    page = tab.page
    for key, works in (("other", False), ("secret", True)):
        page.evaluate("key => sessionStorage.setItem('kissgs-key', key)", key)
        page.reload()
        if works:
            tab.shown(len(kissgs.decompress(service.http.get(job["links"]["result"]).content)))
            page.get_by_role("button", name="Compare").click()
            page.get_by_role("slider").wait_for()
            page.locator("#loading").wait_for(state="hidden")
        else:
            tab.error_message("does not have this")
            tab.expect_errors("^404 ", "Failed to load resource.*404")
    assert not any("secret" in url for _, url in tab.requests)


@pytest.mark.quick(0)
def test_one_finger_orbits(preview, service, xt):
    tab = preview(viewport={"width": 390, "height": 780}, has_touch=True, is_mobile=True).open(service, xt.job["id"])
    before = tab.shown(len(xt.splats))
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 390
    box = tab.page.locator("#viewport").bounding_box()
    x, y = box["x"] + 150, box["y"] + box["height"] / 2
    finger = tab.context.new_cdp_session(tab.page)
    for kind, points in (
        ("touchStart", [(x, y)]),
        *(("touchMove", [(x + 15 * step, y)]) for step in range(1, 6)),
        ("touchEnd", []),
    ):
        touches = [{"x": left, "y": top} for left, top in points]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})
    wait_until(lambda: psnr(tab.still_image(), before) < 30)  # a busy browser handles touches later
    assert tab.page.evaluate("scrollY") == 0
    tab.page.locator("#reset").tap()
    wait_until(lambda: psnr(tab.still_image()[:-80], before[:-80]) > 60)


def test_without_the_vendor_folder(preview, service, xt):
    tab = preview()
    tab.page.route("**/vendor/**", lambda route: route.fulfill(status=404, body="none"))
    tab.open(service, xt.job["id"])
    tab.error_message("not installed", "scripts/vendor")
    tab.fact("Gaussians", f"{len(xt.splats):,}")
    tab.page.get_by_role("button", name="Opacities").click()
    tab.page.locator(".plane canvas").hover(position={"x": 3, "y": 3})
    assert "Column 0, row 0" in tab.page.locator(".readout").inner_text()
    assert tab.page.locator("#problem").is_visible()
    tab.expect_errors("^404 .*vendor", "Failed to load resource.*404")
