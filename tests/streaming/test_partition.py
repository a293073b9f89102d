"""Partition. Oracle: each position compared with the cuts on its way, and the counts of a direct assignment."""

import itertools

import numpy as np
import pytest

from kissgs.core.positions import Cuts
from kissgs.core.splats import sampled_rows
from kissgs.streaming.levels import chunk_depth, leaf_groups


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
    ("count", "chunk", "depth"), [(0, 100, 0), (100, 100, 0), (101, 100, 1), (800, 100, 3), (801, 100, 4)]
)
def test_depth(count, chunk, depth):
    assert chunk_depth(count, chunk) == depth


@pytest.mark.parametrize("count", [1, 7, 64, 65, 1000])
def test_leaves_hold_every_gaussian_once(count):
    order, edges = leaf_groups(positions(count), 64)
    assert sorted(order.tolist()) == list(range(count))
    assert (np.diff(edges) <= 64).all()
    assert edges[0] == 0
    assert edges[-1] == count
    assert all((np.diff(order[a:b]) > 0).all() for a, b in itertools.pairwise(edges))
