"""Trainable scenes. Oracle: Adam as in its paper, in float64 NumPy, with removal of rows."""

import numpy as np
import pytest
import torch
from helpers.training_scenes import cloud, same

from kissgs.core.splats import ATTRIBUTES, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN
from kissgs.rendering.cpu.backward import Gradients
from kissgs.training.model import GaussianModel, PrunableAdam, _step_by_torch

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
    for name, parameter in model.parameters.items():
        gradients[name] = rng.normal(size=parameter.shape)
        parameter.grad = torch.from_numpy(gradients[name].astype(np.float32))
    model.step(RATES)
    return gradients


def test_steps_are_those_of_adam_and_moments_survive_pruning():
    """Positions move in units of their extents."""
    scene, rng = cloud(50, 2), np.random.default_rng(1)
    extents = np.exp(rng.normal(0, 4, 50)).astype(np.float32)
    model = GaussianModel(scene, extents=extents)
    oracle = {name: NaiveAdam(getattr(scene, name)) for name in ATTRIBUTES}
    for step in range(9):
        gradients = push(model, rng)
        for name, gradient in gradients.items():
            oracle[name].step(gradient, RATES[name] * (extents[:, None] if name == "means" else 1))
        if step in (3, 6):
            index = np.sort(rng.permutation(len(model))[:20])
            model.keep(index)
            extents = extents[index]
            for adam in oracle.values():
                adam.keep(index)
    assert len(model) == 20
    assert (scene.means == cloud(50, 2).means).all(), "the original scene is not changed"
    for name, parameter in model.parameters.items():
        np.testing.assert_allclose(parameter.detach().numpy(), oracle[name].value, rtol=2e-5, atol=2e-5)


@pytest.mark.parametrize("steps", [0, 1, 5])
def test_a_restored_model_continues_exactly(steps):
    scene = cloud(30)
    one, rng = GaussianModel(scene), np.random.default_rng(2)
    for _ in range(steps):
        push(one, rng)
    other = GaussianModel.restored(one.state(), scene)
    for seed in range(4):
        push(one, np.random.default_rng(seed))
        push(other, np.random.default_rng(seed))
    assert same(one.splats(), other.splats())


def test_non_finite_gradients_have_no_lasting_effect():
    """Otherwise a NaN would stay in Adam's moments, and its Gaussian would be lost."""
    model = GaussianModel(cloud(4, 0))
    for bad in (np.nan, np.inf, -np.inf, 3e38):
        for parameter in model.parameters.values():
            parameter.grad = torch.full_like(parameter, bad)
        model.step(RATES)
        push(model, np.random.default_rng(0))
    assert all(torch.isfinite(parameter).all() for parameter in model.parameters.values())
    assert all(np.isfinite(value).all() for value in model.state().values())


def test_opacities_and_scales_stay_within_their_bounds():
    model = GaussianModel(cloud(10))
    for sign in (1, -1):
        for _ in range(30):  # the momentum must change its sign first
            for name in ("opacities", "scales"):
                parameter = model.parameters[name]
                parameter.grad = torch.full_like(parameter, -sign)
            model.step(dict.fromkeys(ATTRIBUTES, 100.0))
        scene = model.splats()
        assert (scene.scales == 30.0 * sign).all()
        assert (scene.opacities == np.float32(OPACITY_LOGIT_MAX if sign > 0 else OPACITY_LOGIT_MIN)).all()


def test_the_result_does_not_depend_on_torch_threads():
    """Adam is elementwise but vectorised in parts, whose boundaries must have no effect."""
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


def test_all_gaussians_can_be_removed():
    model = GaussianModel(cloud(3))
    push(model, np.random.default_rng(0))
    model.keep(np.empty(0, np.int64))
    assert len(model) == len(model.splats()) == 0


def test_steps_on_other_devices_are_the_same():
    """Torch makes steps there; here it makes them on the CPU, for lack of another device."""
    rng, factors = np.random.default_rng(4), torch.exp(torch.linspace(-3, 3, 40))
    one, other = (PrunableAdam({"a": torch.zeros(40, 5)}, {"a": (-0.1, 0.2)}, {"a": factors}) for _ in range(2))
    for number in range(6):
        gradient = torch.from_numpy(rng.normal(size=(40, 5)).astype(np.float32))
        gradient[number] = float(rng.choice([np.nan, np.inf, 3e38]))
        for adam in (one, other):
            adam.parameters["a"].grad = gradient.clone()
        one.step({"a": 0.01})
        (leaf,) = other._leaves.values()
        leaf.steps += 1
        _step_by_torch(leaf, 0.01, -0.1, 0.2)
    for name, value in one.state().items():
        np.testing.assert_allclose(value, other.state()[name], rtol=1e-5, atol=1e-7)
    assert len(np.unique(one.state()["a"])) > 100


def test_gradients_of_a_few_gaussians_count_as_0_for_the_others():
    """The moments of the others decay, and they go on moving, as in Adam."""
    scene, rng = cloud(50, 2), np.random.default_rng(5)
    extents = np.exp(rng.normal(size=50)).astype(np.float32)
    model, oracle = (
        GaussianModel(scene, extents=extents),
        {name: NaiveAdam(getattr(scene, name)) for name in ATTRIBUTES},
    )
    for step in range(12):
        total = {name: np.zeros(parameter.shape) for name, parameter in model.parameters.items()}
        for _ in range(step % 3):  # several images, one, or none
            gaussians = np.sort(rng.permutation(len(model))[:15]).astype(np.int32)
            found = [rng.normal(size=total[name][gaussians].shape).astype(np.float32) for name in ATTRIBUTES]
            model.receive(Gradients(gaussians, *found))
            for name, gradient in zip(ATTRIBUTES, found, strict=True):
                total[name][gaussians] += gradient
        penalty = rng.normal(size=len(model))
        model.parameters["opacities"].grad = torch.from_numpy(penalty.astype(np.float32))
        total["opacities"] += penalty
        model.step(RATES)
        for name in ATTRIBUTES if step % 3 else ("opacities",):
            rate = RATES[name] * (extents[:, None] if name == "means" else 1)
            oracle[name].step(total[name], rate)
    for name, parameter in model.parameters.items():
        np.testing.assert_allclose(parameter.detach().numpy(), oracle[name].value, rtol=2e-5, atol=2e-5)
