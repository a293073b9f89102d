"""Rasterise a scene on the CPU or, by gsplat, on CUDA."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.context import DEFAULT_CONTEXT, Context, Device, Workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats
from kissgs.rendering import constants
from kissgs.rendering.camera import Camera

if TYPE_CHECKING:
    from torch import Tensor


# The rasteriser on CUDA: gsplat in its modes "classic" and "antialiased", with :mod:`kissgs.rendering.constants`.

RenderedImage = tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]  # colours and alphas of an image
ImageRenderer = Callable[[Camera, Sequence[float]], RenderedImage]  # of a camera and a background, RGB

GSPLAT_MISSING = "rendering on CUDA needs gsplat, which is missing: pip install gsplat"


def rasterize_on_cuda(
    parameters: Mapping[str, Tensor],
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
        raise UnsupportedError("CUDA needs torch, which is missing: pip install torch gsplat") from error
    if not torch.cuda.is_available():
        raise UnsupportedError("torch finds no CUDA device; use the device cpu")
    if find_spec("gsplat") is None:
        raise UnsupportedError(GSPLAT_MISSING)


def tensors_of(splats: Splats, device: str = "cpu") -> dict[str, Tensor]:
    """Return the parameters by name as torch tensors; on the CPU they share memory with ``splats``."""
    import torch

    return {name: torch.from_numpy(getattr(splats, name)).to(device) for name in ATTRIBUTES}


def image_renderer(splats: Splats) -> ImageRenderer:
    """Return a renderer of a scene, which is copied to the GPU once."""
    need_cuda()
    import torch

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


# The rasteriser for NumPy: an image of a scene, on the CPU by kissgs' own kernels, on CUDA by gsplat.
#
# :mod:`kissgs.rendering.constants` defines the image. Torch is needed on CUDA only. With gradients, the rasteriser is
# :func:`kissgs.rendering.differentiable.rasterize`.

Colour = Sequence[float]

BLACK: Colour = (0.0, 0.0, 0.0)


def render(
    splats: Splats, camera: Camera, *, background: Colour = BLACK, threads: int = 0, device: Device = "cpu"
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Render an image of a scene.

    The first image on a computer compiles the kernels, which takes some seconds; :func:`load_kernels` does it in
    advance.

    Args:
        splats: a finite scene (:func:`kissgs.clean`).
        camera: the camera, with the size of the image.
        background: RGB from 0 to 1.
        threads: number of CPU threads; 0 means one per processor. The image does not depend on it.
        device: "cpu" or "cuda", which needs the extra ``kissgs[cuda]``.

    Returns:
        The image ``(H, W, 3)``, RGB, 0 and up, not clamped to 1 (SH may overshoot), and its alpha ``(H, W)``, 0 to 1.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: the image would take too much memory, or CUDA cannot be used.
    """
    if device == "cuda":
        return image_renderer(splats)(camera, background)
    from kissgs.rendering.cpu.frame import draw

    with Workers(threads) as pool:
        frame = draw(splats, camera, np.asarray(background, np.float32), pool)
    return frame.image, 1 - frame.transmittance


def removal_scores(
    splats: Splats, cameras: Sequence[Camera], context: Context = DEFAULT_CONTEXT, *, background: Colour = BLACK
) -> Float64[np.ndarray, " N"]:
    """Return, for each Gaussian, the squared image error that its removal alone would cause. The score of GaussianPOP,
    section 3, exact except for Gaussians behind the end of a pixel's list. A sum over images, pixels and RGB in [0, 1];
    0 for a Gaussian that no camera sees."""
    from kissgs.rendering.cpu.frame import draw
    from kissgs.rendering.cpu.frame import removal_scores as frame_scores

    scores = np.zeros(len(splats), np.float64)
    colour = np.asarray(background, np.float32)
    with Workers(context.threads) as pool:
        for done, camera in enumerate(cameras):
            context.progress("score", done / len(cameras))
            scores += frame_scores(draw(splats, camera, colour, pool), pool)
    context.progress("score", 1.0)
    return scores
