"""Oracles: pixels of the whole photograph, and of a rendering of the whole image."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.training_scenes import cloud
from PIL import Image

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
@pytest.mark.parametrize(("stride", "first"), [(1, (0, 0)), (2, (1, 0)), (3, (0, 2)), (40, (5, 39))])
def test_a_sampled_view_has_pixels_of_the_photograph(tmp_path, distortion, stride, first):
    write(tmp_path, distortion)
    (whole,) = kissgs.load_views(tmp_path).all
    some = whole.sampled(stride, first)
    photo = some.load_photo()
    assert photo.shape == (some.camera.height, some.camera.width, 3)
    np.testing.assert_array_equal(photo, whole.load_photo()[first[1] :: stride, first[0] :: stride])


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
    from kissgs.rendering.tensors import tensors_of

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


def test_pixels_that_are_samples_have_less_dilation():
    camera = look_at(np.array([0, 0, -4.0]), np.zeros(3), np.array([0, -1.0, 0]), fov=0.9, width=60, height=40)
    assert camera.as_sample_of(120).dilation == pytest.approx(camera.dilation / 4)
    assert camera.as_sample_of(60) is camera.as_sample_of(10) is camera


def test_resized_cameras_scale_their_intrinsics():
    camera = kissgs.Camera(np.eye(4), np.array([[80.0, 0, 47], [0, 82, 33], [0, 0, 1]]), 96, 64)
    small = camera.at_most(48)
    assert (small.width, small.height) == (48, 32)
    np.testing.assert_allclose(small.K, [[40, 0, 23.5], [0, 41, 16.5], [0, 0, 1]])
    assert camera.at_most(1).width == camera.at_most(1).height == 1
