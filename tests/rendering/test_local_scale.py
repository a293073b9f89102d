"""Reference: a stable sort, which has only one result, and grids of known spacing."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs import sample_scene
from kissgs.rendering.cpu.neighbours import leaves_of
from kissgs.rendering.sensitivity import local_scale


@given(st.lists(st.integers(-3, 3), min_size=0, max_size=60), st.integers(1, 8))
def test_a_part_is_split_at_its_median_and_the_first_of_equal_values_are_below_it(values, leaf):
    """The choice among equal values is the same on every processor."""
    points = np.zeros((len(values), 3), np.float32)
    points[:, 1] = values
    order, edges = leaves_of(points, leaf)

    def parts(members):
        if len(members) <= leaf:
            return [sorted(members)]
        ascending = sorted(members, key=lambda n: (values[n], n))
        return parts(ascending[: len(members) // 2]) + parts(ascending[len(members) // 2 :])

    assert [sorted(order[a:b].tolist()) for a, b in itertools.pairwise(edges)] == parts(range(len(values)))


@pytest.mark.parametrize("spacing", [1e-3, 1.0, 1e4])
def test_on_a_grid_it_is_the_same_number_of_spacings_at_any_scale(spacing):
    scene = sample_scene(4096)
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(64), [0], indexing="ij"), axis=-1).reshape(-1, 3)
    flat = replace(
        scene,
        means=(grid * spacing).astype(np.float32),
        scales=np.full((4096, 3), np.log(0.1 * spacing), np.float32),
    )
    found = local_scale(flat) / spacing
    assert 5 < np.median(found) < 14, "128 neighbours fill a disc of 6.4 spacings; in a corner more than twice as far"
