"""Classes and pruning of Gaussians by their costs. Oracle: counts and products written by hand."""

from dataclasses import replace

import numpy as np
from helpers.codec_scenes import random_scene
from helpers.random_sensitivity import encode_rd, random_sensitivity

from kissgs.planning.rd_criterion import Costs


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
