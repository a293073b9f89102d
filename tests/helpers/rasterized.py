"""Images of the differentiable rasteriser, with the parameters they were rendered from."""

import numpy as np
import torch

from kissgs.core.context import Workers
from kissgs.rendering.cpu.frame import draw, removal_scores
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.rasterizer import tensors_of


def render_tensors(splats, cameras, device="cpu", backgrounds=None, **parameters):
    """Return images and alphas as tensors, and the parameters they were rendered from."""
    tensors = {name: tensor.clone().requires_grad_() for name, tensor in tensors_of(splats, device).items()}
    images, alphas = rasterize(
        tensors,
        viewmats=torch.from_numpy(np.stack([c.viewmat for c in cameras])),
        Ks=torch.from_numpy(np.stack([c.K for c in cameras])),
        width=cameras[0].width,
        height=cameras[0].height,
        backgrounds=None
        if backgrounds is None
        else torch.tensor(np.array(backgrounds), dtype=torch.float32, device=device),
        antialiased=splats.antialiased,
        **parameters,
    )
    return images, alphas, tensors


def all_is_finite(splats, view):
    images, alphas, tensors = render_tensors(splats, [view], backgrounds=[[1.0, 0.5, 0.0]])
    assert torch.isfinite(images).all()
    assert torch.isfinite(alphas).all()
    assert ((alphas >= 0) & (alphas <= 1)).all()
    (images.sum() + alphas.sum()).backward()
    for name, tensor in tensors.items():
        assert torch.isfinite(tensor.grad).all(), name
    with Workers(1) as pool:
        scores = removal_scores(draw(splats, view, np.zeros(3, np.float32), pool), pool)
    assert np.isfinite(scores).all()
    assert (scores >= 0).all()
