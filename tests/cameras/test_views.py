"""Oracles: pixels of the whole photograph, and of a rendering of the whole image."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.training_scenes import cloud
from PIL import Image
from scipy.ndimage import map_coordinates

import kissgs
from kissgs.rendering.camera import look_at


def write(folder, distortion):
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    camera = {"w": 96, "h": 64, "fl_x": 80, "fl_y": 82, "cx": 47, "cy": 33, **distortion}
    (folder / "images").mkdir()
    y, x = np.mgrid[0:64, 0:96]
    image = np.stack([x * 2, y * 3, x + y], axis=-1).astype(np.uint8)
    Image.fromarray(image).save(folder / "images" / "a.png")
    (folder / "transforms.json").write_text(json.dumps({**camera, "frames": [frame]}))


@pytest.mark.parametrize("distortion", [{}, {"k1": -0.1, "k2": 0.01}])
def test_a_sampled_view_has_pixels_of_the_photograph(tmp_path, distortion):
    write(tmp_path, distortion)
    (whole,) = kissgs.load_views(tmp_path).all
    for stride, first in ((1, (0, 0)), (2, (1, 0)), (3, (0, 2)), (40, (5, 39))):
        some = whole.sampled(stride, first)
        photo = some.load_photo()
        assert photo.shape == (some.camera.height, some.camera.width, 3)
        np.testing.assert_array_equal(photo, whole.load_photo()[first[1] :: stride, first[0] :: stride])
    twice = whole.sampled(2, (1, 0)).sampled(3, (0, 2))
    np.testing.assert_array_equal(twice.load_photo(), whole.load_photo()[4::6, 1::6])
    assert twice.load_photo().shape[:2] == (twice.camera.height, twice.camera.width)


@pytest.mark.parametrize(("stride", "first"), [(2, (0, 0)), (2, (1, 1)), (3, (2, 0)), (7, (3, 6))])
def test_a_sampled_camera_renders_pixels_of_the_whole_image(stride, first):
    """Gaussians are much narrower than the pixels of the sample."""
    scene = cloud(3000)
    scene = replace(scene, scales=scene.scales - 2)
    camera = look_at(np.array([0, -1.0, -4]), np.zeros(3), np.array([0, -1.0, 0]), fov=0.9, width=97, height=64)
    whole, whole_alpha = kissgs.render(scene, camera)
    some, alpha = kissgs.render(scene, camera.sampled(stride, first))
    np.testing.assert_allclose(some, whole[first[1] :: stride, first[0] :: stride], atol=1e-5)
    np.testing.assert_allclose(alpha, whole_alpha[first[1] :: stride, first[0] :: stride], atol=1e-5)
    smaller, _ = kissgs.render(scene, camera.resized(camera.sampled(stride).width, camera.sampled(stride).height))
    assert np.abs(smaller - whole[::stride, ::stride]).max() > 0.1, "a smaller image is no sample"


def test_gradients_of_samples_are_those_of_their_pixels():
    """Oracle: the gradients of the whole image, for a loss that has these pixels only."""
    torch = pytest.importorskip("torch")
    from kissgs.rendering.differentiable import rasterize
    from kissgs.rendering.rasterizer import tensors_of

    scene = cloud(500, degree=0)
    camera = look_at(np.array([0, -1.0, -4]), np.zeros(3), np.array([0, -1.0, 0]), fov=0.9, width=64, height=48)
    found = []
    for used, pixels in ((camera, np.s_[:, 1::3, 2::3]), (camera.sampled(3, (2, 1)), np.s_[:])):
        parameters = {name: tensor.requires_grad_() for name, tensor in tensors_of(scene, "cpu").items()}
        viewmats, Ks = torch.from_numpy(used.viewmat)[None], torch.from_numpy(used.K)[None]
        images, _ = rasterize(parameters, viewmats, Ks, used.width, used.height, dilation=used.dilation)
        images[pixels].square().sum().backward()
        found.append({name: tensor.grad.numpy() for name, tensor in parameters.items()})
    for name, expected in found[0].items():
        error = np.abs(found[1][name] - expected).max(initial=0)
        assert error <= 1e-3 * np.abs(expected).max(initial=0), name


def test_a_camera_sampled_to_a_size_renders_the_whole_image_between_its_pixels():
    """Oracle: the whole image, interpolated; it is smooth, while its Gaussians are narrower than the sampled pixels."""
    scene = cloud(40)
    scene = replace(scene, scales=scene.scales - 1)
    camera = look_at(np.array([0, -1.0, -4]), np.zeros(3), np.array([0, -1.0, 0]), fov=0.9, width=400, height=300)
    small = camera.sampled_at_most(150)
    assert (small.width, small.height) == (150, 112)
    image, whole = kissgs.render(scene, small)[0], kissgs.render(scene, camera)[0]
    y, x = np.meshgrid(
        (np.arange(112) + 0.5) * 300 / 112 - 0.5, (np.arange(150) + 0.5) * 400 / 150 - 0.5, indexing="ij"
    )
    expected = np.stack([map_coordinates(whole[..., c], [y, x], order=3, mode="nearest") for c in range(3)], axis=-1)
    assert (
        np.abs(image - expected).mean() < 0.1 * np.abs(kissgs.render(scene, camera.at_most(150))[0] - expected).mean()
    )
    assert camera.sampled_at_most(400) is camera


@pytest.mark.parametrize("dilation", [0.0, -0.3, np.nan, np.inf])
def test_dilations_that_are_no_variances_are_refused(dilation):
    with pytest.raises(kissgs.InvalidViewsError, match="dilation must be positive and finite"):
        kissgs.Camera(np.eye(4), np.eye(3), 4, 3, dilation)


def test_resized_cameras_scale_their_intrinsics():
    camera = kissgs.Camera(np.eye(4), np.array([[80.0, 0, 47], [0, 82, 33], [0, 0, 1]]), 96, 64)
    small = camera.at_most(48)
    assert (small.width, small.height) == (48, 32)
    np.testing.assert_allclose(small.K, [[40, 0, 23.5], [0, 41, 16.5], [0, 0, 1]])
    assert camera.at_most(1).width == camera.at_most(1).height == 1
