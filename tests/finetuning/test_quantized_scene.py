"""The differentiable decoder. Oracle: written containers and their readers; finite differences in float64 NumPy."""

import numpy as np
import pytest
import torch
from helpers import reference_decoder
from helpers.codec_scenes import replaced
from helpers.reference_sog import read_files
from helpers.training_scenes import cloud, same
from helpers.tuning_scenes import FIELDS, choices, chosen, shuffled
from scipy.spatial.transform import Rotation

from kissgs import Settings, Splats, decompress
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES
from kissgs.finetuning.planes import TABLES
from kissgs.finetuning.quantized_scene import QuantizedScene, table_name
from kissgs.pipeline.encoding import model_of, write_files
from kissgs.planning.rd_fields import Costs

IMAGES = {"opacities": 3, "scales": 3, "quaternions": 4, "f_dc": 3}

both = pytest.mark.parametrize("container", ["sogxt", "sog"])


def scene_of(scene, preset, container, **changes):
    return QuantizedScene(
        chosen(scene, preset, model_of(container), **changes), scene.sh_degree, "cpu", model_of(container)
    )


def files_of(plan, container):
    return write_files(container, plan, Settings().encode, Context(1)).files


def decoded_by(work):
    return Splats(**{name: tensor.detach().numpy() for name, tensor in work.gaussians().items()})


def moved_far(work, sign, rate=1e4):
    """Make steps of huge gradients."""
    for _ in range(3):
        for latents in (*work.latents.values(), *work.table_latents.values()):
            latents.grad = torch.full_like(latents, sign * 1e9)
        work.step({**dict.fromkeys(FIELDS, rate), **table_rates(rate), "attraction": 0.0})


def table_rates(rate):
    return {table_name(name): rate for name in TABLES}


@pytest.mark.parametrize("number", range(len(choices())))
@pytest.mark.quick(6)
def test_written_levels_and_decoded_values_equal_those_of_training(number):
    scene, preset = choices()[number]
    work = scene_of(scene, preset, "sogxt")
    if number % 3:
        shuffled(work)
    files, mask = files_of(work.plan(), "sogxt"), work.grid.mask
    written = {name: reference_decoder.levels(files, name, channels)[mask] for name, channels in IMAGES.items()}
    high, low = (reference_decoder.levels(files, f"means_bytes_{n}", 3)[mask].astype(int) for n in (1, 0))
    for name, image in {**written, "means": 256 * high + low}.items():
        levels = work.planes[name].levels(work.latents[name]).detach().numpy()
        assert (image[:, : levels.shape[1]] == levels).all(), name
    decoded, reference = decompress(files), reference_decoder.decode(files)
    for name in ATTRIBUTES:
        found, wanted = getattr(decoded_by(work), name), getattr(decoded, name)
        scale = np.abs(wanted).max(initial=1e-9)
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=3e-6 * scale, err_msg=name)
    reference_decoder.assert_equal_scenes(decoded, reference, files)


@pytest.mark.parametrize("number", range(len(choices())))
@pytest.mark.quick(6)
def test_readers_of_sog_find_exactly_what_was_trained(number):
    scene, preset = choices()[number]
    work = scene_of(scene, preset, "sog")
    if number % 3:
        shuffled(work)
    files, trained = files_of(work.plan(), "sog"), decoded_by(work)
    assert same(decompress(files), trained)
    other = read_files(files)
    for name in ATTRIBUTES:
        np.testing.assert_allclose(other[name], getattr(trained, name), rtol=2e-6, atol=2e-6, err_msg=name)


@pytest.mark.parametrize(
    ("preset", "container"), [("fast", "sog"), ("balanced", "sog"), ("balanced", "sogxt"), ("paper", "sogxt")]
)
def test_an_untrained_plan_is_unchanged(preset, container):
    """Except for a few levels of SOG-XT that are no multiples of their stride; these move by less than one step."""
    plan = chosen(cloud(400, 2), preset, model_of(container))
    found = QuantizedScene(plan, 2, "cpu", model_of(container)).plan()
    if container == "sog":
        assert files_of(found, container) == files_of(plan, container)
        assert found.errors == plan.errors
    for name, field in plan.fields.items():
        change = found.fields[name].levels.astype(int) - field.levels
        stride = 1
        if name != "f_rest_centroids":  # padding may repeat another form of a Gaussian
            change, stride = change[plan.grid.mask], np.asarray(field.take(plan.grid.mask).level_stride)
            stride = stride if stride.ndim == 2 else stride.reshape(-1, 1)
        assert (change != 0).mean() < 0.15
        assert (np.abs(change) <= stride / 2).all()
        if name == "means":
            assert not change.any()


@pytest.mark.parametrize("degree", [1, 0])
def test_learning_rates_are_in_units_of_attributes(degree):
    """Adam's first step has the length of the learning rate: here in each attribute, rounding left out."""
    rates = {
        "means": 2e-5,
        "opacities": 3e-2,
        "scales": 4e-3,
        "quaternions": 5e-4,
        "f_dc": 6e-3,
        "f_rest_centroids": 7e-4,
    }
    plan = chosen(cloud(70, degree), "paper")
    work = QuantizedScene(plan, degree)
    work.take_rates_of_attributes()
    before = {name: plane.field.values() for name, plane in work.planes.items()}
    for latents in work.latents.values():
        latents.grad = torch.full_like(latents, -1e-3)
    work.step({**rates, "attraction": 0.0})
    for name, plane in work.planes.items():
        top, extent = plane.field.top, np.ptp(plane.field.table, axis=0)
        moved = work.latents[name].detach().numpy() * extent / top
        inside = (plane.max_latent.numpy() >= 1) & (extent > 0)
        if name == "means":
            moved = moved * (1 + np.abs(np.sign(before[name]) * np.expm1(np.abs(before[name]))))
        if inside.any():
            np.testing.assert_allclose(moved[inside], rates[name], rtol=2e-3, err_msg=name)


def covariances_of(quats, scales):
    turns = Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix()
    return turns @ (np.exp(2 * scales.astype(np.float64))[:, :, None] * turns.transpose(0, 2, 1))


def test_forms_are_chosen_anew_in_new_ranges():
    """Oracle: covariances, which forms leave as they are; ranges of the values; all padding repeats one Gaussian."""
    plan = chosen(cloud(70, 1), "paper")
    work = QuantizedScene(plan, 1)
    for name in ("quaternions", "scales"):
        work.latents[name].data += torch.from_numpy(np.random.default_rng(0).uniform(-9, 9, (70, 1))).float()
        work.latents[name].data.clamp_(work.planes[name].min_latent, work.planes[name].max_latent)

    def exact():
        step = {name: np.ptp(work.planes[name].field.table, axis=0) / work.planes[name].field.top for name in IMAGES}
        return [
            work.planes[name].field.table[0] + step[name] * (plane_of(work, name)) for name in ("quaternions", "scales")
        ]

    before = exact()
    work.choose_forms(0.95, 1)
    after = exact()
    assert (np.abs(after[1] - before[1]).max(axis=1) > 0.1).any(), "some have another form"
    np.testing.assert_allclose(covariances_of(*after), covariances_of(*before), rtol=1e-4, atol=1e-6)
    found = work.plan()
    for name, values in zip(("quaternions", "scales"), after, strict=True):
        np.testing.assert_allclose(
            found.fields[name].table[[0, -1]], [values.min(axis=0), values.max(axis=0)], atol=1e-6
        )
        assert len(np.unique(found.fields[name].levels[~plan.grid.mask], axis=0)) == 1
        assert np.abs(found.fields[name].take(plan.grid.mask).values() - values).max() <= max(found.errors[name]) + 1e-6
    assert found.fields["quaternions"].top == 99
    other = QuantizedScene(plan, 1)
    other.restore(work.state())
    for one, two in zip(work.plan().fields.values(), other.plan().fields.values(), strict=True):
        assert (one.levels == two.levels).all()
        assert (one.table == two.table).all()


def plane_of(work, name):
    """Return the places among the levels, not rounded."""
    return work.planes[name].base_multiples.numpy() + work.latents[name].detach().numpy()


def test_errors_count_entries_that_gaussians_use_only():
    plan = chosen(cloud(40, 1), "fast")
    work = QuantizedScene(plan, 1)
    unused = np.setdiff1d(np.arange(len(plan.codebook.centroids.levels)), plan.codebook.labels)
    assert len(unused) > 0
    latents = work.latents["f_rest_centroids"]
    latents.data[unused] += 5
    latents.data.clamp_(work.planes["f_rest_centroids"].min_latent, work.planes["f_rest_centroids"].max_latent)
    assert work.plan().errors["f_rest_centroids"] == plan.errors["f_rest_centroids"]


def between_levels(work, latents, tables):
    """Decode latents without rounding, on straight lines between the values of neighbouring levels."""
    values = {}
    for name, plane in work.planes.items():
        table = tables[name].reshape(-1, 1) if name in tables else plane.table.numpy()
        place, lists = plane.base_multiples.numpy() + latents[name], plane.lists.numpy()
        below = np.floor(place).astype(int)
        columns = np.arange(place.shape[1]) % table.shape[1]
        one, other = (table[lists[plane.start.numpy() + below + side], columns] for side in (0, 1))
        values[name] = one + (place - below) * (other - one)
    quats = values["quaternions"]
    if work._omitted is not None:
        small, quats = quats, np.empty((len(quats), 4))
        for row, missing in enumerate(work._omitted.numpy()[:, 0]):
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


@pytest.mark.parametrize(
    ("preset", "degree", "container"),
    [("balanced", 3, "sog"), ("fast", 1, "sogxt"), ("paper", 2, "sogxt"), ("balanced", 0, "sogxt")],
)
def test_gradients_of_levels_and_tables_are_finite_differences(preset, degree, container):
    work = scene_of(cloud(120, degree), preset, container)
    rng = np.random.default_rng(1)
    weights = {name: rng.normal(size=value.shape) for name, value in work.gaussians().items()}
    sum((torch.from_numpy(weights[name]) * value).sum() for name, value in work.gaussians().items()).backward()
    here = {name: latents.detach().numpy().astype(np.float64) for name, latents in work.latents.items()}
    tables = {name: table.detach().numpy() for name, table in work.tables().items()}

    def slope(name, place, parts, size=1e-4):
        sides = []
        for sign in (1, -1):
            changed = parts[name].copy()
            changed[place] += sign * size
            moved = {**parts, name: changed}
            found = between_levels(work, moved, tables) if parts is here else between_levels(work, here, moved)
            sides.append(sum((weights[key] * value).sum() for key, value in found.items()))
        return (sides[0] - sides[1]) / (2 * size)

    for name, latents in work.latents.items():
        inside = np.argwhere((work.planes[name].min_latent < 0).numpy() & (work.planes[name].max_latent > 0).numpy())
        for place in map(tuple, inside[rng.permutation(len(inside))[:6]]):
            assert float(latents.grad[place]) == pytest.approx(slope(name, place, here), rel=5e-4, abs=1e-5), name
    for name, latents in work.table_latents.items():
        unit = work.trained_tables[name].unit.numpy()
        for entry in rng.permutation(len(latents))[:5]:
            wanted = slope(name, entry, tables) * unit[entry]
            assert float(latents.grad[entry]) == pytest.approx(wanted, rel=5e-4, abs=1e-5), name


def test_the_gradient_beside_a_level_is_that_of_its_side():
    work = scene_of(cloud(120), "balanced", "sog")
    plane, latents = work.planes["scales"], work.latents["scales"]
    row, column = map(int, np.argwhere(((plane.min_latent < 0) & (plane.max_latent > 0)).numpy())[0])
    at, table = int(plane.positions(latents)[row, column]), work.tables()["scales"].detach().numpy()
    below, here, above = table[plane.lists.numpy()[at - 1 : at + 2]]
    for latent, distance in ((0.3, above - here), (-0.3, here - below), (0.0, (above - below) / 2)):
        latents.data[row, column] = latent
        latents.grad = None
        work.gaussians()["scales"].sum().backward()
        assert float(latents.grad[row, column]) == pytest.approx(distance, rel=1e-5)
        assert float(plane.units(latents, work.tables()["scales"])[row, column]) == pytest.approx(distance, rel=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_frozen_levels_stay_and_no_level_leaves_its_range(sign):
    """Some readers rely on the largest position being 65535; a constant channel has no other level."""
    scene = cloud(200, 1)
    scene.scales[:, 1] = -2
    plan = chosen(scene)
    work, mask = QuantizedScene(plan, 1), plan.grid.mask
    frozen = plan.fields["means"].levels[mask] == 65535
    assert frozen.any()
    moved_far(work, sign, 1e5)
    found = work.plan()
    assert (found.fields["means"].levels[mask][frozen] == 65535).all()
    for name, field in found.fields.items():
        assert field.levels.max() <= field.top, name
        plane, own = work.planes[name], field if name == "f_rest_centroids" else field.take(mask)
        free = (plane.min_latent < plane.max_latent).numpy()
        multiples = (own.levels.astype(int) + own.level_offset) / np.reshape(own.level_stride, (-1, 1))
        assert (multiples[free] == np.rint(multiples[free])).all(), name
        assert (work.latents[name] == (plane.min_latent if sign > 0 else plane.max_latent)).all(), name


@pytest.mark.parametrize(("sign", "preset"), [(1, "balanced"), (-1, "fast"), (1, "fast")])
@pytest.mark.quick(2)
def test_everything_stays_within_what_sog_holds(sign, preset):
    hidden = np.arange(200) % 20 == 0
    scene = replaced(cloud(200, 2), opacities=np.where(hidden, -9, np.linspace(-5.4, 15, 200)))
    work = scene_of(scene, preset, "sog", **({"prune_invisible": False} if preset == "fast" else {}))
    plan = work.plan()
    moved_far(work, sign)
    found = work.plan()
    before, after = (some.fields["opacities"].levels[plan.grid.mask, 0] for some in (plan, found))
    assert (after[before < 2] == before[before < 2]).all()
    assert ((after >= 2) & (after <= 254))[before >= 2].all()
    assert (before < 2).any() == (preset == "fast")
    for name in TABLES:
        table = found.fields[name].table[:, 0]
        assert (np.diff(table) > 0).all()
        assert len(table) <= 256
        if name != "f_rest_centroids" and preset == "fast":  # every class can use every value
            assert not np.array_equal(table, plan.fields[name].table[:, 0])
    zero = plan.fields["f_rest_centroids"].table == 0
    assert (found.fields["f_rest_centroids"].table[zero] == 0).all()
    decoded = decompress(files_of(found, "sog"))
    np.testing.assert_allclose(np.linalg.norm(decoded.quats, axis=1), 1, rtol=1e-6)
    assert same(decoded, decoded_by(work))


@pytest.mark.parametrize("sign", [1, -1])
def test_no_step_crosses_a_wide_gap(sign):
    """Discs stay discs: no axis of e^-1 becomes one of e^-30, and the values of the table stay apart."""
    flat = np.r_[np.full(100, -30.0), np.linspace(-1.2, -0.8, 200)].reshape(100, 3)
    scene = replaced(cloud(100), scales=np.random.default_rng(0).permuted(flat, axis=1))
    work = scene_of(scene, "balanced", "sog")
    thick = work.gaussians()["scales"].detach().numpy() > -2
    moved_far(work, sign)
    found = work.gaussians()["scales"].detach().numpy()
    assert ((found > -15) == thick).all()
    units = work.trained_tables["scales"].unit.numpy()
    assert ((units > 0) & (units < 0.6)).all()


@both
def test_latents_settle_at_the_level_nearest_to_the_best_value(container):
    """The loss is quadratic around a value between two levels; the gradient is evaluated at the levels only."""
    work = scene_of(cloud(200, 1), "fast", container)
    rng = np.random.default_rng(5)
    costs = Costs(**{name: rng.uniform(0.5, 2, len(work)) for name in Costs.__slots__})
    work.set_curvature(costs, 0.5)
    plane, latents, columns = work.planes["scales"], work.latents["scales"], np.arange(3)
    trained = work.tables().get("scales")
    table = plane.field.table if trained is None else trained.detach().numpy()[:, None]
    start = plane.field.levels.astype(int)
    target = np.clip(start + rng.integers(-3, 3, start.shape), 0, len(table) - 2)
    share = rng.uniform(0.05, 0.95, start.shape)
    one, other = (table[target + side, columns % table.shape[1]] for side in (0, 1))
    best = (1 - share) * one + share * other
    for step in range(700):
        value, units = (
            function(latents.detach(), trained).detach().numpy() for function in (plane.values, plane.units)
        )
        latents.grad = torch.from_numpy((costs.scale[:, None] * (value - best) * units).astype(np.float32))
        work.step({**dict.fromkeys(FIELDS, 0.1 * 0.02 ** (step / 700)), **table_rates(0.0), "attraction": 1.0})
    clear = np.abs(share - 0.5) > 0.06
    assert (plane.levels(latents.detach()).numpy() == target + (share > 0.5))[clear].all()


@both
def test_non_finite_gradients_have_no_effect(container):
    work = scene_of(cloud(30), "fast", container)
    work.set_curvature(Costs(**{name: np.zeros(len(work)) for name in Costs.__slots__}), 1.0)
    before = decoded_by(work)
    for bad in (np.nan, 0.0, np.inf):
        for latents in (*work.latents.values(), *work.table_latents.values()):
            latents.grad = torch.full_like(latents, bad)
        work.step({**dict.fromkeys(FIELDS, 0.1), **table_rates(0.1), "attraction": 1.0})
    assert same(before, decoded_by(work))


@both
def test_the_result_does_not_depend_on_torch_threads(container):
    scene, found, before = cloud(2000, 2), [], torch.get_num_threads()
    for threads in (1, 3):
        torch.set_num_threads(threads)
        work = scene_of(scene, "fast", container)
        for seed in range(3):
            weights = np.random.default_rng(seed)
            sum(
                (torch.from_numpy(weights.normal(size=value.shape).astype(np.float32)) * value).sum()
                for value in work.gaussians().values()
            ).backward()
            work.step({**dict.fromkeys(FIELDS, 0.3), **table_rates(0.3), "attraction": 1.0})
        found.append(decoded_by(work))
    torch.set_num_threads(before)
    assert same(*found)
