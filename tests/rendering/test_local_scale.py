"""Reference: a stable sort, which has only one result, and grids of known spacing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs import sample_scene
from kissgs.rendering.local_scale import _lower_half, local_scale


@given(st.lists(st.integers(-3, 3), min_size=2, max_size=60))
def test_of_equal_values_the_first_are_in_the_lower_half(values):
    """The choice among equal values is the same on every processor."""
    lower = np.flatnonzero(_lower_half(np.array(values, float)))
    assert lower.tolist() == sorted(np.argsort(values, kind="stable")[: len(values) // 2].tolist())


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
