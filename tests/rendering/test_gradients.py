"""Gradients of the Gaussians that have any. Oracle: autograd's gradients of all parameters."""

import numpy as np
import pytest
import torch
from helpers.rasterized import render_tensors
from helpers.render_scenes import blobs, camera, one, together

from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.cpu.frame import Gradients


def received(splats, views):
    """Return the gradients of each view of a loss without symmetry, by receiver and by autograd."""
    found = []
    for receive in (found.append, None):
        images, alphas, tensors = render_tensors(splats, views, receive=receive)
        weights = torch.rand(images.shape, generator=torch.Generator().manual_seed(3))
        ((images * weights).sum() + (alphas * weights[..., 0]).sum()).backward()
        if receive is not None:
            assert all(tensor.grad is None for tensor in tensors.values())
    return found, {name: tensor.grad.numpy() for name, tensor in tensors.items()}


@pytest.mark.parametrize("count", [0, 1, 60])
def test_received_gradients_are_those_of_autograd(count):
    views = [camera(seed=1), camera(20, 40, seed=2)] if count else [camera()]
    splats = blobs(count, 2)
    found, wanted = received(splats, views if count == 60 else views[:1])
    total = Gradients.sum(found)
    assert (np.diff(total.gaussians) > 0).all()
    for name in ATTRIBUTES:
        dense = np.zeros_like(wanted[name])
        total.add_to(name, dense)
        np.testing.assert_array_equal(dense, wanted[name])
        if count:
            assert dense.any()


def test_gaussians_outside_the_image_and_hidden_ones_have_none():
    wall = [one(mean=(0, 0, 0.2 * i), scale=(2, 2, 2), opacity=9.0) for i in range(4)]
    splats = together(one(mean=(0, 0, -50)), *wall, one(mean=(0, 0, 3)))
    found, _ = received(splats, [camera()])
    assert found[0].gaussians.tolist() == [1, 2]  # which leave less than TRANSMITTANCE_MIN
