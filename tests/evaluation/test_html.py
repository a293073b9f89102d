"""HTML reports, read by a strict parser. Oracles: html.parser, Pillow, and errors searched window by window."""

import base64
import io
from html.parser import HTMLParser

import numpy as np
import pytest
from helpers.captured_scene import SCENE, camera, cameras, damaged, rendered_view, write_capture
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image, ImageColor

from kissgs.cameras.captures.load import load_views
from kissgs.cameras.views import View, Views
from kissgs.core.context import Context
from kissgs.core.errors import Cancelled
from kissgs.evaluation.evaluate import compare_images, evaluate
from kissgs.evaluation.html import (
    FULL_SCALES,
    INFERNO,
    MAX_PATCHES,
    MAX_SURROUNDINGS,
    MAX_VIEWS,
    WINDOW,
    ReportScene,
    full_scale,
    heat_map,
    html_report,
    rms_difference,
    worst_crop,
)

WORSE = damaged()
DARKEST, PALEST = ImageColor.getrgb(INFERNO[0]), ImageColor.getrgb(INFERNO[-1])
VOID = {"meta", "link", "img", "input", "br"}
MARKUP = "<script>alert(\"1\")</script> & 'two' $table"


class Page(HTMLParser):
    """Collects elements, text and images; every element must be closed."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements, self.open, self.text, self.images = [], [], "", []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.elements.append((tag, attributes))
        if tag == "img":
            self.images.append(self.decode(attributes["src"]))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.text += data

    def decode(self, source):
        assert source.startswith("data:image/webp;base64,")
        with Image.open(io.BytesIO(base64.b64decode(source.split(",", 1)[1], validate=True))) as image:
            return np.asarray(image.convert("RGB"))

    def of(self, tag):
        return [attributes for name, attributes in self.elements if name == tag]


def report(views, *, candidate=WORSE, names=("a.ply", "b.zip"), sizes=(20_000, 4_000), found=None):
    found = found or compare_images(SCENE, candidate, views)
    sides = [
        ReportScene(name=name, splats=scene, bytes=size)
        for name, scene, size in zip(names, (SCENE, candidate), sizes, strict=True)
    ]
    return html_report(found, *sides), found


def test_the_page_is_self_contained():
    text, _ = report(cameras())
    page = Page(text)
    for tag, attributes in page.elements:
        assert tag not in ("iframe", "object", "embed", "base")
        for name in ("src", "href", "action", "srcset", "poster"):
            assert attributes.get(name, "#").startswith(("data:", "#")), (tag, attributes[name][:80])
    assert "//" not in text.replace("<!--", "").split("data:image/webp")[0]
    assert "url(" not in text
    assert "@import" not in text
    assert "default-src 'none'" in text


def test_every_view_has_images_without_photographs():
    text, found = report(cameras(test=3))
    page = Page(text)
    worst = min(range(3), key=lambda i: found.views[i].comparison.candidate_vs_reference.psnr)
    ids = [section["id"] for section in page.of("section") if "id" in section]
    by_psnr = np.argsort([each.comparison.candidate_vs_reference.psnr for each in found.views])
    assert ids == [f"view-{i}" for i in by_psnr]
    assert len(page.images) == 3 * 2 + 3 * (3 + 3), "the worst patch of each view, which has two; then the views"
    first = page.images[6:12]
    assert all(image.shape == (40, 60, 3) for image in first)
    view, wanted = found.views[worst].view, {}
    for side, scene in (("candidate", WORSE), ("reference", SCENE)):
        wanted[side] = np.rint(255 * rendered_view(scene, view)).astype(np.uint8)
    assert np.abs(first[0].astype(int) - wanted["candidate"]).mean() < 6  # lossy
    np.testing.assert_array_equal(first[3], wanted["reference"])  # crops are lossless
    np.testing.assert_array_equal(first[4], wanted["candidate"])


def test_photographs_are_shown_if_there_are_any(tmp_path):
    views = load_views(write_capture(tmp_path / "capture"))
    text, found = report(views, found=evaluate(SCENE, WORSE, views, split="all"))
    page = Page(text)
    assert len(page.images) == 3 * 3 + 3 * (4 + 4) + MAX_SURROUNDINGS * (3 + 3)
    np.testing.assert_array_equal(page.images[9 + 6], found.worst.view.load_photo())
    for evaluation in (found, found.surroundings):
        assert evaluation.worst.view.name in page.text
        assert evaluation.worst.pose in page.text
        assert evaluation.extremes in page.text
    for compared in found.views:
        for cell in compared.comparison.cells():
            assert cell.replace("-", "−") in page.text
    assert "5.0× smaller" in page.text
    assert "0.02 → 0.00 MB" in page.text


def test_the_patches_that_lose_most_are_shown_the_worst_first(tmp_path):
    """Each crop holds the pixels around its patch; of patches side by side, only the worst is shown."""
    views = load_views(write_capture(tmp_path / "capture", size=(200, 130)))
    text, found = report(views, found=compare_images(SCENE, WORSE, views))
    page, (view,), changes = Page(text), views.test, found.views[0].patch_changes
    assert changes.shape == (4, 6)
    ordered = [np.unravel_index(flat, changes.shape) for flat in changes.ravel().argsort() if changes.flat[flat] < 0]
    shown = []
    for row, column in ordered:
        if all(max(abs(row - other), abs(column - across)) > 2 for other, across in shown):
            shown.append((row, column))
    assert 2 <= len(shown) <= MAX_PATCHES
    headings = [f"{view.name} −{-changes[place]:.4f}" for place in shown]
    at = page.text.index("Patches that lose most detail")
    assert [at < page.text.index(heading) for heading in headings] == [True] * len(shown)
    assert sorted(headings, key=page.text.index) == headings
    renderings = [np.rint(255 * rendered_view(scene, view)).astype(np.uint8) for scene in (SCENE, WORSE)]
    for n, (row, column) in enumerate(shown):
        top, left = np.clip((32 * row - 32, 32 * column - 32), 0, (130 - 96, 200 - 96))
        for image, whole in zip(page.images[3 * n :], [view.load_photo(), *renderings], strict=False):
            assert np.abs(image.astype(int) - whole[top : top + 96, left : left + 96]).max() <= 1


def test_names_are_escaped(tmp_path):
    view = View(MARKUP, camera(0))
    text, _ = report(Views((), (view,), np.zeros(3, np.float32), MARKUP), names=(MARKUP, MARKUP))
    page = Page(text)
    assert len(page.of("script")) == 1
    assert "<script>alert" not in text
    assert page.text.count(MARKUP) >= 5
    assert any(image["alt"].endswith(MARKUP) for image in page.of("img"))


def test_equal_scenes_have_a_report():
    text, _ = report(cameras(test=1), candidate=SCENE, sizes=(10, 40))
    page = Page(text)
    assert "∞ dB" in page.text
    assert "1 levels of 255" in page.text
    assert "4.0× larger" in page.text
    assert (page.images[2] == DARKEST).mean() > 0.9
    text, _ = report(cameras(test=1), candidate=SCENE, sizes=(None, None))
    assert "1,500 of 1,500 Gaussians" in text


def test_large_images_are_reduced_but_crops_are_not():
    page = Page(report(cameras(test=1, size=(1500, 300)))[0])
    shapes = [image.shape for image in page.images]
    assert shapes == [(96, 96, 3)] * 2 * MAX_PATCHES + [(256, 1280, 3)] * 3 + [(150, 150, 3)] * 3


def test_twelve_of_many_views_are_shown_the_worst_first():
    one = SCENE.select(slice(0, 300))
    views = cameras(test=30, train=0, size=(8, 6))
    found = compare_images(one, damaged(one), views)
    by_psnr = np.argsort([each.comparison.candidate_vs_reference.psnr for each in found.views], kind="stable")
    shown = by_psnr[:MAX_VIEWS].tolist()
    text = html_report(found, ReportScene(name="a", splats=one), ReportScene(name="b", splats=damaged(one)))
    page = Page(text)
    assert [section["id"] for section in page.of("section") if "id" in section] == [f"view-{i}" for i in shown]
    assert {link["href"] for link in page.of("a")} == {f"#view-{i}" for i in shown}


def test_progress_can_cancel():
    found = compare_images(SCENE, SCENE, cameras())
    events = []

    def stop(stage, fraction):
        events.append((stage, fraction))
        if len(events) == 2:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        html_report(
            found, ReportScene(name="a", splats=SCENE), ReportScene(name="b", splats=SCENE), Context(progress=stop)
        )
    assert events == [("html", 0), ("html", 1 / 3)]


# --- Error maps ----------------------------------------------------------------------------------


def test_differences_are_in_levels():
    black, image = np.zeros((2, 3, 3), np.float32), np.zeros((2, 3, 3), np.float32)
    image[0, 1] = 1
    image[1, 2] = (0, 10 / 255, 0)
    wanted = [[0, 255, 0], [0, 0, 10 / np.sqrt(3)]]
    np.testing.assert_allclose(rms_difference(image, black), wanted, rtol=1e-6)


def test_the_lightness_of_colours_grows_evenly():
    ramp = heat_map(np.linspace(0, 20, 256, dtype=np.float32)[None], 20)[0]
    lightness = ramp @ [0.299, 0.587, 0.114]
    assert tuple(ramp[0]) == DARKEST
    assert tuple(ramp[-1]) == PALEST
    assert np.diff(lightness).min() > -0.5  # they are rounded
    assert np.abs(lightness - np.linspace(0, 245, 256)).max() < 45
    assert heat_map(np.array([[np.nan, 99]], np.float32), 20).tolist() == [[list(PALEST)] * 2]


@given(st.floats(-10, 150) | st.sampled_from([np.inf, np.nan]))
def test_the_full_scale_is_a_round_number_near_four_times_the_error(psnr):
    full = full_scale(psnr)
    assert full in FULL_SCALES
    if psnr < 100:
        mean_error = 255 * 10 ** (-psnr / 20)
        assert full == 255 or full >= 4 * mean_error
        assert full == 1 or full <= 12 * mean_error


@examples(40)
@given(st.integers(1, 90), st.integers(1, 90), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_the_worst_crop_is_centred_on_the_largest_error(height, width, side, seed):
    rng = np.random.default_rng(seed)
    levels = rng.random((height, width)).astype(np.float32)
    levels[rng.integers(height), rng.integers(width)] = 200
    rows, columns = worst_crop(levels, side)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (min(side, height), min(side, width))
    assert rows.start >= 0
    assert rows.stop <= height
    assert columns.start >= 0
    assert columns.stop <= width
    down, across = min(WINDOW, height), min(WINDOW, width)
    squares = levels.astype(np.float64) ** 2
    sums = np.lib.stride_tricks.sliding_window_view(squares, (down, across)).sum(axis=(2, 3))
    top, left = np.unravel_index(sums.argmax(), sums.shape)
    middle = top + down // 2, left + across // 2
    assert rows.start == np.clip(middle[0] - side // 2, 0, height - min(side, height))
    assert columns.start == np.clip(middle[1] - side // 2, 0, width - min(side, width))


def test_without_errors_the_crop_is_the_middle():
    assert worst_crop(np.zeros((200, 301), np.float32), 160) == (slice(20, 180), slice(70, 230))
