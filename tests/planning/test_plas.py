"""Oracle: brute force over all 24 permutations (itertools), over neighbour distances, and a direct box filter."""

import itertools

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.resources import blas_workers
from kissgs.planning import kernels
from kissgs.planning.layout import box_blur, plas


def sort(items, threads=1, **options):
    with blas_workers(threads) as pool:
        return plas(items, pool, **{"seed": 0, "decay": 0.8, **options})


def roughness(items, placed):
    """Mean distance of neighbours, right and below."""
    side = int(len(items) ** 0.5)
    table = items[placed].reshape(side, side, -1)
    return sum(np.linalg.norm(np.diff(table, axis=axis), axis=2).mean() for axis in (0, 1))


@pytest.mark.parametrize("side", [8, 16, 40, 56])
def test_a_permutation_that_is_smoother_than_before(side):
    items = np.random.default_rng(side).random((side * side, 3), np.float32)
    placed = sort(items)
    assert sorted(placed) == list(range(side * side))
    assert roughness(items, placed) < (0.65 if side == 8 else 0.5) * roughness(items, np.arange(side * side))


def test_a_scrambled_gradient_is_found_again():
    """A grid that is smooth by construction, shuffled: the sorted one must be nearly as smooth as the original."""
    line = np.linspace(0, 1, 32, dtype=np.float32)
    smooth = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    shuffled = smooth[np.random.default_rng(0).permutation(1024)]
    best, start = roughness(smooth, np.arange(1024)), roughness(shuffled, np.arange(1024))
    assert roughness(shuffled, sort(shuffled, decay=0.95)) < best + 0.1 * (start - best)


def test_threads_do_not_matter_and_seeds_do():
    items = np.random.default_rng(1).random((48 * 48, 4), np.float32)
    one, many, other = sort(items), sort(items, threads=3), sort(items, seed=1)
    assert (one == many).all()
    assert (one == sort(items)).all()
    assert (one != other).any()


@pytest.mark.parametrize("items", [np.zeros((64, 3), np.float32), np.full((256, 1), -7, np.float32)])
def test_items_that_are_all_alike_are_no_trouble(items):
    """Zero distances once meant 0/0 in the improvement ratio of the public implementation."""
    assert sorted(sort(items)) == list(range(len(items)))


def test_a_small_start_radius_keeps_what_is_good_already():
    """A first arrangement that is ordered from afar stays so: no item moves across the grid."""
    line = np.linspace(0, 1, 64, dtype=np.float32)
    smooth = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    noisy = smooth + np.random.default_rng(2).normal(0, 0.02, smooth.shape).astype(np.float32)
    placed = sort(noisy, start_radius=2)
    moved = np.abs(np.stack(np.divmod(placed, 64)) - np.stack(np.divmod(np.arange(4096), 64))).max()
    assert moved <= 16
    assert roughness(noisy, placed) < roughness(noisy, np.arange(4096))


def test_what_progress_raises_stops_the_work():
    def stop(fraction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sort(np.zeros((64, 1), np.float32), report=stop)


@examples(100)
@given(st.integers(0, 10**6), st.integers(1, 6))
def test_groups_of_four_get_the_cheapest_of_24_permutations(seed, channels):
    rng = np.random.default_rng(seed)
    items, target = (rng.normal(size=(9, channels)).astype(np.float32) for _ in range(2))
    placed, cells = rng.permutation(9).astype(np.int32), rng.permutation(9)[:4].astype(np.int32)
    before, score = placed.copy(), np.zeros(2)
    kernels._sort_four(items, placed, target, cells, score)

    def cost(group):
        return np.square(items[list(group)].astype(np.float64) - target[cells]).sum()

    untouched = np.setdiff1d(np.arange(9), cells)
    assert (placed[untouched] == before[untouched]).all()
    assert sorted(placed) == list(range(9))
    least = min(cost(group) for group in itertools.permutations(before[cells]))
    np.testing.assert_allclose(cost(placed[cells]), least, rtol=1e-5)
    gained = cost(before[cells]) - cost(placed[cells])
    np.testing.assert_allclose(2 * (score[1] - score[0]), gained, atol=1e-4)


@pytest.mark.parametrize(
    ("side", "size", "shift"), [(16, 8, (0, 0)), (16, 8, (5, 11)), (24, 10, (9, 3)), (8, 8, (7, 1))]
)
def test_blocks_report_what_they_gain_and_leave_the_strip_alone(side, size, shift):
    """A tiling shifted on the torus; what does not fill a block stays. The sum of squared distances is recomputed."""
    rng = np.random.default_rng(side + size)
    items, target = (rng.random((side * side, 3), np.float32) for _ in range(2))
    placed = rng.permutation(side * side).astype(np.int32)
    before = placed.copy()
    per_row = side // size
    tiling = np.array([side, *shift, size, 0, per_row**2])
    gained = kernels.plas_blocks(items, placed, target, tiling, np.uint64(3), 1e-4)
    costs = [np.square(items[order].astype(np.float64) - target).sum() for order in (before, placed)]
    np.testing.assert_allclose(gained, costs[0] - costs[1], rtol=1e-4)
    assert gained > 0
    rows, columns = np.divmod(np.arange(side * side), side)
    reach = per_row * size
    inside = ((rows - shift[0]) % side < reach) & ((columns - shift[1]) % side < reach)
    assert (placed[~inside] == before[~inside]).all()
    assert sorted(placed) == list(range(side * side))


def blurred(image, radius):
    """Mean over a square, by looking up every pixel: sideways modulo the width, up and down as in a mirror."""
    height, width, _ = image.shape
    wide = np.pad(image.astype(np.float64), ((radius, radius), (0, 0), (0, 0)), mode="reflect")
    wide = np.pad(wide, ((0, 0), (radius, radius), (0, 0)), mode="wrap")
    size = 2 * radius + 1
    return np.array([[wide[y : y + size, x : x + size].mean(axis=(0, 1)) for x in range(width)] for y in range(height)])


@pytest.mark.parametrize(("side", "radius", "channels"), [(8, 1, 1), (8, 3, 4), (9, 4, 7), (16, 7, 3), (24, 5, 4)])
def test_the_filter_is_a_box_that_wraps_sideways_and_mirrors_up_and_down(side, radius, channels):
    image = np.random.default_rng(side).random((side, side, channels), np.float32)
    wanted = blurred(image, radius)
    with blas_workers(2) as pool:
        found = box_blur(image, radius, pool)
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert found.dtype == np.float32


@pytest.mark.parametrize("channels", [1, 4, 5])
def test_the_filter_leaves_its_input_alone(channels):
    """Up to four channels are one task, whose part of the image once was the image itself: it was written into."""
    image = np.random.default_rng(0).random((8, 8, channels), np.float32)
    before = image.copy()
    with blas_workers(1) as pool:
        box_blur(image, 2, pool)
    assert (image == before).all()
