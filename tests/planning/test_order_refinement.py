"""Oracle: moves of the local search tried one by one in NumPy, and the decoded Gaussians as a set."""

import numpy as np
import pytest
from helpers.random_sensitivity import random_sensitivity

import kissgs
from kissgs import Settings
from kissgs.core.context import Workers
from kissgs.planning import kernels, layout
from kissgs.planning.layout import hilbert_order, refined_order
from kissgs.sogxt.encode import encode


def cost(pixels, bits, order):
    """Bits of all differences along an order."""
    steps = np.diff(pixels[order], axis=0)
    return sum(int(bits[channel, steps[:, channel]].sum()) for channel in range(pixels.shape[1]))


def symmetric_bits(rng, channels):
    bits = rng.integers(0, 5000, (channels, 256)).astype(np.int32)
    return bits + bits[:, -np.arange(256)]


def moved(order):
    """All orders that one reversal, or one move of up to three pixels, makes; both ends stay."""
    count = len(order)
    for first in range(1, count - 1):
        for last in range(first + 1, count - 1):
            yield np.concatenate([order[:first], order[first : last + 1][::-1], order[last + 1 :]])
        for length in (1, 2, 3):
            part, rest = order[first : first + length], np.delete(order, range(first, min(first + length, count)))
            if first + length < count:
                for place in range(1, len(rest)):
                    yield np.concatenate([rest[:place], part, rest[place:]])
                    yield np.concatenate([rest[:place], part[::-1], rest[place:]])


@pytest.mark.parametrize("count", [2, 3, 4, 5, 7, 8, 9, 24])
def test_no_single_move_makes_the_result_better(count):
    rng = np.random.default_rng(count)
    pixels = rng.integers(0, 256, (count, 4)).astype(np.uint8)
    bits = symmetric_bits(rng, 4)
    pairs = np.array([[cost(pixels, bits, np.array([a, b])) for b in range(count)] for a in range(count)])
    near = np.argsort(pairs + 10**8 * np.eye(count, dtype=int), axis=1, kind="stable").astype(np.int32)[:, : count - 1]
    order = np.arange(count, dtype=np.int32)
    kernels.improve(pixels, bits, np.ascontiguousarray(near), 1000, order)
    assert sorted(order) == list(range(count))
    assert (order[0], order[-1]) == (0, count - 1)
    best = cost(pixels, bits, order)
    assert best <= cost(pixels, bits, np.arange(count))
    assert all(cost(pixels, bits, other) >= best for other in moved(order))


def levels_along_a_curve(count, rng):
    means = np.cumsum(rng.integers(-900, 900, (count, 3)), axis=0).astype(np.uint16)
    means = means[hilbert_order(means)]
    return means, (means >> 8).astype(np.uint8) + rng.integers(0, 40, (count, 3)).astype(np.uint8)


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 63, 64, 65, 500, 20_000])
def test_gaussians_stay_in_their_run_and_differences_become_smaller(count):
    rng = np.random.default_rng(count)
    means, colors = levels_along_a_curve(count, rng)
    runs = np.sort(rng.integers(0, 3, count))
    with Workers(3) as pool:
        order = refined_order(means, colors, runs, pool)
    with Workers(1) as pool:
        np.testing.assert_array_equal(refined_order(means, colors, runs, pool), order)
    np.testing.assert_array_equal(np.sort(order), np.arange(count))
    np.testing.assert_array_equal(runs[order], runs)
    if count > 100:
        pixels = layout._pixels(means, colors)
        bits = layout._difference_bits(pixels)
        assert cost(pixels, bits, order) < 0.95 * cost(pixels, bits, np.arange(count))


def test_gaussians_at_one_position_keep_their_order():
    """Renderers blend them in stored order."""
    rng = np.random.default_rng(0)
    means, _ = levels_along_a_curve(300, rng)
    means = np.repeat(means, 5, axis=0)
    colors = rng.integers(0, 256, (1500, 3)).astype(np.uint8)
    with Workers(2) as pool:
        order = refined_order(means, colors, np.zeros(1500, np.uint8), pool)
    assert (order != np.arange(1500)).any()
    for position in np.unique(means, axis=0):
        assert (np.diff(order[(means[order] == position).all(axis=1)]) > 0).all()


@pytest.mark.parametrize("with_sensitivity", [False, True])
def test_the_scene_is_the_same_in_fewer_bytes(with_sensitivity):
    splats = kissgs.clean(kissgs.sample_scene(2000, sh_degree=1))[0]
    sensitivity = random_sensitivity(splats) if with_sensitivity else None
    decoded, sizes = [], []
    for order in ("hilbert", "refined"):
        result = encode(splats, Settings.research("balanced", order=order).encode, sensitivity=sensitivity)
        scene = kissgs.decompress(result.files)
        assert len(np.unique(result.order)) == len(result.order) == len(scene)
        columns = [
            scene.means,
            scene.quats,
            scene.scales,
            scene.opacities[:, None],
            scene.sh0,
            scene.shN.reshape(len(scene), -1),
        ]
        decoded.append(np.concatenate(columns, axis=1)[np.argsort(result.order)])
        sizes.append(sum(map(len, result.files.values())))
    np.testing.assert_array_equal(*decoded)
    assert sizes[1] < 0.99 * sizes[0]
