"""Oracle: ADMM as its equations stand, in NumPy, sorted out one by one."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kissgs.compaction.sparsify import Sparsity, sparsest


@given(st.lists(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 2.0]), min_size=1, max_size=12), st.integers(1, 12))
def test_exactly_so_many_are_left_whatever_the_ties(values, count):
    """The published code keeps what is strictly above the value at the limit: ties are lost, and sometimes all."""
    found = sparsest(torch.tensor(values), count).numpy()
    order = sorted(range(len(values)), key=lambda n: (-values[n], n))[:count]
    assert all(found[n] == (values[n] if n in order else 0) for n in range(len(values)))


class Shown:
    """A learner with these opacities."""

    def __init__(self, logits):
        self.logits = logits

    def gaussians(self):
        return {"opacities": self.logits}


def naive(opacity_steps, count, rho, interval):
    """Penalties and the last z, u; ``opacity_steps`` are opacities at each step, before and after it."""
    o = opacity_steps[0]
    z, u = keep(o, count), np.zeros_like(o)
    penalties = []
    for step in range(len(opacity_steps) - 1):
        if (step + 1) % interval:
            penalties.append(0.0)
            continue
        penalties.append(rho / 2 * np.sum((opacity_steps[step] - z + u) ** 2))
        after = opacity_steps[step + 1]
        z = keep(after + u, count)
        u = u + after - z
    return penalties, z, u


def keep(values, count):
    sparse = np.zeros_like(values)
    index = np.argsort(-values, kind="stable")[:count]
    sparse[index] = values[index]
    return sparse


@pytest.mark.parametrize("interval", [1, 3])
def test_it_is_admm(interval):
    logits = np.random.default_rng(0).normal(size=(10, 30))
    logits = np.cumsum(0.3 * logits, axis=0).astype(np.float32)
    sparsity = Sparsity(torch.tensor(logits[0]), 8, 0.01, interval)
    penalties = []
    for step in range(9):
        penalty = sparsity.penalty(step, {"opacities": torch.tensor(logits[step])})
        penalties.append(0.0 if penalty is None else float(penalty))
        sparsity.update(step, Shown(torch.tensor(logits[step + 1])))
    expected, z, u = naive(1 / (1 + np.exp(-logits.astype(np.float64))), 8, 0.01, interval)
    np.testing.assert_allclose(penalties, expected, rtol=1e-5)
    np.testing.assert_allclose(sparsity.z.numpy(), z, atol=1e-5)
    np.testing.assert_allclose(sparsity.u.numpy(), u, atol=1e-5)


def test_it_pulls_those_that_shall_go_down_and_leaves_the_others():
    logits = torch.tensor([3.0, -1.0, 2.0, 0.0], requires_grad=True)
    Sparsity(logits, 2, 0.1, 1).penalty(0, {"opacities": logits}).backward()
    assert logits.grad[1] > 0
    assert logits.grad[3] > 0
    assert (logits.grad[[0, 2]] == 0).all()


def test_its_state_goes_on():
    logits = torch.randn(20)
    one, other = Sparsity(logits, 5, 0.1, 1), Sparsity(torch.zeros(20), 5, 0.1, 1)
    for step in range(3):
        one.update(step, Shown(logits + step))
    other.restore(one.state())
    for sparsity in (one, other):
        sparsity.update(3, Shown(-logits))
    assert torch.equal(one.z, other.z)
    assert torch.equal(one.u, other.u)


def test_threads_change_no_bit():
    """torch's sigmoid does, of more than 32,768 numbers."""
    logits = torch.linspace(-9, 9, 33_001)
    states, before = [], torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        leaf = logits.clone().requires_grad_()
        sparsity = Sparsity(leaf, 9000, 1e-3, 1)
        sparsity.penalty(0, {"opacities": leaf}).backward()
        sparsity.update(0, Shown(leaf))
        states.append([leaf.grad.numpy(), *sparsity.state().values()])
    torch.set_num_threads(before)
    for other in states[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(states[0], other, strict=True))
