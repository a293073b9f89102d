"""Work in blocks of rows: the same results as on whole arrays, at every border of a block and for any threads."""

import numpy as np
import pytest
from helpers.codec_scenes import random_scene

from kissgs.core.context import Workers, silent
from kissgs.planning.quantize import (
    BLOCK,
    EVEN_LEVELS,
    Planning,
    for_each_block,
    means_bits,
    quantize,
    quantize_means,
    selected,
    sorted_order,
)
from kissgs.planning.rd_fields import Costs, level_bits
from kissgs.planning.rotation_forms import PERMUTATIONS, ROTATIONS, choose_forms
from kissgs.settings import Settings
from kissgs.sog.encode import SOG

BORDERS = (1, 7, 8, 9, BLOCK - 1, BLOCK, BLOCK + 1, 3 * BLOCK)


@pytest.mark.parametrize("count", [0, *BORDERS])
def test_blocks_cover_every_row_once_and_in_order(count):
    with Workers(3) as pool:
        found = for_each_block(count, lambda rows: np.arange(count)[rows], pool)
    np.testing.assert_array_equal(np.concatenate([*found, np.empty(0, int)]), np.arange(count))
    assert all(0 < len(rows) <= BLOCK for rows in found)


@pytest.mark.parametrize("count", [0, *BORDERS])
@pytest.mark.parametrize("bits", [24, 48, 64])
def test_sorting_is_that_of_numpy_and_stable(count, bits):
    rng = np.random.default_rng(count)
    keys = rng.integers(0, 1 << bits, count, dtype=np.uint64, endpoint=False) if bits < 64 else rng.bytes(8 * count)
    keys = np.frombuffer(keys, np.uint64).copy() if bits == 64 else keys
    keys[rng.random(count) < 0.5] &= np.uint64(3)  # many equal keys
    wanted = np.argsort(keys, kind="stable")
    ordered = keys[wanted]
    np.testing.assert_array_equal(sorted_order(keys, bits), wanted)
    np.testing.assert_array_equal(keys, ordered)


@pytest.mark.parametrize("count", BORDERS)
def test_quantising_rows_is_quantising_the_array(count):
    rng = np.random.default_rng(count)
    scene = rng.normal(size=(count + 5, 3)).astype(np.float32)
    index = rng.integers(0, len(scene), count).astype(np.int32)
    whole = scene[index]
    with Workers(3) as pool:
        for found, wanted in (
            (quantize(selected(scene, index), step=0.05, pool=pool), whole),
            (quantize_means(selected(scene, index), bits=12, pool=pool), np.sign(whole) * np.log1p(np.abs(whole))),
        ):
            half = (found.high.astype(float) - found.low).max() / found.top / 2
            stride = found.level_stride if isinstance(found.level_stride, int) else 1
            assert np.abs(found.values() - wanted).max() <= 1.01 * half * stride + 1e-7


def test_each_gaussian_has_its_own_bits_across_blocks():
    rng = np.random.default_rng(1)
    means = rng.normal(size=(2 * BLOCK + 3, 3)).astype(np.float32)
    bits = rng.integers(8, 17, len(means)).astype(np.int8)
    found = quantize_means(means, bits=bits)
    stride = 1 << (16 - bits.astype(int))
    np.testing.assert_array_equal(found.level_stride, stride)
    inner = (means != means.max()).all(axis=1)
    assert (found.levels[inner] % stride[inner, None] == 0)[found.levels[inner] < 65535].all()
    assert found.levels.max() == 65535


@pytest.mark.parametrize("count", BORDERS)
def test_the_stored_form_is_the_largest_w_of_the_24_rotations(count):
    """Against the definition: all products in NumPy, the rotation matrix of the chosen one, permuted scales."""
    splats = random_scene(count, 0, seed=count)
    cells = np.random.default_rng(count).permutation(count).astype(np.int32)
    with Workers(2) as pool:
        shapes, error = choose_forms(splats, cells, 8, Planning(Settings().encode, SOG, pool, silent))
        free, _ = choose_forms(splats, cells, 8, Planning(Settings().encode, EVEN_LEVELS, pool, silent))
    quats = splats.quats[cells].astype(float)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    w = quats @ (ROTATIONS * (1, -1, -1, -1)).T
    stored = shapes[:]
    np.testing.assert_allclose(stored[:, 4], np.abs(w).max(axis=1), atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(stored[:, 4:], axis=1), 1, atol=1e-12)
    order = PERMUTATIONS[shapes.forms % 24]
    np.testing.assert_array_equal(stored[:, 1:4], np.take_along_axis(splats.scales[cells], order, axis=1))
    np.testing.assert_array_equal(stored[:, 0], splats.opacities[cells])
    assert error < 1e-12
    assert (free[:][:, 4] == 1).all(), "decoders normalise, so w takes no bits"
    np.testing.assert_allclose(free[:][:, 5:], stored[:, 5:] / stored[:, 4:5], atol=1e-12)
    np.testing.assert_array_equal(free[:][:, :4], stored[:, :4])


@pytest.mark.parametrize(("count", "tolerance"), [*((count, 0.04) for count in BORDERS), (BLOCK, 0.01), (BLOCK, 0.5)])
def test_precision_of_positions_follows_the_median_gaussian(count, tolerance):
    splats = random_scene(count, 0, seed=count)
    size = np.sort(splats.scales, axis=1)[:, 1:].mean(axis=1, dtype=float)
    allowed = tolerance * np.exp(np.median(size - np.log(1 + np.abs(splats.means).max(axis=1).astype(float))))
    extent = np.ptp(np.sign(splats.means) * np.log1p(np.abs(splats.means.astype(float))))
    wanted = int(np.clip(np.ceil(np.log2(max(extent / (2 * allowed), 1))), 8, 16))
    assert means_bits(splats, np.arange(count), tolerance) == wanted


@pytest.mark.parametrize("number", [1, 2, 3, 32])
def test_classes_are_ranks_and_one_place_has_one_class(number):
    rng = np.random.default_rng(number)
    count = BLOCK + 100
    costs = Costs(**{name: rng.lognormal(size=count) for name in Costs.__slots__})
    means = rng.integers(-9, 10, (count, 3)).astype(np.float32)  # many in one place
    means[rng.random(count) < 0.5] += rng.random(3).astype(np.float32)
    means[: count // 2] += rng.random((count // 2, 3)).astype(np.float32)  # and many alone
    worth = np.log(costs.scale) + np.log(costs.rotation) + np.log(costs.color)
    rank = np.empty(count, int)
    rank[np.argsort(-worth, kind="stable")] = np.arange(count)
    wanted = rank * number // count
    places = np.unique(means + 0, axis=0, return_inverse=True)[1]
    first = np.full(places.max() + 1, number)
    np.minimum.at(first, places, wanted)
    np.testing.assert_array_equal(costs.classes(number, means), np.unique(first[places], return_inverse=True)[1])


@pytest.mark.parametrize("count", [1, BLOCK, BLOCK + 1])
def test_bits_of_levels_are_counted_over_all_blocks(count):
    rng = np.random.default_rng(count)
    levels = rng.integers(0, 256, (count, 2)).astype(np.uint8)
    classes = rng.integers(0, 2, count).astype(np.uint8)
    classes[0] = 1
    found = level_bits(levels, classes)
    for label in range(2):
        for column in range(2):
            likely = np.bincount(levels[classes == label, column], minlength=256) + 0.05
            np.testing.assert_allclose(found[label, column], -np.log2(likely / likely.sum()), atol=1e-9)
