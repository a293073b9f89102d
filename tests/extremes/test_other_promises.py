"""Promises of docs/reference/numerics.md besides its table; oracle: the numbers written there."""

import numpy as np
import pytest
import torch
from helpers.codec_scenes import GLANCE, random_scene, replaced
from helpers.rasterized import render_tensors
from helpers.render_scenes import blobs, camera, one
from helpers.training_scenes import cloud

import kissgs
from kissgs import Settings
from kissgs.cameras.views import black
from kissgs.core.context import Workers
from kissgs.core.sensitivity import LARGEST, OPACITY, ROTATION, SCALES, Sensitivity
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import look_at
from kissgs.rendering.cpu.frame import draw
from kissgs.rendering.sensitivity import WeightedCameras, _bound, measure_sensitivity
from kissgs.sogxt.encode import encode
from kissgs.training.model import BOUNDS, GaussianModel, PrunableAdam


def compressed(splats, preset="fast"):
    return kissgs.compress(splats, settings=Settings.research(preset, **GLANCE))


def test_steps_of_a_world_1e6_across():
    """ln(1 + 5e5) on either side, in 65535 steps."""
    means = np.random.default_rng(0).uniform(-5e5, 5e5, (300, 3))
    means[:2] = [[5e5] * 3, [-5e5] * 3]
    steps = 2 * np.array(compressed(replaced(random_scene(300), means=means)).report.max_quantization_error["means"])
    assert steps == pytest.approx(4e-4, rel=0.01)


def test_without_any_seen_gaussian_steps_are_those_of_the_settings():
    scene, settings = kissgs.clean(random_scene(200, 1))[0], Settings.from_preset("balanced").encode
    unseen = encode(scene, settings, sensitivity=Sensitivity.none(200, 1))
    assert unseen.rd_lambda is None
    assert unseen.files == encode(scene, settings).files


def test_details_of_a_tiny_scene_are_kept():
    """All of 300 Gaussians, and shapes as in a scene of common size, though no image is taken from nearer than 0.01."""
    scene = cloud(300)
    tiny = replaced(scene, means=scene.means * 1e-4, scales=scene.scales + np.log(1e-4))
    for preset in ("fast", "balanced"):
        common, small = compressed(scene, preset).report, compressed(tiny, preset).report
        assert max(small.max_quantization_error["means"]) < 1e-2 * 1e-4
        assert max(small.max_quantization_error["scales"]) <= 1.2 * max(common.max_quantization_error["scales"])
        assert small.count >= common.count - 5


def test_costs_are_cut_off():
    """Costs that overflow are written by hand, as no scene has them; those of giant Gaussians are measured."""
    forms = np.zeros((3, 10), np.float32)
    forms[0], forms[1, OPACITY[0]], forms[2, SCALES[0]] = 3e38, np.nan, 7
    _bound(forms, OPACITY + SCALES + ROTATION)
    assert np.isfinite(forms).all()
    assert forms.max() == np.float32(LARGEST)
    assert forms[1, OPACITY[0]] == np.float32(LARGEST)
    assert (forms[2] == np.eye(10)[SCALES[0]] * 7).all()
    for size in (-30, 30):
        giants = replaced(cloud(20), scales=np.full((20, 3), size))
        found = measure_sensitivity(giants, WeightedCameras([camera()], [1.0], black()), view_uncertainty=0.3)
        assert all(
            0 <= np.abs(values).max() <= np.float32(LARGEST)
            for values in (found.position_hessian, found.shape_hessian, found.color_weight)
        )


def test_gradients_above_1e15_count_as_that():
    leaves = PrunableAdam({"a": torch.zeros(4, 1)})
    leaves.parameters["a"].grad = torch.tensor([[1e30], [1e15], [-np.inf], [-3e38]])
    leaves.step({"a": 1.0})
    assert leaves.state()["a.exp_avg"].ravel() / 1e14 == pytest.approx([1, 1, 0, -1])


@pytest.mark.parametrize("sign", [1, -1])
def test_values_stay_within_what_a_scene_can_hold(sign):
    model = GaussianModel(cloud(5))
    for _ in range(3):
        for leaf in model.parameters.values():
            leaf.grad = torch.full_like(leaf, -sign)
        model.step(dict.fromkeys(ATTRIBUTES, 1e16))
    for name, (least, most) in BOUNDS.items():
        assert (model.parameters[name].detach().numpy() == np.float32(most if sign > 0 else least)).all(), name
    assert len(model.splats()) == 5


@pytest.mark.parametrize("length", [1e-38, 0.9e-12, 1.1e-12, 1e-6, 1e6, 1e18])
def test_rendering_with_quaternions_of_any_length(length):
    """The rasteriser gets them unnormalised; a zero quaternion is the identity."""
    unit = np.array([0.5, -0.5, 0.1, 0.7]) / 1.0
    unit /= np.linalg.norm(unit)
    shape = {"scale": (0, -1, -3), "opacity": 1.0}
    found, _, tensors = render_tensors(one(quat=unit * length, **shape), [camera()])
    wanted, _, _ = render_tensors(one(quat=unit if length > 1e-12 else (1, 0, 0, 0), **shape), [camera()])
    torch.testing.assert_close(found, wanted, atol=2e-6, rtol=0)
    found.sum().backward()
    assert bool(tensors["quats"].grad.any()) == (length > 1e-12)


@pytest.mark.parametrize("size", [1e-6, 1, 1e6])
def test_centres_of_footprints_are_right_to_a_ten_thousandth_of_a_pixel(size):
    distance = max(3 * size, 0.02)
    place = np.array([0.2, -0.3, -1]) / np.linalg.norm([0.2, -0.3, -1]) * distance
    fov = 2 * np.arctan(size / distance)
    view = look_at(place, np.zeros(3), np.array([0.0, -1, 0]), fov=fov, width=1600, height=1200)
    means = np.random.default_rng(0).uniform(-0.7, 0.7, (500, 3)) * size
    scene = replaced(
        blobs(500), means=means, scales=np.full((500, 3), np.log(size * 1e-3)), opacities=np.full(500, 2.0)
    )
    with Workers(1) as pool:
        frame = draw(scene, view, np.zeros(3), pool)
    prints, rows = frame.footprints, frame.rows()
    there = scene.means[prints.visible[rows]].astype(np.float64) @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    wanted = (there / there[:, 2:]) @ view.K.T
    assert len(wanted) > 300
    assert np.abs(prints.records[rows, :2] - wanted[:, :2]).max() < 1e-4
