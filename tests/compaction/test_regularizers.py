"""Regularization. Oracle: the formula of effective rank with 50 digits, finite differences, and ADMM in NumPy."""

from decimal import Decimal, getcontext

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kissgs.compaction.regularizers import EPSILON, AdmmSparsifier, ShapeRegularizer, erank_loss, keep_largest

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


@given(st.tuples(LOG_SCALES, LOG_SCALES, LOG_SCALES))
def test_the_gradient_is_finite_and_at_most_2(scales):
    leaf = torch.tensor([scales], requires_grad=True)
    erank_loss(leaf).sum().backward()
    assert torch.isfinite(leaf.grad).all()
    assert leaf.grad.abs().max() <= 2


def test_gradients_match_finite_differences():
    rng = np.random.default_rng(0)
    scales = torch.from_numpy(rng.uniform([0, -5, -6], [1, -1, -1], (50, 3)))
    clear = erank_loss(scales) > 0
    inputs = scales[clear].requires_grad_()
    assert torch.autograd.gradcheck(lambda scales: erank_loss(scales).sum(), inputs, eps=1e-6, atol=1e-6)


def test_needles_become_wider_and_balls_flatter():
    scales = torch.tensor([[1.0, -5, -5], [0, 0, 0]], requires_grad=True)
    ShapeRegularizer(1.0, 0.125).penalty(0, {"scales": scales}).backward()
    needle, ball = -scales.grad
    assert needle[0] < 0 < needle[1]
    assert float(ball.sum()) == pytest.approx(-0.125 / 2), "equal smallest scales share the gradient"


def test_the_loss_is_equation_1_as_a_mean():
    scales = np.random.default_rng(0).normal(-3, 1, (20, 3)).astype(np.float32)
    found = ShapeRegularizer(0.1, 1.0).penalty(0, {"scales": torch.from_numpy(scales)})
    wanted = np.mean([0.1 * exact(each) + np.exp(each.min()) for each in scales.astype(np.float64)])
    assert float(found) == pytest.approx(wanted, rel=1e-5)


def test_an_empty_scene_has_no_loss():
    assert ShapeRegularizer(1, 1).penalty(0, {"scales": torch.empty(0, 3)}) is None


@given(st.lists(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 2.0]), min_size=1, max_size=12), st.integers(1, 12))
def test_exactly_the_requested_count_is_kept_despite_ties(values, count):
    """The published code keeps values strictly above the threshold, and so loses ties, sometimes all values."""
    found = keep_largest(torch.tensor(values), count).numpy()
    order = sorted(range(len(values)), key=lambda n: (-values[n], n))[:count]
    assert all(found[n] == (values[n] if n in order else 0) for n in range(len(values)))


def naive_admm(opacity_steps, count, rho, interval):
    """Return the penalties, and z and u at the end, for opacities before each step: the order of GaussianSpa's code."""
    z, u = naive_keep_largest(opacity_steps[0], count), np.zeros_like(opacity_steps[0])
    penalties = []
    for step, o in enumerate(opacity_steps):
        if (step + 1) % interval:
            penalties.append(0.0)
            continue
        penalties.append(rho / 2 * np.sum((o - z + u) ** 2))
        z = naive_keep_largest(o + u, count)
        u = u + o - z
    return penalties, z, u


def naive_keep_largest(values, count):
    sparse = np.zeros_like(values)
    index = np.argsort(-values, kind="stable")[:count]
    sparse[index] = values[index]
    return sparse


@pytest.mark.parametrize("interval", [1, 3])
def test_penalties_and_updates_are_those_of_admm(interval):
    logits = np.random.default_rng(0).normal(size=(9, 30))
    logits = np.cumsum(0.3 * logits, axis=0).astype(np.float32)
    sparsifier = AdmmSparsifier(torch.tensor(logits[0]), 8, 0.01, interval)
    penalties = []
    for step in range(9):
        penalty = sparsifier.penalty(step, {"opacities": torch.tensor(logits[step])})
        penalties.append(0.0 if penalty is None else float(penalty))
    expected, z, u = naive_admm(1 / (1 + np.exp(-logits.astype(np.float64))), 8, 0.01, interval)
    np.testing.assert_allclose(penalties, expected, rtol=1e-5)
    np.testing.assert_allclose(sparsifier.z.numpy(), z, atol=1e-5)
    np.testing.assert_allclose(sparsifier.u.numpy(), u, atol=1e-5)


def test_only_the_opacities_to_prune_are_pulled_down():
    logits = torch.tensor([3.0, -1.0, 2.0, 0.0], requires_grad=True)
    AdmmSparsifier(logits, 2, 0.1, 1).penalty(0, {"opacities": logits}).backward()
    assert logits.grad[1] > 0
    assert logits.grad[3] > 0
    assert (logits.grad[[0, 2]] == 0).all()


def test_a_restored_state_continues_exactly():
    logits = torch.randn(20)
    one, other = AdmmSparsifier(logits, 5, 0.1, 1), AdmmSparsifier(torch.zeros(20), 5, 0.1, 1)
    for step in range(3):
        one.penalty(step, {"opacities": logits + step})
    other.restore(one.state())
    for sparsifier in (one, other):
        sparsifier.penalty(3, {"opacities": -logits})
    assert torch.equal(one.z, other.z)
    assert torch.equal(one.u, other.u)


def test_threads_change_no_bit():
    """They do in torch's sigmoid, for more than 32,768 numbers."""
    logits = torch.linspace(-9, 9, 33_001)
    states, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        leaf = logits.clone().requires_grad_()
        sparsifier = AdmmSparsifier(leaf, 9000, 1e-3, 1)
        sparsifier.penalty(0, {"opacities": leaf}).backward()
        states.append([leaf.grad.numpy(), *sparsifier.state().values()])
    torch.set_num_threads(before)
    for other in states[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(states[0], other, strict=True))
