"""Oracle: Adam as its paper writes it, in float64 NumPy, on Gaussians that come and go."""

import numpy as np
import pytest
import torch
from helpers.training_scenes import cloud, same

from kissgs.core.splats import ATTRIBUTES, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN
from kissgs.training.model import GaussianModel

RATES = {name: 0.01 * (n + 1) for n, name in enumerate(ATTRIBUTES)}


class NaiveAdam:
    def __init__(self, value):
        self.value = value.astype(np.float64)
        self.m = self.v = np.zeros_like(self.value)
        self.t = 0

    def step(self, gradient, rate):
        self.t += 1
        self.m = 0.9 * self.m + 0.1 * gradient
        self.v = 0.999 * self.v + 0.001 * gradient**2
        m, v = self.m / (1 - 0.9**self.t), self.v / (1 - 0.999**self.t)
        self.value = self.value - rate * m / (np.sqrt(v) + 1e-15)

    def keep(self, index):
        self.value, self.m, self.v = self.value[index], self.m[index], self.v[index]


def push(model, rng):
    gradients = {}
    for name, leaf in model.parameters.items():
        gradients[name] = rng.normal(size=leaf.shape)
        leaf.grad = torch.from_numpy(gradients[name].astype(np.float32))
    model.step(RATES)
    return gradients


def test_it_is_adam_and_survivors_remember():
    scene, rng = cloud(50, 2), np.random.default_rng(1)
    model = GaussianModel(scene)
    oracle = {name: NaiveAdam(getattr(scene, name)) for name in ATTRIBUTES}
    for step in range(9):
        gradients = push(model, rng)
        for name, gradient in gradients.items():
            oracle[name].step(gradient, RATES[name])
        if step in (3, 6):
            index = np.sort(rng.permutation(len(model))[:20])
            model.keep(index)
            for adam in oracle.values():
                adam.keep(index)
    assert len(model) == 20
    for name, leaf in model.parameters.items():
        np.testing.assert_allclose(leaf.detach().numpy(), oracle[name].value, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("steps", [0, 1, 5])
def test_a_restored_one_goes_on_exactly_as_the_first_would(steps):
    one, rng = GaussianModel(cloud(30)), np.random.default_rng(2)
    for _ in range(steps):
        push(one, rng)
    other = GaussianModel.restored(one.state())
    for seed in range(4):
        push(one, np.random.default_rng(seed))
        push(other, np.random.default_rng(seed))
    assert same(one.splats(), other.splats())


def test_positions_move_in_units_of_their_reach():
    scene, rng = cloud(50, 2), np.random.default_rng(1)
    reach = np.exp(rng.normal(0, 4, 50)).astype(np.float32)
    model, oracle = GaussianModel(scene, reach=reach), NaiveAdam(scene.means)
    for step in range(9):
        oracle.step(push(model, rng)["means"], RATES["means"] * reach[:, None])
        if step in (3, 6):
            index = np.sort(rng.permutation(len(model))[:20])
            model.keep(index)
            oracle.keep(index)
            reach = reach[index]
    np.testing.assert_allclose(model.parameters["means"].detach().numpy(), oracle.value, rtol=2e-5, atol=2e-5)


def test_the_scene_it_came_from_is_not_changed():
    scene = cloud(12)
    before = scene.means.copy()
    model = GaussianModel(scene)
    push(model, np.random.default_rng(0))
    assert (scene.means == before).all()
    assert (model.splats().means != before).all()


def test_gradients_that_are_no_numbers_move_nothing_for_long():
    """One NaN would otherwise stay in Adam's moments, and its Gaussian be lost for good."""
    model = GaussianModel(cloud(4, 0))
    for bad in (np.nan, np.inf, -np.inf, 3e38):
        for leaf in model.parameters.values():
            leaf.grad = torch.full_like(leaf, bad)
        model.step(RATES)
        push(model, np.random.default_rng(0))
    assert all(torch.isfinite(leaf).all() for leaf in model.parameters.values())
    assert all(np.isfinite(value).all() for value in model.state().values())


def test_opacities_and_scales_stay_in_what_a_scene_can_hold():
    model = GaussianModel(cloud(10))
    for sign in (1, -1):
        for _ in range(30):  # momentum has to turn first
            for name in ("opacities", "scales"):
                leaf = model.parameters[name]
                leaf.grad = torch.full_like(leaf, -sign)
            model.step(dict.fromkeys(ATTRIBUTES, 100.0))
        scene = model.splats()
        assert (scene.scales == 30.0 * sign).all()
        assert (scene.opacities == np.float32(OPACITY_LOGIT_MAX if sign > 0 else OPACITY_LOGIT_MIN)).all()


def test_no_bit_depends_on_torchs_threads():
    """Adam is elementwise, but vectorised in parts: it must not matter where these begin."""
    found, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        model = GaussianModel(cloud(20_001, 1))
        for seed in range(3):
            push(model, np.random.default_rng(seed))
        found.append(model.splats())
    torch.set_num_threads(before)
    assert same(found[0], found[1])
    assert same(found[0], found[2])


def test_nobody_is_left():
    model = GaussianModel(cloud(3))
    push(model, np.random.default_rng(0))
    model.keep(np.empty(0, np.int64))
    assert len(model) == len(model.splats()) == 0
