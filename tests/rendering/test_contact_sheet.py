"""Image files and contact sheets. Reference: Pillow reads them back; positions counted by hand."""

import io

import numpy as np
import pytest
from PIL import Image, ImageSequence

from kissgs.core.context import Context
from kissgs.core.errors import UnsupportedError
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.images import (
    GAP,
    MARKED_COLOUR,
    PAGE_COLOUR,
    TEXT_COLOUR,
    Label,
    animated_webp,
    balanced_columns,
    contact_sheet,
    png,
    reframed,
    render_all,
    to_bytes,
)
from kissgs.rendering.rasterizer import render
from kissgs.synthetic import sample_scene


def noise(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)


def flat(height, width, colour):
    return np.full((height, width, 3), colour, np.uint8)


def opened(data):
    return Image.open(io.BytesIO(data))


def test_bytes_are_clamped_and_rounded():
    values = np.float32([-1, 0, 0.4 / 255, 0.6 / 255, 1, 7, np.nan, np.inf]).reshape(1, 8, 1).repeat(3, axis=2)
    assert to_bytes(values)[0, :, 0].tolist() == [0, 0, 0, 1, 255, 255, 0, 255]


def test_files_hold_the_pixels():
    pixels = noise(20, 30)
    assert np.array_equal(np.asarray(opened(png(pixels))), pixels)
    assert np.array_equal(np.asarray(opened(animated_webp([pixels], fps=1, quality=100)).convert("RGB")), pixels)
    assert opened(animated_webp([pixels], fps=1, quality=100)).format == "WEBP"
    assert len(animated_webp([pixels], fps=1, quality=10)) < len(animated_webp([pixels], fps=1, quality=100))


@pytest.mark.parametrize(("count", "fps"), [(5, 12), (7, 60), (3, 1)])
def test_an_animation_has_its_frames_and_its_duration(count, fps):
    frames = [flat(24, 32, 20 * n) for n in range(count)]
    read = opened(animated_webp(frames, fps=fps, quality=100))
    assert (read.n_frames, read.size, read.info["loop"]) == (count, (32, 24), 0)
    total = 0
    for frame, pixels in zip(ImageSequence.Iterator(read), frames, strict=True):
        assert np.array_equal(np.asarray(frame.convert("RGB")), pixels)
        total += frame.info["duration"]
    assert total == round(1000 * count / fps)


def test_images_that_are_too_large_are_refused():
    with pytest.raises(UnsupportedError, match="16,383 pixels a side, not 16384x1"):
        animated_webp([flat(1, 16_384, 0)], fps=1, quality=100)
    with pytest.raises(UnsupportedError, match="a contact sheet has at most 268,435,456 pixels"):
        contact_sheet([flat(100, 20_000, 0)] * 200, columns=1)


def test_images_are_in_rows_in_the_middle_of_their_cells():
    images = [flat(10, 20, 100), flat(10, 20, 150), flat(6, 12, 200)]
    sheet = contact_sheet(images, columns=2)
    assert sheet.shape == (2 * 10 + 3 * GAP, 2 * 20 + 3 * GAP, 3)
    expected = np.full(sheet.shape, PAGE_COLOUR, np.uint8)
    expected[GAP : GAP + 10, GAP : GAP + 20] = 100
    expected[GAP : GAP + 10, 2 * GAP + 20 : 2 * GAP + 40] = 150
    expected[2 * GAP + 10 + 2 : 2 * GAP + 10 + 8, GAP + 4 : GAP + 16] = 200
    assert np.array_equal(sheet, expected)


def test_labels_are_below_images_and_marked_ones_have_another_colour():
    labels = [Label("a name"), Label("held out", marked=True), Label("x" * 300), Label("a\nb\x00")]
    sheet = contact_sheet([flat(30, 90, 255)] * 4, labels, columns=4)
    assert sheet.shape[0] > 30 + 2 * GAP + 8
    areas = [sheet[GAP + 30 :, GAP + n * (90 + GAP) :][:, :90].reshape(-1, 3) for n in range(4)]
    page = np.array(PAGE_COLOUR, float)
    colours = (TEXT_COLOUR, MARKED_COLOUR, TEXT_COLOUR, TEXT_COLOUR)
    for area, colour in zip(areas, colours, strict=True):  # antialiased strokes have a part of the colour only
        share = (area - page) @ (np.array(colour) - page) / np.square(np.subtract(colour, page)).sum()
        assert share.max() > 0.6
        assert np.abs(area[share.argmax()] - (page + share.max() * np.subtract(colour, page))).max() < 3
    gaps = [sheet[GAP + 30 :, GAP + n * (90 + GAP) - GAP :][:, :GAP] for n in range(1, 4)]
    assert all((gap == PAGE_COLOUR).all() for gap in gaps), "no label extends into the next cell"


def test_contact_sheets_are_wide_and_have_few_empty_cells():
    assert balanced_columns(1, 1.3) == 1
    assert balanced_columns(24, 320 / 240) == 6
    for count in range(1, 200):
        columns = balanced_columns(count, 4 / 3)
        rows = -(-count // columns)
        assert rows * columns - count < columns
        if count > 8:
            assert 0.6 < columns * 4 / 3 / rows < 3.6


def some_camera(width=40, height=30):
    return look_at(np.array([0.0, -2, -5]), np.zeros(3), np.array([0.0, -1, 0]), fov=1, width=width, height=height)


def test_another_aspect_ratio_shows_more_and_never_less():
    camera = Camera(some_camera().viewmat, some_camera().K + np.array([[0, 0, 3.0], [0, 0, -2], [0, 0, 0]]), 40, 30)
    wide, same = reframed(camera, 200, 60), reframed(camera, 80, 60)
    assert np.allclose(same.K, camera.resized(80, 60).K)
    assert wide.K[0, 0] == wide.K[1, 1] == pytest.approx(2 * camera.K[0, 0])
    assert wide.K[0, 2] == pytest.approx(2 * camera.K[0, 2] + 60)
    assert wide.K[1, 2] == pytest.approx(2 * camera.K[1, 2])
    assert np.array_equal(wide.viewmat, camera.viewmat)
    tall = reframed(camera, 40, 300)
    assert tall.K[0, 2] == pytest.approx(camera.K[0, 2])
    assert tall.K[1, 2] == pytest.approx(camera.K[1, 2] + 135)


def test_an_image_is_rendered_once_for_each_camera():
    scene, cameras, events = sample_scene(500, sh_degree=0), [some_camera(), some_camera(20, 20)], []
    path = [*cameras, cameras[0]]
    context = Context(progress=lambda stage, done: events.append((stage, done)))
    images = render_all(scene, path, context, background=(1, 1, 1))
    assert images[0] is images[2]
    for pixels, camera in zip(images, path, strict=True):
        assert np.array_equal(pixels, to_bytes(render(scene, camera, background=(1, 1, 1))[0]))
    assert events == [("render", n / 3) for n in range(3)] + [("render", 1.0)]


def test_more_images_than_fit_into_memory_are_refused():
    with pytest.raises(UnsupportedError, match="3600 images of this size would take too much memory"):
        render_all(sample_scene(10, sh_degree=0), [some_camera(1280, 960)] * 3600)
