"""Oracle: brute force over levels and partitions, and the rule of decoders (the observed ends stand for the ranges)."""

import math
from itertools import combinations

import numpy as np
import pytest
from helpers.codec_scenes import random_scene, replaced
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from kissgs.core.positions import signed_exp, signed_log
from kissgs.planning import quantize as module
from kissgs.planning.quantize import (
    MEANS_TOP,
    Quantized,
    even_table,
    fit_table,
    means_bits,
    nearest_levels,
    observed_range,
    quantize,
    quantize_means,
    refit_table,
    table_field,
    without_unused,
)

quick = examples(60)


NUMBERS = st.floats(-1e3, 1e3, width=32)


def dequantize(quantized):
    """The values that the levels stand for, by the definition of ``Quantized``."""
    low, high = quantized.low.astype(np.float64), quantized.high.astype(np.float64)
    return low + quantized.levels * ((high - low) / quantized.top)


def tables(values=NUMBERS, *, min_rows=1, channels=None):
    """Arrays of up to 30 rows and 4 channels."""
    return st.tuples(st.integers(min_rows, 30), st.just(channels) if channels else st.integers(1, 4)).flatmap(
        lambda shape: stnp.arrays(np.float32, shape, elements=values)
    )


def decoded(quantized):
    """Decode levels with the written ranges, as a decoder that does not know the number of levels."""
    low, high = (end.astype(np.float64) for end in observed_range(quantized))
    levels = quantized.levels.astype(np.float64)
    first, last = levels.min(), levels.max()
    return low + (levels - first) / max(last - first, 1) * (high - low)


def half_step(quantized):
    return (quantized.high.astype(np.float64) - quantized.low) / quantized.top / 2


@quick
@given(tables(), st.floats(1e-3, 100), st.booleans(), st.sampled_from([1, 7, 99, 255]))
def test_every_value_gets_the_nearest_of_all_levels(values, step, shared, max_top):
    quantized = quantize(values, step=step, shared=shared, max_top=max_top)
    assert quantized.levels.dtype == np.uint8
    low, high = quantized.low.astype(np.float64), quantized.high.astype(np.float64)
    ladder = low + np.arange(quantized.top + 1)[:, None] / quantized.top * (high - low)
    nearest = np.abs(values[None] - ladder[:, None]).min(axis=0)
    found = np.abs(dequantize(quantized) - values)
    np.testing.assert_allclose(found, nearest, atol=1e-4 * half_step(quantized).max() + 1e-12)
    assert (found <= half_step(quantized) * (1 + 1e-6) + 1e-6 * np.abs(values)).all()


@quick
@given(tables(), st.floats(1e-3, 100))
def test_a_shared_step_is_shared_and_as_asked_for(values, step):
    quantized = quantize(values, step=step)
    widest = float(np.ptp(values.astype(np.float64), axis=0).max())
    steps = 2 * half_step(quantized)
    moving = np.ptp(values, axis=0) > 0
    assert (steps[~moving] == 0).all()
    if moving.any():
        np.testing.assert_allclose(steps[moving], widest / quantized.top, rtol=1e-4, atol=1e-6)
        assert quantized.top == min(255, max(1, math.ceil(widest / step - 1e-3))) or widest / step % 1 < 1e-3
        assert steps.max() <= step * (1 + 1e-3) or quantized.top == 255


@quick
@given(tables(), st.sampled_from([1, 99, 255]))
def test_without_a_shared_step_every_channel_spans_all_levels(values, max_top):
    quantized = quantize(values, step=1, shared=False, max_top=max_top)
    assert quantized.top == max_top
    assert (quantized.low == values.min(axis=0)).all()
    assert (quantized.high == values.max(axis=0)).all()
    for c in np.flatnonzero(np.ptp(values, axis=0) > 0):
        assert {0, max_top} <= set(quantized.levels[:, c])


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("value", [0.0, -0.0, 1e-45, -3.75, 0.1, 1e30])
def test_constant_channels_are_exact_whatever_stands_beside_them(value, shared):
    alone, beside = np.full((5, 1), value, np.float32), np.float32([[5], [-7], [1e6], [1], [2]])
    for values in (alone, np.concatenate([alone, beside], axis=1)):
        quantized = quantize(values, step=0.1, shared=shared)
        assert (decoded(quantized)[:, 0].astype(np.float32) == np.float32(value)).all()
        assert quantized.low[0] == quantized.high[0]
    assert (quantize(alone, step=0.1, shared=shared).levels == 0).all()


def test_ranges_that_vanish_in_float32_are_constant():
    """Two float64 numbers that are one float32 number: a range of zero length once meant a division by zero."""
    values = np.array([[1.0, 0], [1.0 + 1e-12, 1]])
    quantized = quantize(values, step=0.01)
    assert quantized.low[0] == quantized.high[0] == 1
    assert np.isfinite(dequantize(quantized)).all()
    assert (quantize(np.array([[1.0], [1.0 + 1e-12]]), step=1e-15).levels == 0).all()


def test_negative_zero_does_not_reach_the_ranges():
    """Equal scenes must give equal bytes, and -0.0 and 0.0 are equal."""
    quantized = quantize(np.array([[-0.0], [1.0]]), step=0.1)
    assert not np.signbit(quantized.low).any()
    assert not np.signbit(quantize_means(np.full((1, 3), -0.0, np.float32), bits=16).low).any()


def test_values_on_a_lattice_keep_it():
    """The codebook is rounded to a lattice beforehand, in float32: 254 steps once became 254.00001, so 255 levels
    that lay beside the lattice, and every value was rounded twice."""
    step, moved = 0.0123456, []
    for count in range(2, 256):
        numbers = np.rint(np.linspace(-count / 3, count * 2 / 3, count))
        lattice = (numbers * np.float32(step)).astype(np.float32)
        quantized = quantize(lattice[:, None], step=step)
        if np.abs(dequantize(quantized)[:, 0] - lattice).max() > step * 1e-3:
            moved.append((count, quantized.top))
    assert moved == []


@quick
@given(tables(min_rows=3), st.integers(0, 10), st.booleans())
def test_written_ranges_decode_to_the_same_values_also_after_extremes_were_removed(values, removed, shared):
    """A crop or a level of detail drops Gaussians after quantising: decoders then see other extremes."""
    whole = quantize(values, step=0.5, shared=shared)
    keep = np.argsort(whole.levels.max(axis=1), kind="stable")[: len(values) - min(removed, len(values) - 1)]
    keep = keep[whole.levels[keep].min(axis=1).argsort(kind="stable")][len(keep) // 3 :]
    part = whole.take(keep)
    wanted = dequantize(whole)[keep]
    np.testing.assert_allclose(decoded(part), wanted, rtol=1e-6, atol=1e-6 * np.abs(values).max())


def test_anchor_of_one_level_throughout_is_its_value():
    part = Quantized(np.full((4, 2), 3, np.uint8), even_table(np.float32([0, 10]), np.float32([10, 10]), 10))
    low, high = observed_range(part)
    assert (low == [3, 10]).all()
    assert (high == low).all()


@quick
@given(tables(st.floats(-(2.0**99), 2.0**99, width=32), channels=3), st.integers(8, 16))
def test_positions_are_multiples_of_a_power_of_two_and_reach_65535(values, bits):
    """Some readers of meta.json divide by 65535, whatever they see. With 15 bits the largest level once was 65534."""
    quantized = quantize_means(values, bits=bits)
    assert quantized.levels.dtype == np.uint16
    assert quantized.top == MEANS_TOP == 65535
    spacing = 1 << (16 - bits)
    levels = quantized.levels.astype(int)
    assert ((levels % spacing == 0) | (levels == 65535)).all()
    logs = np.sign(values, dtype=np.float64) * np.log1p(np.abs(values, dtype=np.float64))
    if np.float32(logs.min()) == np.float32(logs.max()):
        assert (levels == 0).all()
        return
    assert {0, 65535} <= set(levels.ravel())
    allowed = half_step(quantized) * spacing * (1 + 1e-6) + 1e-7 * np.abs(logs)
    assert (np.abs(decoded(quantized) - logs) <= allowed).all()


def test_positions_share_one_range_of_all_axes():
    quantized = quantize_means(np.float32([[0, 1, 2], [-5, 0, 100]]), bits=16)
    np.testing.assert_allclose(quantized.low, np.full(3, -math.log(6)), rtol=1e-7)
    np.testing.assert_allclose(quantized.high, np.full(3, math.log(101)), rtol=1e-7)


def test_means_bits_of_odd_scenes():
    few = random_scene(4, 0)
    assert means_bits(few, np.array([], dtype=int), 0.04) == 16
    assert means_bits(replaced(few, means=np.zeros((4, 3))), np.arange(4), 0.04) == 8
    assert means_bits(replaced(few, scales=np.full((4, 3), -30)), np.arange(4), 0.04) == 16
    only_last = replaced(few, scales=np.array([[-30] * 3] * 3 + [[5] * 3]))
    assert means_bits(only_last, np.array([3]), 1) == 8


@quick
@given(stnp.arrays(np.float32, 20, elements=st.floats(width=32, allow_nan=False, allow_infinity=False)))
def test_signed_log_and_its_inverse(values):
    logs = signed_log(values)
    assert (np.signbit(logs) == np.signbit(values)).all()
    wanted = [math.copysign(math.log1p(abs(float(value))), value) for value in values]
    np.testing.assert_allclose(logs, wanted, rtol=1e-15)
    np.testing.assert_allclose(signed_exp(logs), values.astype(np.float64), rtol=1e-12)


def table_error(table, values, weights):
    return float(weights @ np.square(values[:, None] - table).min(axis=1))


def best_error(values, weights, size):
    """Return the error of the best partition of the ascending values into ``size`` runs."""
    best = np.inf
    for cuts in combinations(range(1, len(values)), size - 1):
        runs = np.split(np.arange(len(values)), cuts)
        table = np.array([np.average(values[run], weights=weights[run]) for run in runs])
        best = min(best, table_error(table, values, weights))
    return best


def test_few_points_are_all_kept_whatever_the_distance_between_them():
    values = np.array([1e6, 0.1, 0.2, 0.2, -3.0])
    np.testing.assert_allclose(fit_table(values, np.ones(5), 0.1), [-3, 0.1, 0.2, 1e6], rtol=1e-6)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.quick(3)
def test_joined_points_are_nearly_as_good_as_the_best_partition(seed, monkeypatch):
    monkeypatch.setattr(module, "SIZE", 4)
    monkeypatch.setattr(module, "WIDEST", 1.0)
    rng = np.random.default_rng(seed)
    values, weights = np.sort(rng.normal(size=12)), rng.exponential(size=12) + 0.1
    table = fit_table(values, weights, 1e-6)
    assert len(table) == 4
    assert table_error(table, values, weights) <= 1.6 * best_error(values, weights, 4)


@given(st.integers(0, 1000), st.floats(1e-4, 1), st.booleans())
def test_tables_are_ascending_bounded_and_near(seed, step, with_zero):
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.normal(size=600), rng.normal(size=3) * 1e3])
    table = fit_table(values, rng.exponential(size=603), step, with_zero=with_zero)
    assert 1 <= len(table) <= 256
    assert (np.diff(table) > 0).all()
    assert not with_zero or 0 in table
    worst = np.abs(values[:, None] - table).min(axis=1).max()
    assert worst <= max(step / 2, np.ptp(values) / 120) * 1.001


def test_nearest_levels_are_nearest():
    table = np.array([-1, 0, 0.5, 4], np.float32)
    values = np.random.default_rng(0).uniform(-3, 6, (200, 3))
    wanted = np.abs(values[..., None] - table).argmin(axis=-1)
    assert (nearest_levels(table, values) == wanted).all()


def test_a_moved_table_has_a_smaller_error_and_keeps_the_bounds():
    rng = np.random.default_rng(1)
    values, weights, bound = rng.normal(size=(300, 3)), rng.exponential(size=300), np.full(300, 0.3)
    table = np.linspace(-4, 4, 20).astype(np.float32)
    levels = nearest_levels(table, values).astype(np.int64)
    moved = refit_table(table, levels, values, weights, (bound, bound))
    before, after = (np.square(t[levels] - values).sum(axis=1) @ weights for t in (table, moved))
    assert after < before
    assert np.abs(moved[levels] - values).max() <= 0.3 + 1e-6
    tight = np.abs(table[levels] - values).max(axis=1)  # nothing may move
    still = refit_table(table, levels, values, weights, (tight, tight))
    assert (np.abs(still[levels] - values).max(axis=1) <= tight + 1e-6).all()


def test_unused_values_are_left_out_and_the_rest_stands_for_the_same():
    table, levels = np.array([1, 2, 3.1234567], np.float32), np.array([[2, 0], [0, 0]], np.uint8)
    shorter, renumbered = without_unused(table, levels)
    assert (shorter[renumbered] == table[levels]).all()
    assert table_field(shorter, renumbered).values().tolist() == [[float(np.float32(3.12346)), 1], [1, 1]]
