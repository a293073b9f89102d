"""Errors of levels. Oracle: leaves whose images are known."""

import numpy as np
import pytest
from helpers.render_scenes import blobs, one

from kissgs.streaming.levels import SIZE, level_errors


def test_equal_levels_have_no_error():
    leaf = blobs(50)
    assert level_errors([leaf, leaf.select(np.arange(49, -1, -1)), leaf]) == [0, 0, 0]


def test_a_ball_in_front_of_grey():
    """An opaque ball of one colour, and one of another: the error is the difference times the ball's share."""
    size = -2.0
    ball = one(scale=(size,) * 3, opacity=20.0, sh0=(1.7724539,) * 3)  # white
    grey = one(scale=(size,) * 3, opacity=20.0, sh0=(0, 0, 0))  # as the background: no error but the white ball's
    found = level_errors([ball, grey])[1]
    pixels = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    squared = (pixels[:, None] ** 2 + pixels[None, :] ** 2) * 4  # the radius of the leaf is two standard deviations
    assert found == pytest.approx(0.5 * np.sqrt(np.mean(np.exp(-0.5 * squared) ** 2)), rel=0.03)


def test_a_coarser_level_never_has_a_smaller_error():
    leaf = blobs(60)
    errors = level_errors([leaf, leaf.select(np.arange(10)), leaf.select(np.arange(40))])
    assert 0 < errors[1] == errors[2]
