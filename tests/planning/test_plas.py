"""Oracle: brute force over all 24 permutations (itertools), over neighbour distances, and a direct box filter."""

import itertools

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.context import blas_workers
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


@pytest.mark.parametrize("side", [8, 16, 40])
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
    assert (one != other).any()


def test_a_small_start_radius_keeps_what_is_good_already():
    """A first arrangement that is ordered from afar stays so: no item moves across the grid."""
    line = np.linspace(0, 1, 64, dtype=np.float32)
    smooth = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    noisy = smooth + np.random.default_rng(2).normal(0, 0.02, smooth.shape).astype(np.float32)
    placed = sort(noisy, start_radius=2)
    moved = np.abs(np.stack(np.divmod(placed, 64)) - np.stack(np.divmod(np.arange(4096), 64))).max()
    assert moved <= 16
    assert roughness(noisy, placed) < roughness(noisy, np.arange(4096))


def test_items_that_are_all_alike_and_what_progress_raises():
    def stop(fraction):
        raise KeyboardInterrupt

    alike = np.zeros((64, 1), np.float32)  # zero distances once meant 0/0 in an improvement ratio
    assert sorted(sort(alike)) == list(range(64))
    with pytest.raises(KeyboardInterrupt):
        sort(alike, report=stop)


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
    before = image.copy()
    with blas_workers(2) as pool:
        found = box_blur(image, radius, pool)
    assert (image == before).all()
    np.testing.assert_allclose(found, wanted, rtol=1e-5)
    assert found.dtype == np.float32
