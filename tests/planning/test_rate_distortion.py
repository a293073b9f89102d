"""Oracle: all levels by brute force, the square law of rounding, and scenes with degenerate sensitivity."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import reference_decoder
from helpers.codec_scenes import assert_round_trip, constant_scene, covariances, random_scene
from helpers.random_sensitivity import encode_rd, packed_hessian, random_sensitivity

from kissgs import Settings, compress, decompress
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import clean
from kissgs.core.threads import Workers
from kissgs.planning.quantize import quantize
from kissgs.planning.rd_model import MIN_ERROR_RATIO, CodebookErrorModel, Costs, RdCriterion, error_at, lambda_for, step
from kissgs.planning.rdo_quantize import CAPTURED, quantize_by_class, rdo_quantize_shapes
from kissgs.sogxt.encode import encode

RD_PRESETS = ["balanced", "small"]


def anything(count):
    """Changes as large as any may be."""
    return {name: np.full(count, change) for name, change in CAPTURED.items()}


def test_a_step_costs_what_a_bit_does():
    """Halving it saves H d²/12 (1 - 1/4) by a bit: at the optimum the derivative by bits is lambda."""
    cost, rd_lambda = 3e-4, 2e-9
    best = step(cost, rd_lambda)

    def total(bits):
        return cost * (best * 2**-bits) ** 2 / 12 + rd_lambda * bits

    around = [total(bits) for bits in (-0.01, 0, 0.01)]
    assert around[1] < min(around[0], around[2])


def test_lambda_for_gives_the_requested_error():
    splats = random_scene(4000, 3, seed=1)
    costs = Costs.of(random_sensitivity(splats), splats)
    sh_model = CodebookErrorModel(1024, 1e-6, 2e-6)
    for error in (1e-6, 1e-4):
        rd_lambda = lambda_for(error, costs, sh_model, 10, 7, 0.2)
        np.testing.assert_allclose(error_at(rd_lambda, costs, sh_model, 10, 7, 0.2), error, rtol=0.05)
    least = error_at(1e-22, costs, sh_model, 10, 7, 0.2)  # what the largest codebook leaves
    rd_lambda = lambda_for(least / 100, costs, sh_model, 10, 7, 0.2)
    np.testing.assert_allclose(error_at(rd_lambda, costs, sh_model, 10, 7, 0.2), MIN_ERROR_RATIO * least, rtol=0.05)
    sizes = [sh_model.best_size(rd_lambda, 100_000, 7) for rd_lambda in (1e-14, 1e-12, 1e-10)]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] <= round(100_000 / 7)
    assert sh_model.best_size(1e-20, 6000, 7) == 3000


def test_classes_are_of_like_sensitivity_and_size():
    splats = random_scene(1000, 0)
    costs = Costs.of(random_sensitivity(splats), splats).take(np.arange(0, 1000, 2))
    places = splats.means[::2]
    classes = costs.classes(5, places)
    assert np.bincount(classes).tolist() == [100] * 5
    worth = costs.scale * costs.rotation * costs.color
    assert all(worth[classes == c].min() >= worth[classes == c + 1].max() for c in range(4))
    assert (costs.classes(1, places) == 0).all()
    for few in range(1, 10):
        assert (np.bincount(costs.take(np.arange(few)).classes(32, places[:few])) == 1).all()


def test_gaussians_in_one_place_keep_their_order():
    """The stored order decides which of them is in front."""
    splats = random_scene(600, 0)
    splats = replace(splats, means=np.repeat(splats.means[:20] * np.float32([0, 1, 1]), 30, axis=0))
    costs = Costs.of(random_sensitivity(splats), splats)
    classes = costs.classes(5, splats.means).reshape(20, 30)
    assert (classes == classes[:, :1]).all()
    assert len(np.unique(classes)) == classes.max() + 1
    order = encode_rd(splats, random_sensitivity(splats), prune_threshold_bits=0).order
    for place in range(20):
        assert (np.diff(order[order // 30 == place]) > 0).all()


def test_what_is_dropped_is_worth_least_and_never_more_than_half():
    splats = random_scene(101, 0, seed=3)
    costs = Costs.of(random_sensitivity(splats), splats)
    ranked = np.argsort(costs.removal)
    for rd_lambda, count in ((0.0, 0), (float(costs.removal[ranked[10]]) / 7, 10), (1e9, 50)):
        dropped = costs.pruned_by_rd(rd_lambda, 7)
        assert sorted(np.flatnonzero(dropped)) == sorted(ranked[:count])


def test_levels_of_a_class_are_multiples_of_its_step():
    rng = np.random.default_rng(0)
    values, classes = rng.normal(size=(3000, 3)), np.repeat([0, 1, 2], 1000)
    cost = np.repeat([1.0, 0.1, 0.004], 1000)
    splats = random_scene(3000, 0)
    criterion = RdCriterion(Costs.of(random_sensitivity(splats), splats), classes, 1e-4)
    found = quantize_by_class(values, criterion.class_steps(cost), classes, np.full(3000, 2.0))
    each = (found.high.astype(float) - found.low) / found.top
    errors = np.abs(found.low + found.levels * each - values)
    for c, wanted in enumerate((1, 3, 16)):
        levels = found.levels[classes == c]
        assert (levels % wanted == 0).all()
        inner = (levels > 0) & (levels < found.top - wanted)
        assert errors[classes == c][inner].max() <= 0.5001 * wanted * each.max()
    assert found.levels.min() == 0


def parts_of(values, steps=(0.4, 0.3, 0.1)):
    return tuple(quantize(values[:, a:b], step=s) for (a, b), s in zip(((0, 1), (1, 4), (4, 8)), steps, strict=True))


def test_without_a_rate_cost_levels_are_the_nearest_along_each_axis():
    rng = np.random.default_rng(1)
    count = 400
    quats = rng.normal(size=(count, 4)) * 0.2 + [1, 0, 0, 0]
    values = np.concatenate([rng.normal(size=(count, 4)), quats / np.linalg.norm(quats, axis=1, keepdims=True)], axis=1)
    parts = parts_of(values)
    splats = random_scene(count, 0)
    costs = Costs.of(random_sensitivity(splats), splats)
    with Workers(1) as pool:
        found = rdo_quantize_shapes(
            values,
            parts,
            np.tile(packed_hessian(np.diag([1.0] * 4 + [0] * 3)), (count, 1)),
            np.zeros(count, np.uint8),
            RdCriterion(costs, np.zeros(count, np.int64), 1e-30),
            anything(count),
            pool,
        )
    for part, chosen, (a, b) in list(zip(parts, found, ((0, 1), (1, 4), (4, 8)), strict=True))[:2]:
        each = (part.high.astype(float) - part.low) / part.top
        np.testing.assert_allclose(
            chosen.low + chosen.levels * ((chosen.high.astype(float) - chosen.low) / chosen.top),
            np.rint((values[:, a:b] - part.low) / each) * each + part.low,
            atol=1e-4,
        )


def test_rdo_quantisation_never_costs_more_than_the_nearest_level():
    """Error and bits together, the bits as the levels that were chosen then have them; and close to all pairs tried."""
    rng = np.random.default_rng(2)
    count, rd_lambda = 3000, 1e-3
    quats = rng.normal(size=(count, 4)) * 0.2 + [1, 0, 0, 0]
    values = np.concatenate([rng.normal(size=(count, 4)), quats / np.linalg.norm(quats, axis=1, keepdims=True)], axis=1)
    form = np.diag([1.0, 0.5, 0.5, 0.5, 0, 0, 0])
    form[0, 1] = form[1, 0] = 0.4  # an error of the opacity makes up for one of the first scale
    parts = parts_of(values)
    splats = random_scene(count, 0)
    costs = replace(
        Costs.of(random_sensitivity(splats), splats),
        **{name: np.full(count, 1e-9) for name in ("opacity", "scale", "rotation")},
    )
    with Workers(1) as pool:
        found = rdo_quantize_shapes(
            values,
            parts,
            np.tile(packed_hessian(form), (count, 1)),
            np.zeros(count, np.uint8),
            RdCriterion(costs, np.zeros(count, np.int64), rd_lambda),
            anything(count),
            pool,
        )

    def decoded(chosen):
        return np.concatenate([p.low + p.levels * ((p.high.astype(float) - p.low) / p.top) for p in chosen], axis=1)

    def total(chosen):
        off = (decoded(chosen) - values)[:, :4]
        bits = 0.0
        for column in np.concatenate([part.levels for part in chosen], axis=1).T:
            counts = np.bincount(column)
            bits -= (counts[counts > 0] * np.log2(counts[counts > 0] / count)).sum()
        return np.einsum("ni,ij,nj->", off, form[:4, :4], off) + rd_lambda * bits

    assert total(found) < 0.85 * total(parts)
    reach = np.array([2.0, 0.3, 0.3, 0.3, 0.25, 0.25, 0.25, 0.25])
    assert ((decoded(found) - values) <= reach + 1e-5).all()


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("count", [1, 7, 8, 9, 65, 2000])
@pytest.mark.quick(6)
def test_round_trips(count, degree):
    splats = clean(random_scene(count, degree, seed=count))[0]
    result = compress(
        splats,
        settings=Settings.from_preset(
            "balanced", prune_threshold_bits=0, sensitivity_views=4, sensitivity_view_size=64
        ),
    )
    assert_round_trip(splats, result)
    reference_decoder.assert_equal_scenes(
        decompress(result.files), reference_decoder.decode(result.files), result.files
    )
    assert sorted(result.order) == list(range(count))


def test_higher_quality_has_more_bytes_and_smaller_errors():
    splats = random_scene(3000, 1, seed=3)
    sensitivity = random_sensitivity(splats)
    sizes, errors = [], []
    for quality_offset_db in (-6, 0, 6):
        result = encode_rd(splats, sensitivity, quality_offset_db=quality_offset_db, prune_threshold_bits=0)
        sizes.append(sum(map(len, result.files.values())))
        found, wanted = decompress(result.files), splats.select(result.order)
        errors.append(float(sensitivity.diagonal((0,))[result.order, 0] @ (found.opacities - wanted.opacities) ** 2))
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)


def test_the_least_important_are_left_out_and_counted():
    splats = random_scene(1000, 0, seed=4)
    sensitivity = random_sensitivity(splats)
    result = encode_rd(splats, sensitivity, rd_lambda=1e-8, prune_threshold_bits=30)
    removal = sensitivity.removal(splats)
    assert sorted(result.order) == np.flatnonzero(removal >= 30 * 1e-8).tolist()
    assert 0 < result.pruned_by_rd == 1000 - len(result.order)


def test_growth_is_held_back():
    """A Gaussian below a pixel's size costs nothing in these views, whatever its size, but is a blob from nearby."""
    splats = random_scene(2000, 0, seed=5)
    sensitivity = random_sensitivity(splats)
    result = encode_rd(
        splats,
        replace(sensitivity, shape_hessian=sensitivity.shape_hessian * np.float32(1e-8)),
        rd_lambda=1e-5,
        prune_threshold_bits=0,
    )
    found, wanted = decompress(result.files), splats.select(result.order)
    grown = np.linalg.det(covariances(found.quats, found.scales)) / np.linalg.det(
        covariances(wanted.quats, wanted.scales)
    )
    assert grown.max() < np.exp(2 * 3 * 0.3 + 1e-3)


def torture():
    scene = random_scene(300, 2, seed=9)
    nothing = Sensitivity.none(300, 2)
    only = np.zeros(300, np.float32)
    only[17] = 1e-5
    one_seen = replace(nothing, color_weight=only, shape_hessian=only[:, None] * np.ones((1, 10), np.float32))
    black = replace(scene, sh0=np.full((300, 3), -5, np.float32))
    few = replace(scene, shN=scene.shN[np.arange(300) % 3])
    huge = random_sensitivity(scene, spread=20)
    return [
        pytest.param(scene, nothing, id="nothing is seen"),
        pytest.param(scene, one_seen, id="one Gaussian is seen"),
        pytest.param(black, random_sensitivity(black), id="all colours are clamped"),
        pytest.param(few, random_sensitivity(few), id="fewer SH vectors than entries"),
        pytest.param(scene, huge, id="sensitivity over forty orders of magnitude"),
        pytest.param(constant_scene(300, 2), random_sensitivity(scene), id="all alike"),
    ]


@pytest.mark.parametrize(("splats", "sensitivity"), torture())
@pytest.mark.parametrize("preset", RD_PRESETS)
@pytest.mark.quick(4)
def test_scenes_that_break_weights(splats, sensitivity, preset):
    once, again = (encode(splats, Settings.from_preset(preset).encode, sensitivity=sensitivity) for _ in range(2))
    assert once.files == again.files
    found = decompress(once.files)
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(once.files), once.files)
    assert len(found) == len(once.order) > 0
    assert all(
        np.isfinite(getattr(found, name)).all() for name in ("means", "quats", "scales", "opacities", "sh0", "shN")
    )


def test_colours_are_asked_for_once_the_rest_is_known():
    splats = random_scene(500, 1, seed=6)
    asked = []

    def recolor(decoded, order):
        asked.append((decoded, order))
        return np.full((len(order), 3), 0.25, np.float32)

    settings = Settings.from_preset("balanced").encode
    result = encode(splats, settings, sensitivity=random_sensitivity(splats), recolor=recolor)
    ((decoded, order),) = asked
    found = decompress(result.files)
    np.testing.assert_array_equal(order, result.order)
    np.testing.assert_allclose(found.sh0, 0.25, atol=1e-6)
    np.testing.assert_allclose(decoded.scales, found.scales, atol=1e-5)
    np.testing.assert_allclose(decoded.opacities, found.opacities, atol=1e-5)
    np.testing.assert_allclose(decoded.means, found.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(decoded.shN, found.shN, atol=1e-6)


def test_threads_do_not_change_a_byte():
    splats = random_scene(2000, 3, seed=7)
    sensitivity = random_sensitivity(splats)
    settings = Settings.from_preset("small").encode
    one, three = (encode(splats, settings, sensitivity=sensitivity, threads=threads).files for threads in (1, 3))
    assert one == three


@pytest.mark.parametrize(
    "changes", [{"order": "plas"}, {"rotation_form": "pras"}, {"gaussians_per_codebook_entry": 50}, {"step_classes": 7}]
)
def test_rate_distortion_works_with_every_order_and_form(changes):
    splats = random_scene(700, 1, seed=8)
    result = encode_rd(splats, random_sensitivity(splats), prune_threshold_bits=0, sh_tolerance=0, **changes)
    found, wanted = decompress(result.files), splats.select(result.order)
    assert sorted(result.order) == list(range(700))
    for name, field in (("opacities", "opacities"), ("sh0", "f_dc")):
        assert np.abs(getattr(found, name) - getattr(wanted, name)).max() <= max(result.errors[field]) + 1e-5
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(result.files), result.files)
