"""The differentiable decoder. Oracle: written containers and their decoders; finite differences; float64 NumPy."""

import numpy as np
import pytest
import torch
from helpers import reference_decoder
from helpers.training_scenes import cloud, same
from helpers.tuning_scenes import FIELDS, choices, chosen, shuffled

from kissgs import Settings, Splats, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.finetuning.quantized_scene import QuantizedScene
from kissgs.planning.quantize import _levels
from kissgs.planning.rd_criterion import Costs
from kissgs.sogxt.encode import write_files

IMAGES = {"opacities": 3, "scales": 3, "quaternions": 4, "f_dc": 3}


def container(plan, scene):
    return write_files(plan, Settings().encode, threads=1).files


def decoded_by(work):
    return Splats(**{name: tensor.detach().numpy() for name, tensor in work.gaussians().items()})


@pytest.mark.parametrize("number", range(len(choices())))
@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.quick(12)
def test_written_levels_and_decoded_values_equal_those_of_training(number, moved):
    scene, preset = choices()[number]
    plan = chosen(scene, preset)
    work = QuantizedScene(plan, scene.sh_degree)
    if moved:
        shuffled(work)
    files = container(work.plan(), scene)
    mask = plan.grid.mask
    for name in FIELDS:
        levels = work.planes[name].levels(work.latents[name]).detach().numpy()
        assert (levels == np.rint(levels)).all()
        if name in IMAGES:
            image = reference_decoder.levels(files, name, IMAGES[name])[mask]
            assert (image[:, : levels.shape[1]] == levels).all(), name
    high, low = (reference_decoder.levels(files, f"means_bytes_{n}", 3)[mask].astype(int) for n in (1, 0))
    assert (256 * high + low == work.planes["means"].levels(work.latents["means"]).detach().numpy()).all()
    decoded, reference = decompress(files), reference_decoder.decode(files)
    for name in ATTRIBUTES:
        found, wanted = getattr(decoded_by(work), name), getattr(decoded, name)
        scale = np.abs(wanted).max(initial=1e-9)
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=3e-6 * scale, err_msg=name)
    reference_decoder.assert_equal_scenes(decoded, reference, files)


@pytest.mark.parametrize("preset", ["fast", "balanced", "paper"])
def test_an_untrained_plan_is_unchanged(preset):
    """Except for a few levels that are no multiples of their stride; these move by less than one step."""
    scene = cloud(400, 2)
    plan = chosen(scene, preset)
    found = QuantizedScene(plan, 2).plan()
    for name, field in plan.fields.items():
        change = found.fields[name].levels.astype(int) - field.levels
        stride = 1
        if name != "f_rest_centroids":  # padding may repeat another form of a Gaussian
            change, stride = change[plan.grid.mask], np.reshape(field.take(plan.grid.mask).level_stride, (-1, 1))
        assert (change != 0).mean() < 0.15
        assert (np.abs(change) <= stride / 2).all()
        if name == "means":
            assert not change.any()


def test_errors_count_entries_that_gaussians_use_only():
    scene = cloud(40, 1)
    plan = chosen(scene, "fast")
    work = QuantizedScene(plan, 1)
    unused = np.setdiff1d(np.arange(len(plan.codebook.centroids.levels)), plan.codebook.labels)
    assert len(unused) > 0
    latents = work.latents["f_rest_centroids"]
    latents.data[unused] += 5
    latents.data.clamp_(work.planes["f_rest_centroids"].min_latent, work.planes["f_rest_centroids"].max_latent)
    assert work.plan().errors["f_rest_centroids"] == plan.errors["f_rest_centroids"]


def test_rounding_equals_that_of_the_encoder():
    """A value half-way between two levels goes to the same one in both."""
    scene = cloud(300, 1)
    plan = chosen(scene, "fast")
    work = QuantizedScene(plan, 1)
    rng = np.random.default_rng(3)
    for name, plane in work.planes.items():
        latents = work.latents[name]
        halves = rng.integers(-8, 9, latents.shape) / 2
        latents.data += latents.new_tensor(
            np.where(rng.random(latents.shape) < 0.5, halves, rng.normal(0, 2, halves.shape))
        )
        latents.data.clamp_(plane.min_latent, plane.max_latent)
        assert not plane.field.level_offset
        field, stride = plane.field, plane.stride.numpy()
        position = (plane.base_multiples.numpy() + latents.detach().numpy().astype(np.float64)) * stride
        # Dyadic ranges: values are exact, so that halves stay halves.
        found = _levels(
            position / 1024,
            np.zeros(position.shape[1], np.float32),
            np.full(position.shape[1], field.top / 1024, np.float32),
            field.top,
            stride,
        )
        free = (plane.min_latent < plane.max_latent).numpy()
        assert (found[free] == plane.levels(latents).detach().numpy()[free]).all()


def unrounded(work, latents):
    """Decode unrounded levels, in float64 NumPy."""
    values = {}
    for name, plane in work.planes.items():
        field = plane.field
        low, high = field.low.astype(float), field.high.astype(float)
        levels = (plane.base_multiples.numpy() + latents[name]) * plane.stride.numpy() - field.level_offset
        values[name] = low + levels * (high - low) / field.top
    coefficients = work.gaussians()["shN"].shape[1]
    entries = values["f_rest_centroids"].reshape(-1, 3, 15)[:, :, :coefficients].transpose(0, 2, 1)
    return {
        "means": np.sign(values["means"]) * np.expm1(np.abs(values["means"])),
        "quats": values["quaternions"],
        "scales": values["scales"],
        "opacities": values["opacities"][:, 0],
        "sh0": values["f_dc"],
        "shN": entries[work._labels.index.numpy()],
    }


@pytest.mark.parametrize(("preset", "degree"), [("balanced", 3), ("fast", 1), ("paper", 2), ("balanced", 0)])
def test_gradients_are_those_of_decoding_without_rounding(preset, degree):
    scene = cloud(120, degree)
    work = QuantizedScene(chosen(scene, preset), degree)
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=value.shape) for name, value in work.gaussians().items()}
    total = sum((torch.from_numpy(weights[name]) * value).sum() for name, value in work.gaussians().items())
    total.backward()
    here = {name: latents.detach().numpy().astype(np.float64) for name, latents in work.latents.items()}

    def loss(latents):
        return sum((weights[name] * value).sum() for name, value in unrounded(work, latents).items())

    for name, latents in work.latents.items():
        gradient = latents.grad.numpy()
        for row, column in zip(
            rng.integers(0, gradient.shape[0], 12), rng.integers(0, gradient.shape[1], 12), strict=True
        ):
            sides = []
            for sign in (1, -1):
                moved = {**here, name: here[name].copy()}
                moved[name][row, column] += sign * 1e-4
                sides.append(loss(moved))
            assert gradient[row, column] == pytest.approx((sides[0] - sides[1]) / 2e-4, rel=2e-4, abs=1e-6), name


def test_frozen_levels_stay_and_no_level_leaves_its_range():
    """Some readers rely on the largest position being 65535; a constant channel has no other level."""
    scene = cloud(200, 1)
    scene.scales[:, 1] = -2
    plan = chosen(scene)
    work = QuantizedScene(plan, 1)
    frozen = plan.fields["means"].levels[plan.grid.mask] == 65535
    assert frozen.any()
    for sign in (1, -1):
        for _ in range(5):
            for latents in work.latents.values():
                latents.grad = torch.full_like(latents, 1e9 * sign)
            work.step({**dict.fromkeys(FIELDS, 1e5), "attraction": 0.0})
        found = work.plan()
        assert (found.fields["means"].levels[plan.grid.mask][frozen] == 65535).all()
        for name, field in found.fields.items():
            assert field.levels.max() <= field.top, name
            plane, levels = work.planes[name], work.planes[name].levels(work.latents[name]).detach().numpy()
            free = (plane.min_latent < plane.max_latent).numpy()
            multiples = (levels + plane.field.level_offset) / plane.stride.numpy()
            assert (multiples[free] == np.rint(multiples[free])).all(), name
            if sign > 0:
                assert (work.latents[name] == plane.min_latent).all(), name


@pytest.mark.quick(0)
def test_latents_converge_to_the_level_nearest_to_the_best_value():
    """The loss is quadratic around a value between two levels; the gradient is evaluated at the levels only."""
    work = QuantizedScene(chosen(cloud(300, 1), "fast"), 1)
    count, rng = len(work), np.random.default_rng(5)
    costs = Costs(**{name: rng.uniform(0.5, 2, count) for name in Costs.__slots__})
    work.set_curvature(costs, 0.5)
    plane, name = work.planes["scales"], "scales"
    unit = (plane.step * plane.stride).numpy()
    best = np.clip(rng.uniform(-3, 3, (count, 3)), plane.min_latent.numpy(), plane.max_latent.numpy())
    curvature = costs.scale[:, None] * unit**2
    levels = []
    for step in range(1200):
        level = np.rint(work.latents[name].detach().numpy().astype(np.float64))
        work.latents[name].grad = torch.from_numpy((curvature * (level - best)).astype(np.float32))
        work.step({**dict.fromkeys(FIELDS, 0.1 * 0.02 ** (step / 1200)), "attraction": 1.0})
        levels.append(level)
    unambiguous = np.abs(best - np.rint(best)) < 0.45
    assert (levels[-1] == np.rint(best))[unambiguous].all()
    assert (levels[-1] == levels[-200])[unambiguous].all()
    np.testing.assert_allclose(work.latents[name].detach().numpy(), best, atol=0.05)


def test_non_finite_gradients_have_no_effect():
    work = QuantizedScene(chosen(cloud(30), "fast"), 1)
    work.set_curvature(Costs(**{name: np.zeros(len(work)) for name in Costs.__slots__}), 1.0)
    for bad in (np.nan, 0.0, np.inf):
        for latents in work.latents.values():
            latents.grad = torch.full_like(latents, bad)
        work.step({**dict.fromkeys(FIELDS, 0.1), "attraction": 1.0})
        assert all(torch.isfinite(latents).all() for latents in work.latents.values())
        assert all((latents == 0).all() for latents in work.latents.values())


def test_the_result_does_not_depend_on_torch_threads():
    scene, found, before = cloud(2000, 2), [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        work = QuantizedScene(chosen(scene, "fast"), 2)
        for seed in range(3):
            weights = np.random.default_rng(seed)
            sum(
                (torch.from_numpy(weights.normal(size=value.shape).astype(np.float32)) * value).sum()
                for value in work.gaussians().values()
            ).backward()
            work.step({**dict.fromkeys(FIELDS, 0.3), "attraction": 1.0})
        found.append(decoded_by(work))
    torch.set_num_threads(before)
    assert same(found[0], found[1])
    assert same(found[0], found[2])
