"""The rasteriser on CUDA: gsplat in its classic mode, with the constants of ``semantics``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.rendering import constants as semantics
from kissgs.rendering.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor


Picture = tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]
"""Colours and alphas."""

ImageRenderer = Callable[[Camera, Sequence[float]], Picture]
"""Takes a picture over a background."""

MISSING = "rendering on CUDA is gsplat's work, which is missing: pip install 'kissgs[cuda]'"


def rasterize_on_cuda(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    backgrounds: Tensor,
) -> tuple[Tensor, Tensor]:
    """:func:`kissgs.rendering.differentiable.rasterize` for tensors on CUDA.

    Raises:
        UnsupportedError: gsplat is not installed, or cannot use this GPU.
    """
    import torch

    try:
        from gsplat import rasterization
    except ImportError as error:
        raise UnsupportedError(MISSING) from error
    device = means.device
    backgrounds = backgrounds.to(device, torch.float32)
    if not len(means):  # which gsplat does not promise to draw
        empty = backgrounds[:, None, None, :].expand(-1, height, width, -1)
        return empty.contiguous(), torch.zeros((len(viewmats), height, width), device=device)
    images, alphas, _ = rasterization(
        means=means,
        quats=quats,
        scales=torch.exp(scales),
        opacities=torch.sigmoid(opacities),
        colors=torch.cat([sh0[:, None], shN], dim=1),
        viewmats=viewmats.to(device, torch.float32),
        Ks=Ks.to(device, torch.float32),
        width=width,
        height=height,
        near_plane=semantics.NEAR,
        far_plane=semantics.FAR,
        eps2d=semantics.DILATION,
        sh_degree=SH_REST_COUNTS.index(shN.shape[1]),
        tile_size=semantics.TILE,
        backgrounds=backgrounds,
        rasterize_mode="classic",
    )
    return images, alphas[..., 0]


def alpha_max() -> float:
    """The largest alpha that the installed gsplat draws: releases up to 1.5.3 have 0.999 built in, later ones tell.

    Pictures then differ from those of the processor by a few hundredths where opaque Gaussians overlap.
    """
    try:
        from gsplat.cuda import _constants
    except ImportError:
        return 0.999
    return float(_constants.MAX_ALPHA)


def need_cuda() -> None:
    """See that there is a GPU to work on, before the work.

    Raises:
        UnsupportedError: no torch, no CUDA or no gsplat here.
    """
    try:
        import torch
    except ImportError as error:
        raise UnsupportedError("work on CUDA needs torch, which is missing: pip install 'kissgs[cuda]'") from error
    if not torch.cuda.is_available():
        raise UnsupportedError("torch finds no CUDA device here; leave the work to the processor")
    if find_spec("gsplat") is None:
        raise UnsupportedError(MISSING)


def image_renderer(splats: Splats) -> ImageRenderer:
    """Takes pictures of a scene that goes to the GPU once.

    Raises:
        UnsupportedError: no torch, no CUDA or no gsplat here.
    """
    need_cuda()
    import torch

    from kissgs.rendering.tensors import tensors_of

    parameters = tensors_of(splats, "cuda")

    def take(camera: Camera, background: Sequence[float]) -> Picture:
        with torch.no_grad():
            images, alphas = rasterize_on_cuda(
                **parameters,
                viewmats=torch.from_numpy(camera.viewmat[None]),
                Ks=torch.from_numpy(camera.K[None]),
                width=camera.width,
                height=camera.height,
                backgrounds=torch.tensor([list(background)]),
            )
        return images[0].cpu().numpy(), alphas[0].cpu().numpy()

    return take
