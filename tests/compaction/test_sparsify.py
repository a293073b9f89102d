"""Sparsification. Oracle: the equations of ADMM in NumPy, float64."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kissgs.compaction.regularizers import AdmmSparsifier, keep_largest


@given(st.lists(st.sampled_from([-1.0, 0.0, 0.25, 0.5, 2.0]), min_size=1, max_size=12), st.integers(1, 12))
def test_exactly_the_requested_count_is_kept_despite_ties(values, count):
    """The published code keeps values strictly above the threshold, and so loses ties, sometimes all values."""
    found = keep_largest(torch.tensor(values), count).numpy()
    order = sorted(range(len(values)), key=lambda n: (-values[n], n))[:count]
    assert all(found[n] == (values[n] if n in order else 0) for n in range(len(values)))


class FixedOpacities:
    """A trainable scene with these opacities."""

    def __init__(self, logits):
        self.logits = logits

    def gaussians(self):
        return {"opacities": self.logits}


def naive_admm(opacity_steps, count, rho, interval):
    """Return the penalties, and z and u at the end, for opacities before each step and after the last one."""
    o = opacity_steps[0]
    z, u = naive_keep_largest(o, count), np.zeros_like(o)
    penalties = []
    for step in range(len(opacity_steps) - 1):
        if (step + 1) % interval:
            penalties.append(0.0)
            continue
        penalties.append(rho / 2 * np.sum((opacity_steps[step] - z + u) ** 2))
        after = opacity_steps[step + 1]
        z = naive_keep_largest(after + u, count)
        u = u + after - z
    return penalties, z, u


def naive_keep_largest(values, count):
    sparse = np.zeros_like(values)
    index = np.argsort(-values, kind="stable")[:count]
    sparse[index] = values[index]
    return sparse


@pytest.mark.parametrize("interval", [1, 3])
def test_penalties_and_updates_are_those_of_admm(interval):
    logits = np.random.default_rng(0).normal(size=(10, 30))
    logits = np.cumsum(0.3 * logits, axis=0).astype(np.float32)
    sparsifier = AdmmSparsifier(torch.tensor(logits[0]), 8, 0.01, interval)
    penalties = []
    for step in range(9):
        penalty = sparsifier.penalty(step, {"opacities": torch.tensor(logits[step])})
        penalties.append(0.0 if penalty is None else float(penalty))
        sparsifier.update(step, FixedOpacities(torch.tensor(logits[step + 1])))
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
        one.update(step, FixedOpacities(logits + step))
    other.restore(one.state())
    for sparsifier in (one, other):
        sparsifier.update(3, FixedOpacities(-logits))
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
        sparsifier.update(0, FixedOpacities(leaf))
        states.append([leaf.grad.numpy(), *sparsifier.state().values()])
    torch.set_num_threads(before)
    for other in states[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(states[0], other, strict=True))
