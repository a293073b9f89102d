"""Pruning, bounds of rounding and the default quality; the oracles are sums written by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.random_sensitivity import encode_rd, random_sensitivity

import kissgs
from kissgs.planning.rd_model import CodebookErrorModel, Costs, default_error
from kissgs.planning.rdo_quantize import CAPTURED, UNSEEN, VIRTUAL, largest_changes


def costs_of(removal, coverage):
    """Costs of which only these two count."""
    none = {name: np.ones(len(removal)) for name in ("opacity", "scale", "rotation", "color", "position")}
    return Costs(removal=np.array(removal, float), coverage=np.array(coverage, float), **none)


def test_unseen_gaussians_are_kept_up_to_the_default_lambda():
    removal, coverage = np.tile([1e-9, 1e-3], 10), np.repeat([0.0, 0.09, 0.11, 1.0], 5)
    costs = costs_of(removal, coverage)
    for rd_lambda in (1e-9, 1e-6, 2e-6):
        dropped = costs.pruned_by_rd(rd_lambda, 10, 2e-6)
        np.testing.assert_array_equal(dropped, (removal < 10 * rd_lambda) & (coverage > 0.1))
    # Without a default lambda, all Gaussians are treated alike.
    np.testing.assert_array_equal(costs.pruned_by_rd(2e-6, 10), removal < 1e-4)


def test_beyond_the_default_lambda_its_excess_prunes_the_unseen():
    removal, coverage = np.array([1e-5, 4e-5, 1e-5, 4e-5, 1, 1, 1, 1]), np.array([0, 0, 1, 1, 0, 0, 1, 1])
    costs = costs_of(removal, coverage)
    found = [
        np.flatnonzero(costs.pruned_by_rd(rd_lambda, 10, 2e-6)).tolist() for rd_lambda in (2e-6, 3.1e-6, 4.1e-6, 6.1e-6)
    ]
    #       10 bits are worth 2e-5, 3.1e-5, ...; of the unseen, 2e-5 less
    assert found == [[2], [0, 2], [0, 2, 3], [0, 1, 2, 3]]


def test_largest_changes_follow_who_has_looked_at_each():
    """Nobody, a virtual camera, one of a capture; between them by the logarithm."""
    coverage, captured = np.array([0.0, 1.0, 1.0, 0.5, 1.0]), np.array([0.0, 0.0, 1.0, 0.0, 0.5])
    found = largest_changes(coverage, captured, 1.0)
    for name, changes in found.items():
        ends = np.array([UNSEEN[name], VIRTUAL[name], CAPTURED[name]])
        between = np.sqrt(ends[:-1] * ends[1:])
        np.testing.assert_allclose(changes, [*ends, *between])
        assert (np.diff(ends) > 0).all()
    fast = kissgs.EncodeSettings()
    steps = (fast.opacity_step, fast.scale_step, fast.scale_step, fast.quat_step, fast.sh0_step)
    assert tuple(UNSEEN.values()) == steps


def test_largest_changes_grow_with_slack_up_to_those_of_a_capture():
    some = np.array([0.0, 0.7])
    for name, most in CAPTURED.items():
        each = np.stack([largest_changes(some, 0 * some, slack)[name] for slack in (1.0, 8.0, 1e9)])
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


def test_slack_lets_changes_of_a_scene_grow_up_to_the_wide_limit():
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


def spoiled(splats, name, far):
    """One Gaussian far out, and otherwise the same."""
    values = getattr(splats, name).copy()
    values[0] += np.float32(far)
    return replace(splats, **{name: values})


@pytest.mark.parametrize("name", ["scales", "sh0", "opacities"])
def test_one_outlier_does_not_spoil_the_quality_that_is_aimed_at(name):
    """However far out it is: the paper's levels lie farther and farther apart, the steps of ``fast`` do not."""
    splats = random_scene(3000, 0, seed=2)
    costs, kept = Costs.of(random_sensitivity(splats), splats), np.arange(3000)
    costs = replace(costs, position=np.zeros(3000))
    scenes = [splats, *(spoiled(splats, name, far) for far in (600, 6000, 60000))]
    usual, *found = (default_error(costs, scene, kept, CodebookErrorModel()) for scene in scenes)
    steps = {"opacity": 0.15, "scale": 0.11 * 3**0.5, "rotation": 2 * 0.023 * 3**0.5, "color": 0.055 * 3**0.5}
    fast = sum(float(getattr(costs, of).sum()) * step**2 / 12 for of, step in steps.items())
    np.testing.assert_allclose(found, fast, rtol=1e-6)
    assert usual <= fast


def test_the_quality_aimed_at_is_the_papers_where_its_steps_are_finer():
    """Opacities alone count: 256 levels over their extent, or a step of 0.15."""
    splats = random_scene(500, 0, seed=3)
    kept, count = np.arange(500), 500
    no_cost = {name: np.zeros(count) for name in ("scale", "rotation", "color", "position")}
    costs = Costs(opacity=np.full(count, 1e-6), removal=np.ones(count), coverage=np.ones(count), **no_cost)
    for extent in (10.0, 100.0):
        scene = replace(splats, opacities=np.linspace(0, extent, count, dtype=np.float32))
        step = min(extent / 255, 0.15)
        wanted = count * 1e-6 * step**2 / 12
        np.testing.assert_allclose(default_error(costs, scene, kept, CodebookErrorModel()), wanted, rtol=1e-5)


def faint(count):
    """Gaussians of which hardly anything shows, though any renderer draws them."""
    scene = kissgs.sample_scene(count, seed=5)
    return replace(scene, opacities=np.full(count, -5.3, np.float32), scales=scene.scales - np.float32(2))


@pytest.mark.parametrize(("superfluous", "many"), [(0, False), (1500, True)])
def test_many_gaussians_that_were_dropped_are_noted_in_the_report(superfluous, many):
    scene = kissgs.sample_scene(2000, seed=1)
    if superfluous:
        more = faint(superfluous)
        scene = kissgs.Splats(
            **{name: np.concatenate([getattr(scene, name), getattr(more, name)]) for name in kissgs.Splats.__slots__}
        )
    settings = kissgs.Settings.from_preset("balanced", sensitivity_views=8, sensitivity_view_size=96)
    report = kissgs.compress(scene, settings=settings).report
    assert (report.pruned_by_rd > 0.2 * len(scene)) == many
    assert bool(report.note) == many
    if many:
        drawn = len(scene) - report.invisible
        assert report.note.startswith(f"{report.pruned_by_rd:,} of {drawn:,} Gaussians were pruned")


@pytest.mark.quick(0)
def test_an_enormous_coefficient_does_not_change_what_is_kept():
    """Brighter than a display shows is no reason to give up on others: a Gaussian in a hundred at most is chosen
    otherwise, at the border of what is worth its bytes."""
    plain = kissgs.sample_scene(4000, seed=3)
    shN = plain.shN.copy()
    shN[::800, 4, 1] = 1e5
    settings = kissgs.Settings.from_preset("balanced", sensitivity_views=12, sensitivity_view_size=128)
    usual, found = (
        set(kissgs.compress(scene, settings=settings).order.tolist()) for scene in (plain, replace(plain, shN=shN))
    )
    assert len(usual ^ found) < 0.01 * len(plain)


def test_rounding_a_gaussian_costs_at_most_twice_its_removal():
    """A few long, thin ones, whose Hessians grow without bound, do not decide the quality that is aimed at."""
    splats = replace(random_scene(500, 0, seed=3), opacities=np.linspace(0, 10, 500, dtype=np.float32))
    opacity, removal = np.full(500, 1e-6), np.full(500, 1e-3)
    opacity[:3], removal[:2] = 1e6, 2e-9
    nothing = {name: np.zeros(500) for name in ("scale", "rotation", "color", "position")}
    costs = Costs(opacity=opacity, removal=removal, coverage=np.ones(500), **nothing)
    wanted = 2 * 4e-9 + 2e-3 + 497 * 1e-6 * (10 / 255) ** 2 / 12
    found = default_error(costs, splats, np.arange(500), CodebookErrorModel())
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
