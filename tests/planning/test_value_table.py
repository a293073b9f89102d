"""Oracle: the best tables of small sets by trying all partitions, and the error of the nearest value."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs.planning import quantize
from kissgs.planning.quantize import fit_table, nearest_levels, refit_table, table_field, without_unused


def error(table, values, weights):
    return float(weights @ np.square(values[:, None] - table).min(axis=1))


def best_error(values, weights, size):
    """Return the error of the best partition of the ascending values into ``size`` runs."""
    best = np.inf
    for cuts in combinations(range(1, len(values)), size - 1):
        runs = np.split(np.arange(len(values)), cuts)
        table = np.array([np.average(values[run], weights=weights[run]) for run in runs])
        best = min(best, error(table, values, weights))
    return best


def test_few_points_are_all_kept_whatever_the_distance_between_them():
    values = np.array([1e6, 0.1, 0.2, 0.2, -3.0])
    np.testing.assert_allclose(fit_table(values, np.ones(5), 0.1), [-3, 0.1, 0.2, 1e6], rtol=1e-6)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.quick(3)
def test_joined_points_are_nearly_as_good_as_the_best_partition(seed, monkeypatch):
    monkeypatch.setattr(quantize, "SIZE", 4)
    monkeypatch.setattr(quantize, "WIDEST", 1.0)
    rng = np.random.default_rng(seed)
    values, weights = np.sort(rng.normal(size=12)), rng.exponential(size=12) + 0.1
    table = fit_table(values, weights, 1e-6)
    assert len(table) == 4
    assert error(table, values, weights) <= 1.6 * best_error(values, weights, 4)


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
