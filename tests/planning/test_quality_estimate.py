"""Classes and pruning of Gaussians by costs, the default quality, the lambda for an error. Oracle: sums by hand."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.random_sensitivity import encode_rd, random_sensitivity

from kissgs.planning.planner import MIN_ERROR_RATIO, ErrorModel, default_error
from kissgs.planning.rd_fields import Costs
from kissgs.planning.sh_codebook import CodebookErrorModel


def test_lambda_for_gives_the_requested_error():
    splats = random_scene(4000, 3, seed=1)
    sh_model = CodebookErrorModel(1024, 1e-6, 2e-6)
    model = ErrorModel(Costs.of(random_sensitivity(splats), splats), sh_model, 10, 0.2)
    least = model.error_at(1e-22)  # what the largest codebook leaves
    for error, wanted in ((1e-6, 1e-6), (1e-4, 1e-4), (least / 100, MIN_ERROR_RATIO * least)):
        np.testing.assert_allclose(model.error_at(model.lambda_for(error)), wanted, rtol=0.05)
    sizes = [sh_model.best_size(rd_lambda, 100_000) for rd_lambda in (1e-14, 1e-12, 1e-10)]
    assert sizes == sorted(sizes, reverse=True)
    assert sh_model.best_size(1e-20, 6000) == 6000  # an entry for each


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


def test_what_is_dropped_is_worth_least_and_never_more_than_half():
    splats = random_scene(101, 0, seed=3)
    costs = Costs.of(random_sensitivity(splats), splats)
    ranked = np.argsort(costs.removal)
    for rd_lambda, count in ((0.0, 0), (float(costs.removal[ranked[10]]) / 7, 10), (1e9, 50)):
        dropped = costs.pruned_by_rd(rd_lambda, 7)
        assert sorted(np.flatnonzero(dropped)) == sorted(ranked[:count])


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
