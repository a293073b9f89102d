"""Oracle: the capture loaded at the smaller resolution."""

import json

import numpy as np
import pytest
from PIL import Image

import kissgs


def write(folder, distortion):
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    camera = {"w": 96, "h": 64, "fl_x": 80, "fl_y": 82, "cx": 47, "cy": 33, **distortion}
    (folder / "images").mkdir()
    y, x = np.mgrid[0:64, 0:96]
    image = np.stack([x * 2, y * 3, x + y], axis=-1).astype(np.uint8)
    Image.fromarray(image).save(folder / "images" / "a.png")
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": [frame]}))


@pytest.mark.parametrize("distortion", [{}, {"k1": -0.1, "k2": 0.01}, {"k1": 0.1, "p1": 0.002}])
@pytest.mark.parametrize("size", [48, 31])
def test_a_reduced_view_equals_one_loaded_at_that_resolution(tmp_path, distortion, size):
    write(tmp_path, distortion)
    (whole,) = kissgs.load_views(tmp_path).all
    (expected,) = kissgs.load_views(tmp_path, resolution=size).all
    small = whole.at_most(size)
    assert max(small.camera.width, small.camera.height) <= size
    photo = small.load_photo()
    assert photo.shape == (small.camera.height, small.camera.width, 3)
    assert abs(small.camera.width - expected.camera.width) <= 3
    ray = np.array([0.1, -0.05, 1])  # both views show it in the same colour
    pixels = [(view.camera.K @ ray)[:2].astype(int) for view in (small, expected)]
    colours = [view.load_photo()[p[1], p[0]].astype(int) for view, p in zip((small, expected), pixels, strict=True)]
    assert np.abs(colours[0] - colours[1]).max() <= 8


@pytest.mark.parametrize("size", [96, 1000])
def test_views_that_are_small_enough_stay_unchanged(tmp_path, size):
    write(tmp_path, {})
    (view,) = kissgs.load_views(tmp_path).all
    assert view.at_most(size).camera is view.camera


def test_resized_cameras_scale_their_intrinsics():
    camera = kissgs.Camera(np.eye(4), np.array([[80.0, 0, 47], [0, 82, 33], [0, 0, 1]]), 96, 64)
    small = camera.at_most(48)
    assert (small.width, small.height) == (48, 32)
    np.testing.assert_allclose(small.K, [[40, 0, 23.5], [0, 41, 16.5], [0, 0, 1]])
    assert camera.at_most(1).width == camera.at_most(1).height == 1
