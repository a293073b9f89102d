"""Orders and grids. Oracles: unit steps of a Hilbert curve through every cell, exact formulas; orders sorted by
group."""

from itertools import pairwise

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.examples import examples
from helpers.random_sensitivity import random_sensitivity
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs.core.context import blas_workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import MAX_GRID_SIDE
from kissgs.io.containers import zip_bytes
from kissgs.planning import planner
from kissgs.planning.layout import axes_order, grid_side, hilbert_order, layout_grid, principal_axes
from kissgs.planning.planner import plan_encoding
from kissgs.settings import EncodeSettings, Settings
from kissgs.sog.encode import SOG, write_files


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


@pytest.mark.parametrize("count", [MAX_GRID_SIDE**2 + 1, 10**18, 2**62])
def test_scenes_too_large_for_one_image_are_refused_before_memory_is_taken(count):
    with pytest.raises(UnsupportedError, match=f"{count} Gaussians do not fit into one container; at most 178917376"):
        grid_side(count)


def placed(means, kept, order):
    settings = Settings.from_preset("paper").encode if order == "plas" else EncodeSettings()
    with blas_workers(2) as pool:
        return layout_grid(means, kept, 16, settings, pool, lambda fraction: None)


@pytest.mark.parametrize("order", ["hilbert", "plas"])
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 500])
def test_every_gaussian_gets_one_cell_and_padding_repeats_one(count, order):
    """Padding can be moved to the end, where few others move."""
    kept = np.arange(count) * 2  # every other one
    grid = placed(random_scene(max(2 * count, 1), 0, seed=count).means, kept, order)
    assert grid.side == grid_side(count)
    assert grid.mask.sum() == count
    assert sorted(grid.cells[grid.mask]) == kept.tolist()
    if count == 0:
        return
    assert set(grid.cells[~grid.mask]) <= set(kept)
    assert len(set(grid.cells[~grid.mask])) <= 1
    assert (grid.cells[grid.mask][grid.cell_to_gaussian] == grid.cells).all()
    moved, unmoved = grid.with_padding_last(), grid.mask[:count]
    assert (moved.mask == (np.arange(len(moved.mask)) < count)).all()
    assert sorted(moved.cells[:count]) == kept.tolist()
    assert (moved.cells[count:] == moved.cells[count - 1]).all()
    assert (moved.cells == moved.cells[:count][moved.cell_to_gaussian]).all()
    assert (moved.cells[:count][unmoved] == grid.cells[:count][unmoved]).all()


@pytest.mark.parametrize("order", ["hilbert", "plas"])
def test_neighbours_on_the_grid_are_near_in_space(order):
    means = np.random.default_rng(3).random((1024, 3), np.float32)
    table = means[placed(means, np.arange(1024), order).cells].reshape(32, 32, 3)
    sideways = np.linalg.norm(np.diff(table, axis=1), axis=2).mean()
    assert sideways < 0.5 * 0.66, "two random points of a unit cube are 0.66 apart"


def test_bands_blocks_rows_and_columns_follow_the_axes():
    coordinates = np.random.default_rng(0).normal(size=(24 * 24, 6)).astype(np.float32)
    order = axes_order(coordinates)
    assert sorted(order) == list(range(24 * 24))
    table = coordinates[order].reshape(24, 24, 6)
    bands = table[..., 0].reshape(3, -1)
    assert (bands[:-1].max(axis=1) <= bands[1:].min(axis=1)).all()
    for top in range(0, 24, 8):
        blocks = [table[top : top + 8, left : left + 8] for left in range(0, 24, 8)]
        for left, right in pairwise(blocks):
            assert left[..., 1].max() <= right[..., 1].min()
        for block in blocks:
            assert (block[:-1, :, 2].max(axis=1) <= block[1:, :, 2].min(axis=1)).all()
            assert (np.diff(block[..., 3], axis=1) >= 0).all()


@pytest.mark.parametrize("dimensions", [1, 3])
def test_few_dimensions_still_give_a_permutation(dimensions):
    vectors = np.random.default_rng(2).normal(size=(256, dimensions)).astype(np.float32)
    assert sorted(axes_order(principal_axes(vectors, 4))) == list(range(256))


def test_coordinates_are_those_of_the_largest_variances():
    rng = np.random.default_rng(3)
    vectors = (rng.normal(size=(500, 5)) @ rng.normal(size=(5, 5)) + 100).astype(np.float32)
    values = np.linalg.eigvalsh(np.cov(vectors.T.astype(np.float64), bias=True))[::-1]
    coordinates = principal_axes(vectors, 3)
    assert coordinates.shape == (500, 3)
    np.testing.assert_allclose(coordinates.mean(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose(np.cov(coordinates.T, bias=True), np.diag(values[:3]), atol=1e-3)


SCENE = kissgs.clean(random_scene(600, 1))[0]
GROUPS = np.random.default_rng(0).integers(0, 7, 600).astype(np.uint16)


def order_of(settings, sensitivity, groups):
    plan = plan_encoding(SCENE, settings, sensitivity=sensitivity, container=SOG, groups=groups)
    return write_files(plan, settings)


@pytest.mark.parametrize(("classes", "order"), [(None, "hilbert"), (1, "refined"), (3, "hilbert"), (3, "refined")])
def test_groups_follow_one_another(classes, order):
    """Without sensitivity, and with one or several classes of steps inside each group."""
    settings, sensitivity = Settings.research("fast", order=order).encode, None
    if classes is not None:
        settings = Settings.research("balanced", order=order, step_classes=classes, prune_threshold_bits=0).encode
        sensitivity = random_sensitivity(SCENE)
    encoded = order_of(settings, sensitivity, GROUPS)
    assert (np.diff(GROUPS[encoded.order].astype(int)) >= 0).all()
    assert len(np.unique(encoded.order)) == len(encoded.order)
    decoded = kissgs.decompress(zip_bytes(encoded.files))
    np.testing.assert_allclose(decoded.means, SCENE.means[encoded.order], atol=0.1 * np.ptp(SCENE.means))
    alone = order_of(settings, sensitivity, None)
    assert not (np.diff(GROUPS[alone.order].astype(int)) >= 0).all()
    same = order_of(settings, sensitivity, np.zeros(600, np.uint16))
    assert same.files == alone.files


def test_other_orders_and_too_many_groups_are_refused():
    plas = Settings.research("fast", order="plas").encode
    with pytest.raises(UnsupportedError, match="order=hilbert"):
        order_of(plas, None, GROUPS)
    many = GROUPS.copy()
    many[3] = planner.MAX_GROUPS
    with pytest.raises(UnsupportedError, match="up to 16,384 groups"):
        order_of(Settings.from_preset("fast").encode, None, many)
