"""The differentiable decoder of SOG. Oracle: written files and their readers; finite differences of plain NumPy."""

import numpy as np
import pytest
import torch
from helpers.codec_scenes import replaced
from helpers.reference_sog import read_files
from helpers.training_scenes import cloud, same
from helpers.tuning_scenes import FIELDS, choices, chosen, shuffled

from kissgs import Settings, Splats, decompress
from kissgs.core.splats import ATTRIBUTES
from kissgs.finetuning.quantized_scene import QuantizedScene, table_name
from kissgs.io.conventions import OPACITY_OF_BYTE
from kissgs.planning.rd_criterion import Costs
from kissgs.sog.encode import SOG, write_files

TABLES = ("scales", "f_dc", "f_rest_centroids")


def quantized(scene, preset="balanced", **changes):
    return QuantizedScene(chosen(scene, preset, SOG, **changes), scene.sh_degree, container=SOG)


def files_of(work, scene):
    return write_files(work.plan(), Settings().encode, threads=1).files


def decoded_by(work):
    return Splats(**{name: tensor.detach().numpy() for name, tensor in work.gaussians().items()})


def moved_far(work, sign, rate=1e4):
    """Make steps of huge gradients."""
    for _ in range(3):
        for latents in (*work.latents.values(), *work.table_latents.values()):
            latents.grad = torch.full_like(latents, sign * 1e9)
        rates = {**dict.fromkeys(FIELDS, rate), **{table_name(name): rate for name in TABLES}}
        work.step({**rates, "attraction": 0.0})


@pytest.mark.parametrize("number", range(len(choices())))
@pytest.mark.parametrize("moved", [True, False])
@pytest.mark.quick(12)
def test_readers_find_exactly_what_was_trained(number, moved):
    scene, preset = choices()[number]
    work = quantized(scene, preset)
    if moved:
        shuffled(work)
    files, trained = files_of(work, scene), decoded_by(work)
    assert same(decompress(files), trained)
    other = read_files(files)
    for name in ATTRIBUTES:
        np.testing.assert_allclose(other[name], getattr(trained, name), rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("preset", ["fast", "balanced", "paper"])
def test_an_untrained_plan_is_unchanged(preset):
    scene = cloud(300, 2)
    plan = chosen(scene, preset, SOG)
    found = write_files(QuantizedScene(plan, 2, container=SOG).plan(), Settings().encode, threads=1)
    assert found.files == write_files(plan, Settings().encode, threads=1).files
    assert found.errors == plan.errors


def unrounded(work, levels, tables):
    """Decode places between the levels that each row may use, in float64 NumPy."""
    values = {}
    for name, plane in work.planes.items():
        field, place = plane.field, plane.base_multiples.numpy() + levels[name]
        if name == "means":
            low, high = field.low.astype(float), field.high.astype(float)
            values[name] = low + place * plane.stride.numpy() * (high - low) / 65535
            continue
        listed = plane.lists.numpy()[plane.first.numpy()[:, 0] // plane.lists.shape[1]]
        if name == "quaternions":
            table = (np.arange(256) / 255 - 0.5) * np.sqrt(2)
        else:
            table = tables.get(name, OPACITY_OF_BYTE.astype(float))
        values[name] = np.stack(
            [np.interp(row, np.arange(len(some)), table[some]) for row, some in zip(place, listed, strict=True)]
        )
    omitted = work._omitted.numpy()[:, 0]
    small, quats = values["quaternions"], np.empty((len(omitted), 4))
    for row, missing in enumerate(omitted):
        quats[row, [k for k in range(4) if k != missing]] = small[row]
        quats[row, missing] = np.sqrt(1 - np.sum(small[row] ** 2))
    coefficients = work.gaussians()["shN"].shape[1]
    entries = values["f_rest_centroids"].reshape(-1, 3, 15)[:, :, :coefficients].transpose(0, 2, 1)
    return {
        "means": np.sign(values["means"]) * np.expm1(np.abs(values["means"])),
        "quats": quats,
        "scales": values["scales"],
        "opacities": values["opacities"][:, 0],
        "sh0": values["f_dc"],
        "shN": entries[work._labels.index.numpy()],
    }


@pytest.mark.parametrize(("preset", "degree"), [("balanced", 3), ("fast", 1), ("paper", 2)])
@pytest.mark.quick(1)
def test_gradients_of_levels_and_tables_are_finite_differences(preset, degree):
    scene = cloud(120, degree)
    work = quantized(scene, preset)
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=value.shape) for name, value in work.gaussians().items()}
    sum((torch.from_numpy(weights[name]) * value).sum() for name, value in work.gaussians().items()).backward()
    here = {name: latents.detach().numpy().astype(np.float64) for name, latents in work.latents.items()}
    tables = {name: table.detach().numpy() for name, table in work.tables().items()}
    units = {name: table.unit.numpy() for name, table in work.trained_tables.items()}

    def slope(name, place, parts, size):
        sides = []
        for sign in (1, -1):
            changed = parts[name].copy()
            changed[place] += sign * size
            moved = {**parts, name: changed}
            found = unrounded(work, moved, tables) if parts is here else unrounded(work, here, moved)
            sides.append(sum((weights[key] * value).sum() for key, value in found.items()))
        return (sides[0] - sides[1]) / (2 * size)

    for name, latents in work.latents.items():
        inside = np.argwhere((work.planes[name].min_latent < 0).numpy() & (work.planes[name].max_latent > 0).numpy())
        for place in map(tuple, inside[rng.permutation(len(inside))[:6]]):
            wanted = slope(name, place, here, 1e-4)
            assert float(latents.grad[place]) == pytest.approx(wanted, rel=5e-4, abs=1e-5), name
    for name, latents in work.table_latents.items():
        for entry in rng.permutation(len(latents))[:5]:
            wanted = slope(name, entry, tables, 1e-4) * units[name][entry]
            assert float(latents.grad[entry]) == pytest.approx(wanted, rel=5e-4, abs=1e-5), name


def test_the_gradient_beside_a_level_is_that_of_its_side():
    work = quantized(cloud(120), "balanced")
    plane, latents = work.planes["scales"], work.latents["scales"]
    row, column = map(int, np.argwhere(((plane.min_latent < 0) & (plane.max_latent > 0)).numpy())[0])
    listed = plane.lists.reshape(-1).numpy()[int(plane.first[row]) :]
    place, table = int(plane.base_multiples[row, column]), work.tables()["scales"].detach().numpy()
    below, here, above = table[listed[place - 1 : place + 2]]
    for latent, distance in ((0.3, above - here), (-0.3, here - below), (0.0, (above - below) / 2)):
        latents.data[row, column] = latent
        latents.grad = None
        work.gaussians()["scales"].sum().backward()
        assert float(latents.grad[row, column]) == pytest.approx(distance, rel=1e-5)
        assert float(plane.units(latents, work.tables()["scales"])[row, column]) == pytest.approx(distance, rel=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("preset", ["balanced", "fast"])
@pytest.mark.quick(2)
def test_everything_stays_within_what_the_container_holds(sign, preset):
    scene = cloud(200, 2)
    hidden = np.arange(200) % 20 == 0
    scene = replaced(scene, opacities=np.where(hidden, -9, np.linspace(-5.4, 15, 200)))
    changes = {"prune_invisible": False} if preset == "fast" else {}
    plan = chosen(scene, preset, SOG, **changes)
    work = QuantizedScene(plan, 2, container=SOG)
    moved_far(work, sign)
    found = work.plan()
    before, after = (some.fields["opacities"].levels[plan.grid.mask, 0] for some in (plan, found))
    assert (after[before < 2] == before[before < 2]).all()
    assert ((after >= 2) & (after <= 254))[before >= 2].all()
    assert (before < 2).any() == (preset == "fast")
    for name in TABLES:
        table = found.fields[name].table
        assert (np.diff(table) > 0).all()
        assert len(table) <= 256
        if name != "f_rest_centroids" and preset == "fast":  # every class can use every value
            assert not np.array_equal(table, plan.fields[name].table)
    zero = plan.fields["f_rest_centroids"].table == 0
    assert (found.fields["f_rest_centroids"].table[zero] == 0).all()
    norms = np.linalg.norm(decompress(files_of(work, scene)).quats, axis=1)
    np.testing.assert_allclose(norms, 1, rtol=1e-6)
    assert same(decompress(files_of(work, scene)), decoded_by(work))


@pytest.mark.parametrize("sign", [1, -1])
def test_no_step_crosses_a_wide_gap(sign):
    """Discs stay discs: no axis of e^-1 becomes one of e^-30, and the values of the table stay apart."""
    flat = np.r_[np.full(100, -30.0), np.linspace(-1.2, -0.8, 200)].reshape(100, 3)
    scene = replaced(cloud(100), scales=np.random.default_rng(0).permuted(flat, axis=1))
    work = quantized(scene)
    thick = work.gaussians()["scales"].detach().numpy() > -2
    moved_far(work, sign)
    found = work.gaussians()["scales"].detach().numpy()
    assert ((found > -15) == thick).all()
    units = work.trained_tables["scales"].unit.numpy()
    assert ((units > 0) & (units < 0.6)).all()


def test_latents_settle_at_the_level_nearest_to_the_best_value():
    """The loss is quadratic around a value between two levels; the gradient is evaluated at the levels only."""
    work = quantized(cloud(200, 1), "fast")
    rng = np.random.default_rng(5)
    costs = Costs(**{name: rng.uniform(0.5, 2, len(work)) for name in Costs.__slots__})
    work.set_curvature(costs, 0.5)
    plane, latents = work.planes["scales"], work.latents["scales"]
    table = work.tables()["scales"].detach().numpy()
    start = plane.field.levels.astype(int)
    target = np.clip(start + rng.integers(-3, 3, start.shape), 0, len(table) - 2)
    share = rng.uniform(0.05, 0.95, start.shape)
    best = (1 - share) * table[target] + share * table[target + 1]
    for step in range(700):
        value = plane.values(latents.detach(), torch.from_numpy(table)).numpy()
        units = plane.units(latents, torch.from_numpy(table)).numpy()
        latents.grad = torch.from_numpy((costs.scale[:, None] * (value - best) * units).astype(np.float32))
        work.step({**dict.fromkeys(FIELDS, 0.1 * 0.02 ** (step / 700)), "attraction": 1.0} | no_tables())
    found = plane.levels(latents.detach()).numpy()
    clear = np.abs(share - 0.5) > 0.06
    assert (found == target + (share > 0.5))[clear].all()


def no_tables():
    return {table_name(name): 0.0 for name in TABLES}


def test_non_finite_gradients_have_no_effect():
    work = quantized(cloud(30), "fast")
    work.set_curvature(Costs(**{name: np.zeros(len(work)) for name in Costs.__slots__}), 1.0)
    before = decoded_by(work)
    rates = {**dict.fromkeys(FIELDS, 0.1), **{table_name(name): 0.1 for name in TABLES}, "attraction": 1.0}
    for bad in (np.nan, 0.0, np.inf):
        for latents in (*work.latents.values(), *work.table_latents.values()):
            latents.grad = torch.full_like(latents, bad)
        work.step(rates)
    assert same(before, decoded_by(work))
