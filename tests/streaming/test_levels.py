"""Partition and errors of levels. Oracles: each position compared with the cuts on its way; leaves of known images."""

import itertools

import numpy as np
import pytest
from helpers.render_scenes import blobs, one

from kissgs.core.positions import Cuts
from kissgs.core.splats import sampled_rows
from kissgs.streaming.levels import SIZE, halvings, leaf_groups, level_errors


def positions(count, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * [10, 1, 0.1] + [1e3, 0, 0]).astype(np.float32)


@pytest.mark.parametrize("depth", [0, 5])
def test_chunks_have_about_equal_counts(depth):
    means = positions(5000)
    chunks = Cuts.of(means, depth).chunk_of(means)
    counts = np.bincount(chunks, minlength=1 << depth)
    assert counts.sum() == 5000
    assert counts.max() - counts.min() <= 2 + depth


def test_a_chunk_is_found_by_the_cuts_on_the_way():
    means = positions(3000)
    cuts = Cuts.of(means[::7], 4)
    for mean, chunk in zip(means, cuts.chunk_of(means), strict=True):
        node = 1
        while node < 16:
            node = 2 * node + int(mean[cuts.axes[node]] >= cuts.values[node])
        assert chunk == node - 16


@pytest.mark.parametrize("sizes", [(10,), (3, 1, 6), (1,) * 9])
def test_a_sample_has_every_kth_position_whatever_the_blocks(sizes, monkeypatch):
    monkeypatch.setattr("kissgs.core.splats.SAMPLED", 4)
    means = positions(sum(sizes))
    blocks = np.split(means, np.cumsum(sizes)[:-1])
    found = sampled_rows(blocks, sum(sizes))
    stride = -(-sum(sizes) // 4)
    assert (found == means[::stride]).all()


@pytest.mark.parametrize(
    ("count", "most", "times"), [(0, 100, 0), (100, 100, 0), (101, 100, 1), (800, 100, 3), (801, 100, 4)]
)
def test_halvings(count, most, times):
    assert halvings(count, most) == times


@pytest.mark.parametrize("count", [1, 7, 64, 65, 1000])
def test_leaves_hold_every_gaussian_once(count):
    order, edges = leaf_groups(positions(count), 64)
    assert sorted(order.tolist()) == list(range(count))
    assert (np.diff(edges) <= 64).all()
    assert edges[0] == 0
    assert edges[-1] == count
    assert all((np.diff(order[a:b]) > 0).all() for a, b in itertools.pairwise(edges))


def test_equal_levels_have_no_error():
    leaf = blobs(50)
    assert level_errors([leaf, leaf.select(np.arange(49, -1, -1)), leaf]) == [0, 0, 0]


def test_a_ball_in_front_of_grey():
    """An opaque ball of one colour, and one of another: the error is the difference times the ball's share."""
    size = -2.0
    ball = one(scale=(size,) * 3, opacity=20.0, sh0=(1.7724539,) * 3)  # white
    grey = one(scale=(size,) * 3, opacity=20.0, sh0=(0, 0, 0))  # as the background: no error but the white ball's
    found = level_errors([ball, grey])[1]
    pixels = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    squared = (pixels[:, None] ** 2 + pixels[None, :] ** 2) * 4  # the radius of the leaf is two standard deviations
    assert found == pytest.approx(0.5 * np.sqrt(np.mean(np.exp(-0.5 * squared) ** 2)), rel=0.03)


def test_a_coarser_level_never_has_a_smaller_error():
    leaf = blobs(60)
    errors = level_errors([leaf, leaf.select(np.arange(10)), leaf.select(np.arange(40))])
    assert 0 < errors[1] == errors[2]
