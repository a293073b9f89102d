"""Oracle: the defining property of a Hilbert curve (unit steps through every cell), and exact integer formulas."""

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.errors import UnsupportedError
from kissgs.core.resources import blas_workers
from kissgs.core.splats import MAX_GRID_SIDE
from kissgs.planning.layout import grid_side, hilbert_order, layout_grid
from kissgs.settings import EncodeSettings, Settings


def walk(levels):
    """The positions in the order of the curve."""
    return levels[hilbert_order(levels)].astype(np.int64)


@pytest.mark.parametrize("bits", [1, 2, 3, 4])
def test_the_curve_steps_through_every_cell_of_a_grid_to_a_neighbour(bits):
    """A Hilbert curve of 16 bits looks, from far, like one of the top bits: each coarse cell once, by unit steps."""
    side = 1 << bits
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(0)
    path = walk((rng.permutation(cells) << (16 - bits)).astype(np.uint16)) >> (16 - bits)
    assert (path[0] == 0).all()
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()
    assert len(np.unique(path, axis=0)) == side**3


@pytest.mark.parametrize("corner", [0, 40_000, 65_528])
def test_the_curve_steps_to_neighbours_on_the_finest_level(corner):
    """Within an aligned block of 8 x 8 x 8 cells the curve stays until it has seen all, also at the last bits."""
    block = corner // 8 * 8 + np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    path = walk(block.astype(np.uint16))
    assert (np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()


def test_gaussians_in_one_cell_keep_their_order():
    levels = np.repeat(np.array([[9, 9, 9], [1, 2, 3], [9, 9, 9]], np.uint16), 50, axis=0)
    order = hilbert_order(levels)
    first = (levels == 9).all(axis=1)
    assert (np.diff(order[first[order]]) > 0).all()
    assert (np.diff(order[~first[order]]) > 0).all()
    assert hilbert_order(np.empty((0, 3), np.uint16)).shape == (0,)


@examples(200)
@given(st.integers(0, MAX_GRID_SIDE**2))
def test_the_grid_is_the_smallest_multiple_of_eight_that_holds_all(count):
    side = grid_side(count)
    assert side % 8 == 0
    assert side >= 8
    assert side * side >= count
    assert side == 8 or (side - 8) ** 2 < count


def test_grid_sides_of_the_published_containers():
    known = {8: 96, 32: 184, 128: 360, 256: 512, 512: 720, 1024: 1016, 2048: 1432}
    assert {thousands: grid_side(1000 * thousands) for thousands in known} == known


@pytest.mark.parametrize("count", [MAX_GRID_SIDE**2 + 1, 10**18, 2**62])
def test_scenes_too_large_for_one_image_are_refused_before_memory_is_taken(count):
    with pytest.raises(UnsupportedError, match=f"{count} Gaussians do not fit into one container; at most 178917376"):
        grid_side(count)


def placed(splats, kept, order):
    settings = Settings.from_preset("paper").encode if order == "plas" else EncodeSettings()
    with blas_workers(2) as pool:
        return layout_grid(splats.means, kept, 16, settings, pool, lambda fraction: None)


@pytest.mark.parametrize("order", ["hilbert", "plas"])
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 500])
def test_every_gaussian_gets_one_cell_and_padding_repeats_some(count, order):
    splats = random_scene(max(2 * count, 1), 0, seed=count)
    kept = np.arange(count) * 2  # every other one
    grid = placed(splats, kept, order)
    assert grid.side == grid_side(count)
    assert grid.mask.sum() == count
    assert sorted(grid.cells[grid.mask]) == kept.tolist()
    if count:
        assert set(grid.cells[~grid.mask]) <= set(kept)
        assert (grid.cells[grid.mask][grid.cell_to_gaussian] == grid.cells).all()


@pytest.mark.parametrize("order", ["hilbert", "plas"])
def test_neighbours_on_the_grid_are_near_in_space(order):
    splats = random_scene(1024, 0, seed=2)
    splats.means[:] = np.random.default_rng(3).random((1024, 3))
    grid = placed(splats, np.arange(1024), order)
    table = splats.means[grid.cells].reshape(32, 32, 3)
    sideways = np.linalg.norm(np.diff(table, axis=1), axis=2).mean()
    assert sideways < 0.5 * 0.66, "two random points of a unit cube are 0.66 apart"


@pytest.mark.parametrize("order", ["plas", "hilbert"])
def test_padding_can_be_moved_to_the_end(order):
    means = np.random.default_rng(5).normal(size=(150, 3)).astype(np.float32)
    settings = EncodeSettings(order=order)
    with blas_workers(1) as pool:
        grid = layout_grid(means, np.arange(150), 16, settings, pool, lambda fraction: None)
    moved = grid.with_padding_last()
    assert (moved.mask == (np.arange(len(moved.mask)) < 150)).all()
    assert sorted(moved.cells[:150]) == list(range(150))
    assert (moved.cells[150:] == moved.cells[149]).all()
    assert (moved.cells == moved.cells[:150][moved.cell_to_gaussian]).all()
    unmoved = grid.mask[:150]
    assert (moved.cells[:150][unmoved] == grid.cells[:150][unmoved]).all()
