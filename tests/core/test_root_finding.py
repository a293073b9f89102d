"""Oracle: functions with a known root."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.root_finding import ATTEMPTS, MAX_EXTRAPOLATION, StopRule, find_root


class Recorded:
    def __init__(self, function):
        self.function, self.arguments = function, []

    def __call__(self, x):
        self.arguments.append(x)
        return self.function(x)


@given(st.floats(-20, 20), st.floats(0.3, 3), st.sampled_from([-1, 1]), st.floats(-15, 15))
def test_the_root_of_a_bent_line_is_found_in_few_attempts(crossing, steepness, sign, start):
    """Steeper above its root than below, and up to three times as steep as the given slope."""
    margin = Recorded(lambda x: sign * steepness * (x - crossing) * (1.5 if sign * x > sign * crossing else 0.8))
    found = find_root(margin, start, sign * 1.0, 0.1, (-50, 50))
    assert 0 <= margin(found) <= 0.1
    assert len(margin.arguments) <= ATTEMPTS + 1
    assert all(
        abs(after - before) <= MAX_EXTRAPOLATION + 1e-9
        for before, after in zip(margin.arguments, margin.arguments[1:-1], strict=False)
    )


def test_a_staircase():
    """Rounding leaves no value between -0.4 and 0.6; the best attempt is returned."""
    margin = Recorded(lambda x: 0.6 - round(x) if abs(x) < 3 else -x)
    found = find_root(margin, 2.2, -1.0, 0.05, (-9, 9))
    assert margin(found) == pytest.approx(0.6)


def test_a_jump_is_not_searched_further():
    margin = Recorded(lambda x: (1.0 if x < 0.3 else -1.0) - 0.1 * x)
    found = find_root(
        margin, 1.0, -1.0, 0.01, (-9, 9), stop=StopRule(settled=lambda inside, outside: outside - inside < 1 / 32)
    )
    assert found is not None
    assert 0.3 - 1 / 32 < found < 0.3
    assert len(margin.arguments) < ATTEMPTS - 1
    assert find_root(Recorded(margin.function), 1.0, -1.0, 0.01, (-9, 9)) == pytest.approx(0.3, abs=1 / 32)


def test_known_values_are_used():
    margin = Recorded(lambda x: 5.0 - math.exp(x))
    found = find_root(margin, 0.0, -1.0, 0.05, (-9, 9), before={1.7: margin.function(1.7), 1.5: margin.function(1.5)})
    assert found == pytest.approx(math.log(5), abs=0.02)
    assert len(margin.arguments) <= 4
    assert min(margin.arguments[1:]) > 1.5
    assert find_root(margin, 3.0, -1.0, 0.05, (-9, 9), before={1.0: 2.0}, stop=StopRule(attempts=1)) is None


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_root_at_the_bound_is_found(sign):
    """The function is flat over long steps before it jumps."""
    margin = Recorded(lambda x: -1.0 if sign * x < 20 else 30.0 + sign * x)
    found = find_root(margin, 0.0, sign * 1.0, 0.05, (-40, 40))
    assert found is not None
    assert 20 <= sign * found < 30
    assert len(margin.arguments) <= ATTEMPTS


def test_the_bound_is_tried_after_the_last_attempt():
    margin = Recorded(lambda x: -1.0 - x)
    assert find_root(margin, 30.0, -1.0, 0.05, (-40, 40), stop=StopRule(attempts=2)) == -40
    assert margin.arguments == [30.0, 26.0, -40]


def test_the_bound_is_not_tried_where_each_evaluation_is_expensive():
    margin = Recorded(lambda x: -1.0 - x)
    assert find_root(margin, 30.0, -1.0, 0.05, (-40, 40), stop=StopRule(2, tries_bound=False)) is None
    assert margin.arguments == [30.0, 26.0]


@pytest.mark.parametrize(
    ("start", "slope", "arguments"),
    [(0.0, -2.0, [0.0, 3.95, 1.975 - 0.1]), (8.0, -0.5, [8.0, 5.95, 5.95 - 1.5 * 2.05])],
)
def test_the_last_attempt_is_cautious(start, slope, arguments):
    """It stays nearer to the point that met the goal, and goes further where none did."""
    margin = Recorded(lambda x: slope * x + (4.0 if slope < -1 else 2.0))
    find_root(margin, start, -1.0, 0.1, (-40, 40), stop=StopRule(3, tries_bound=False, caution=(0.5, 0.1)))
    assert margin.arguments == pytest.approx(arguments)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_goal_met_everywhere_ends_at_the_far_bound(sign):
    margin = Recorded(lambda x: 3.0 + 0.01 * sign * x)
    assert find_root(margin, 0.0, sign * 1.0, 0.05, (-40, 40)) == -40 * sign
    assert len(margin.arguments) <= 4


def test_a_fixed_end_of_the_bracket_does_not_slow_the_search():
    """False position alone advances by a tenth of the bracket per step here."""
    margin = Recorded(lambda x: 100.0 if x < 1.3 else -0.1 - 0.01 * x)
    find_root(margin, 8.0, -1.0, 0.05, (-9, 9))
    assert any(abs(x - 1.3) < 0.2 for x in margin.arguments)


def test_infinite_margins_do_not_end_the_search():
    """An infinite margin says nothing about the distance to the goal."""
    margin = Recorded(lambda x: math.inf if x < 6 else 10 - x)
    found = find_root(margin, -3.0, -1.0, 0.1, (-20, 20))
    assert found == pytest.approx(9.95, abs=0.06)
    assert all(math.isfinite(x) for x in margin.arguments)


def test_a_function_that_is_not_quite_monotone():
    """No argument is tried twice."""
    margin = Recorded(lambda x: 0.9 - 0.3 * x if x < 0.1 else -0.1 - 0.02 * (1 - x) if x < 1 else -x)
    found = find_root(margin, 1.0, -1.0, 0.05, (-9, 9))
    assert len(set(margin.arguments)) == len(margin.arguments) > 5
    assert margin(found) >= 0.85


@pytest.mark.parametrize("function", [lambda x: -5.0 - math.exp(-abs(x)), lambda x: min(-x, 40) - 41])
def test_an_unreachable_goal_is_given_up(function):
    """The bound is tried first."""
    margin = Recorded(function)
    assert find_root(margin, 3.0, -1.0, 0.05, (-50, 50)) is None
    assert len(margin.arguments) <= ATTEMPTS + 1
    assert margin.arguments[-1] == -50


def test_bounds_limit_the_search():
    margin = Recorded(lambda x: -20 - x)
    assert find_root(margin, 0.0, -1.0, 0.05, (-7, 7)) is None
    assert min(margin.arguments) == -7
    assert len(margin.arguments) == 3
    margin = Recorded(lambda x: 20 - x)
    assert find_root(margin, 0.0, -1.0, 0.05, (-7, 7)) == 7
