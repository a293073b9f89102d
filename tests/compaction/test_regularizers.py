"""Shape regularization. Oracle: the formula of effective rank with 50 digits, and finite differences in float64."""

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kissgs.compaction.regularizers import EPSILON, ShapeRegularizer, erank_loss

getcontext().prec = 50
LOG_SCALES = st.floats(-30, 30, width=32)


def exact(scales):
    """Return max(-ln(erank - 1 + eps), 0) of log-scales; a share of 0 has no entropy."""
    squares = [(2 * Decimal(float(scale))).exp() for scale in scales]
    shares = [square / sum(squares) for square in squares]
    entropy = -sum(share * share.ln() for share in shares if share > 0)
    return max(0.0, float(-(entropy.exp() - 1 + Decimal(EPSILON)).ln()))


def found(scales, dtype=torch.float32):
    return float(erank_loss(torch.tensor([scales], dtype=dtype))[0])


@given(st.tuples(LOG_SCALES, LOG_SCALES, LOG_SCALES))
def test_the_loss_is_the_papers_for_any_scales(scales):
    assert found(scales) == pytest.approx(exact(scales), rel=1e-5, abs=1e-5)
    assert found(scales, torch.float64) == pytest.approx(exact(scales), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("scales", "loss"),
    [
        ((0, 0, 0), 0.0),  # a ball
        ((3, 3, -30), 0.0),  # a disc has rank 2
        ((30, -30, -30), -math.log(EPSILON)),  # a needle has rank 1
        ((-30, -30, -30), 0.0),
        ((30, 30, 30), 0.0),
    ],
)
def test_known_shapes(scales, loss):
    assert found([float(scale) for scale in scales]) == pytest.approx(loss, abs=1e-5)


@given(st.tuples(LOG_SCALES, LOG_SCALES, LOG_SCALES))
def test_the_gradient_is_finite_and_at_most_2(scales):
    leaf = torch.tensor([scales], requires_grad=True)
    erank_loss(leaf).sum().backward()
    assert torch.isfinite(leaf.grad).all()
    assert leaf.grad.abs().max() <= 2


def test_gradients_match_finite_differences():
    rng = np.random.default_rng(0)
    scales = torch.from_numpy(rng.uniform([0, -5, -6], [1, -1, -1], (50, 3))).requires_grad_()
    clear = erank_loss(scales).detach() > 0
    assert torch.autograd.gradcheck(erank_loss, scales[clear].detach().requires_grad_(), eps=1e-6, atol=1e-6)


def test_needles_become_wider_and_balls_flatter():
    scales = torch.tensor([[1.0, -5, -5], [0, 0, 0]], requires_grad=True)
    ShapeRegularizer(1.0, 0.5, extent=4.0).penalty(0, {"scales": scales}).backward()
    needle, ball = -scales.grad
    assert needle[0] < 0 < needle[1]
    assert float(ball.sum()) == pytest.approx(-0.5 / 4 / 2), "equal smallest scales share the gradient"


def test_the_loss_does_not_depend_on_the_size_of_the_scene():
    scales = torch.randn(20, 3)
    small = ShapeRegularizer(0.1, 1.0, extent=2.0).penalty(0, {"scales": scales})
    large = ShapeRegularizer(0.1, 1.0, extent=2e3).penalty(0, {"scales": scales + math.log(1e3)})
    assert float(small) == pytest.approx(float(large), rel=1e-4)


def test_an_empty_scene_has_no_loss():
    assert ShapeRegularizer(1, 1, 1.0).penalty(0, {"scales": torch.empty(0, 3)}) is None
