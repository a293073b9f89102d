"""The rasteriser on CUDA: gsplat in its modes "classic" and "antialiased", with :mod:`kissgs.rendering.constants`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor

    from kissgs.rendering.tensors import Parameters


RenderedImage = tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]
"""Colours and alphas of an image."""

ImageRenderer = Callable[[Camera, Sequence[float]], RenderedImage]
"""Function of a camera and a background (RGB) that renders an image of a scene."""

GSPLAT_MISSING = "rendering on CUDA needs gsplat, which is not installed: pip install 'kissgs[cuda]'"


def rasterize_on_cuda(
    parameters: Parameters,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    backgrounds: Tensor,
    dilation: float,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor]:
    """Render as :func:`kissgs.rendering.differentiable.rasterize`, for tensors on CUDA."""
    import torch

    try:
        from gsplat import rasterization
    except ImportError as error:
        raise UnsupportedError(GSPLAT_MISSING) from error
    means, shN = parameters["means"], parameters["shN"]
    device = means.device
    backgrounds = backgrounds.to(device, torch.float32)
    if not len(means):  # gsplat does not promise to render an empty scene
        empty = backgrounds[:, None, None, :].expand(-1, height, width, -1)
        return empty.contiguous(), torch.zeros((len(viewmats), height, width), device=device)
    images, alphas, _ = rasterization(
        means=means,
        quats=parameters["quats"],
        scales=torch.exp(parameters["scales"]),
        opacities=torch.sigmoid(parameters["opacities"]),
        colors=torch.cat([parameters["sh0"][:, None], shN], dim=1),
        viewmats=viewmats.to(device, torch.float32),
        Ks=Ks.to(device, torch.float32),
        width=width,
        height=height,
        near_plane=constants.NEAR,
        far_plane=constants.FAR,
        eps2d=dilation,
        sh_degree=SH_REST_COUNTS.index(shN.shape[1]),
        tile_size=constants.TILE,
        backgrounds=backgrounds,
        rasterize_mode="antialiased" if antialiased else "classic",
    )
    return images, alphas[..., 0]


def need_cuda() -> None:
    """Check that CUDA can be used, before a long computation."""
    try:
        import torch
    except ImportError as error:
        raise UnsupportedError("CUDA needs torch, which is not installed: pip install 'kissgs[cuda]'") from error
    if not torch.cuda.is_available():
        raise UnsupportedError("torch finds no CUDA device; use the device cpu")
    if find_spec("gsplat") is None:
        raise UnsupportedError(GSPLAT_MISSING)


def image_renderer(splats: Splats) -> ImageRenderer:
    """Return a renderer of a scene, which is copied to the GPU once."""
    need_cuda()
    import torch

    from kissgs.rendering.tensors import tensors_of

    parameters = tensors_of(splats, "cuda")

    def render(camera: Camera, background: Sequence[float]) -> RenderedImage:
        with torch.no_grad():
            images, alphas = rasterize_on_cuda(
                parameters,
                viewmats=torch.from_numpy(camera.viewmat[None]),
                Ks=torch.from_numpy(camera.K[None]),
                width=camera.width,
                height=camera.height,
                backgrounds=torch.tensor([list(background)]),
                dilation=camera.dilation,
                antialiased=splats.antialiased,
            )
        return images[0].cpu().numpy(), alphas[0].cpu().numpy()

    return render
