"""Steps, levels and bounds of rounding. Oracle: the square law of rounding, and all levels by brute force."""

from dataclasses import replace

import numpy as np
from helpers.codec_scenes import random_scene
from helpers.random_sensitivity import encode_rd, packed_hessian, random_sensitivity

import kissgs
from kissgs.core.context import Workers
from kissgs.planning.quantize import quantize
from kissgs.planning.rd_fields import (
    CAPTURED,
    UNSEEN,
    VIRTUAL,
    Costs,
    RdCriterion,
    largest_changes,
    quantize_by_steps,
    rdo_quantize,
    step,
)


def anything(count):
    """Changes as large as any may be."""
    return {name: np.full(count, change) for name, change in CAPTURED.items()}


def parts_of(values):
    columns = {"opacities": (0, 1, 0.4), "scales": (1, 4, 0.3), "quaternions": (4, 8, 0.1)}
    return {name: quantize(values[:, a:b], step=step) for name, (a, b, step) in columns.items()}


def test_a_step_costs_what_a_bit_does():
    """Halving it saves H d²/12 (1 - 1/4) by a bit: at the optimum the derivative by bits is lambda."""
    cost, rd_lambda = 3e-4, 2e-9
    best = step(cost, rd_lambda)

    def total(bits):
        return cost * (best * 2**-bits) ** 2 / 12 + rd_lambda * bits

    around = [total(bits) for bits in (-0.01, 0, 0.01)]
    assert around[1] < min(around[0], around[2])


def criterion_of(cost, classes, rd_lambda):
    """A criterion where every attribute has this cost."""
    costs = Costs(**{name: np.broadcast_to(np.float64(cost), classes.shape) for name in Costs.__slots__})
    return RdCriterion.of(costs, classes, rd_lambda, keep=False)


def test_levels_of_a_class_are_multiples_of_its_step():
    rng = np.random.default_rng(0)
    values, classes = rng.normal(size=(3000, 3)), np.repeat([0, 1, 2], 1000)
    criterion = criterion_of(np.repeat([1.0, 0.1, 0.004], 1000), classes, 1e-4)
    about_three_axes = np.array(criterion.steps["scale"]) / 3**0.5
    np.testing.assert_allclose(criterion.steps["rotation"], about_three_axes)
    found = quantize_by_steps(values, criterion.each_step("scale", np.full(3000, 2.0)))
    each = (found.high.astype(float) - found.low) / found.top
    errors = np.abs(found.low + found.levels * each - values)
    for c, wanted in enumerate((1, 3, 16)):
        levels = found.levels[classes == c]
        assert (levels % wanted == 0).all()
        inner = (levels > 0) & (levels < found.top - wanted)
        assert errors[classes == c][inner].max() <= 0.5001 * wanted * each.max()
    assert found.levels.min() == 0


def shape_values(rng, count):
    """Opacity logits, log-scales and quaternions near the identity."""
    quats = rng.normal(size=(count, 4)) * 0.2 + [1, 0, 0, 0]
    return np.concatenate([rng.normal(size=(count, 4)), quats / np.linalg.norm(quats, axis=1, keepdims=True)], axis=1)


def rdo_quantized(values, form, cost, rd_lambda):
    """Levels of Gaussians of one class whose Hessian is ``form``; and those of uniform steps."""
    count, parts = len(values), parts_of(values)
    hessians, criterion = np.tile(packed_hessian(form), (count, 1)), criterion_of(cost, np.zeros(count, int), rd_lambda)
    with Workers(1) as pool:
        found = rdo_quantize(values, parts, hessians, np.zeros(count, np.uint8), criterion, anything(count), pool)
    return found, parts


def test_without_a_rate_cost_levels_are_the_nearest_along_each_axis():
    values = shape_values(np.random.default_rng(1), 400)
    found, parts = rdo_quantized(values, np.diag([1.0] * 4 + [0] * 3), 1e-12, 1e-30)
    for name, wanted in (("opacities", values[:, :1]), ("scales", values[:, 1:4])):
        part = parts[name]
        each = (part.high.astype(float) - part.low) / part.top
        nearest = np.rint((wanted - part.low) / each) * each + part.low
        np.testing.assert_allclose(found[name].from_zero().values(), nearest, atol=1e-4)


def test_rdo_quantisation_never_costs_more_than_the_nearest_level():
    """Error and bits together, the bits as the levels that were chosen then have them; and close to all pairs tried."""
    values, rd_lambda = shape_values(np.random.default_rng(2), 3000), 1e-3
    form = np.diag([1.0, 0.5, 0.5, 0.5, 0, 0, 0])
    form[0, 1] = form[1, 0] = 0.4  # an error of the opacity makes up for one of the first scale
    found, parts = rdo_quantized(values, form, 1e-9, rd_lambda)

    def decoded(chosen):
        return np.concatenate([part.values() for part in chosen.values()], axis=1)

    def total(chosen):
        off = (decoded(chosen) - values)[:, :4]
        bits = 0.0
        for column in np.concatenate([part.levels for part in chosen.values()], axis=1).T:
            counts = np.bincount(column)
            bits -= (counts[counts > 0] * np.log2(counts[counts > 0] / len(values))).sum()
        return np.einsum("ni,ij,nj->", off, form[:4, :4], off) + rd_lambda * bits

    assert total(found) < 0.85 * total(parts)
    reach = np.array([2.0, 0.3, 0.3, 0.3, 0.25, 0.25, 0.25, 0.25])
    assert ((decoded(found) - values) <= reach + 1e-5).all()


def test_largest_changes_follow_who_has_looked_at_each():
    """Nobody, a virtual camera, one of a capture; between them by the logarithm."""
    coverage, captured = np.array([0.0, 1.0, 1.0, 0.5, 1.0]), np.array([0.0, 0.0, 1.0, 0.0, 0.5])
    found = largest_changes(coverage, captured, 1.0)
    for name, changes in found.items():
        ends = np.array([UNSEEN[name], VIRTUAL[name], CAPTURED[name]])
        between = np.sqrt(ends[:-1] * ends[1:])
        np.testing.assert_allclose(changes[:], [*ends, *between])
        assert (np.diff(ends) > 0).all()
    fast = kissgs.EncodeSettings()
    steps = (fast.opacity_step, fast.scale_step, fast.scale_step, fast.quat_step, fast.sh0_step)
    assert tuple(UNSEEN.values()) == steps


def test_largest_changes_grow_with_the_steps_up_to_those_of_a_capture():
    some = np.array([0.0, 0.7])
    for name, most in CAPTURED.items():
        each = np.stack([largest_changes(some, 0 * some, step_growth)[name][:] for step_growth in (1.0, 8.0, 1e9)])
        np.testing.assert_allclose(each[1], np.minimum(2 * each[0], most))
        np.testing.assert_allclose(each[2], most)


def test_unseen_gaussians_are_rounded_no_coarser_than_by_uniform_planning():
    """Decoded values, not the bounds, at a lambda at which everything would be as coarse as possible."""
    splats = random_scene(2000, 0, seed=5)
    sensitivity = random_sensitivity(splats)
    coverage = np.where(np.arange(2000) < 700, 0.0, 1.0).astype(np.float32)
    sensitivity = replace(
        sensitivity, shape_hessian=sensitivity.shape_hessian * np.float32(1e-8), coverage=coverage, view_uncertainty=0.5
    )
    result = encode_rd(splats, sensitivity, quality_offset_db=0.0, prune_threshold_bits=0)
    found = kissgs.decompress(result.files)
    opacities = np.abs(found.opacities - splats.opacities[result.order])
    unseen = result.order < 700
    assert opacities[unseen].max() <= UNSEEN["opacities"] + 1e-4
    assert UNSEEN["opacities"] < opacities[~unseen].max() <= VIRTUAL["opacities"] + 1e-4


def test_larger_steps_let_changes_of_a_scene_grow_up_to_the_wide_limit():
    """Decoded values, not what was asked for: no scale is off by more than rounding may move it."""
    splats = random_scene(2000, 0, seed=5)
    sensitivity = random_sensitivity(splats)
    sensitivity = replace(sensitivity, shape_hessian=sensitivity.shape_hessian * np.float32(1e-8), view_uncertainty=0.5)
    errors = []
    for quality_offset_db in (0.0, -12.0):
        result = encode_rd(splats, sensitivity, quality_offset_db=quality_offset_db, prune_threshold_bits=0)
        errors.append(np.array([max(result.errors[name]) for name in ("opacities", "scales")]))
    assert (errors[0] <= [VIRTUAL["opacities"] + 1e-4, VIRTUAL["scales"] + 1e-4]).all()
    assert (errors[1] <= [CAPTURED["opacities"] + 1e-4, CAPTURED["scales"] + 1e-4]).all()
    assert (errors[1] > 1.2 * errors[0]).all()
