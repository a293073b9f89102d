"""The differentiable rasteriser for torch, on the device of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.constants import DILATION
from kissgs.rendering.cpu.frame import Frame, draw
from kissgs.rendering.cpu.gradients import Gradients, differentiate
from kissgs.rendering.tensors import Parameters

try:
    import torch
    from torch import Tensor
    from torch.autograd.function import once_differentiable
except ModuleNotFoundError as error:
    raise UnsupportedError("gradients need torch, which is not installed: pip install 'kissgs[train]'") from error


def rasterize(
    parameters: Parameters,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    backgrounds: Tensor | None = None,
    dilation: float = DILATION,
    antialiased: bool = False,
    threads: int = 0,
    receive: Callable[[Gradients], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Render images of a scene, with gradients by all of its parameters.

    On the CPU by kissgs' own kernels, on CUDA by gsplat (extra ``kissgs[cuda]``), both with the image model of
    :mod:`kissgs.rendering.constants`.

    Args:
        parameters: stored parameters of a scene, float32 and finite, all on one device; from
            :func:`kissgs.rendering.tensors.tensors_of`, for example:

            - means: ``(N, 3)`` world units.
            - quats: ``(N, 4)`` w, x, y, z of any length; a length below 1e-12 means no rotation, and gradient 0.
            - scales: ``(N, 3)`` natural logarithms of standard deviations.
            - opacities: ``(N,)`` logits.
            - sh0: ``(N, 3)`` constant SH coefficients.
            - shN: ``(N, K, 3)`` other SH coefficients, K one of 0, 3, 8, 15.
        viewmats: ``(C, 4, 4)`` world to camera; x right, y down, z forward. No gradient.
        Ks: ``(C, 3, 3)`` intrinsics in pixels. No gradient.
        width: of the images, pixels.
        height: of the images, pixels.
        backgrounds: ``(C, 3)`` RGB; black by default. No gradient.
        dilation: variance added to both axes of a footprint, pixels².
        antialiased: whether opacities are compensated for the dilation (:attr:`kissgs.Splats.antialiased`).
        threads: number of CPU threads; 0 means one per processor. The result does not depend on it.
        receive: on the CPU, called in the backward pass with the gradients of each image, in place of autograd: most
            Gaussians have none, and arrays for all of them take longer to fill than to compute.

    Returns:
        Images ``(C, H, W, 3)``, not clamped, and alphas ``(C, H, W)``.

    Raises:
        UnsupportedError: cameras or backgrounds require a gradient; a parameter is not float32 or is on another device;
            the images would take too much memory; gsplat is not installed.
        InvalidSceneError: the shapes of the parameters do not fit together.
        InvalidViewsError: no camera; another number of backgrounds than of cameras; not a rigid pose, or not a pinhole.
    """
    tensors, device = [parameters[name] for name in ATTRIBUTES], parameters["means"].device
    if backgrounds is None:
        backgrounds = torch.zeros((len(viewmats), 3))
    _check_views(viewmats, Ks, backgrounds)
    if any(tensor.dtype != torch.float32 or tensor.device != device for tensor in tensors):
        raise UnsupportedError("the rasteriser takes float32 parameters on one device only; convert or move the others")
    if device.type == "cuda":
        from kissgs.rendering.gsplat_backend import rasterize_on_cuda

        return rasterize_on_cuda(parameters, viewmats, Ks, width, height, backgrounds, dilation, antialiased)
    if device.type != "cpu":
        raise UnsupportedError(f"the rasteriser runs on cpu and cuda, not on {device.type}; move the parameters")
    poses, pinholes, colours = (tensor.cpu().numpy() for tensor in (viewmats, Ks, backgrounds))
    cameras = [Camera(pose, K, width, height, dilation) for pose, K in zip(poses, pinholes, strict=True)]
    images, alphas = _Rasterize.apply(*tensors, cameras, colours, antialiased, threads, receive)  # type: ignore[no-untyped-call]
    return images, alphas


def _check_views(viewmats: Tensor, Ks: Tensor, backgrounds: Tensor) -> None:
    count = len(viewmats)
    if not count:
        raise InvalidViewsError("there is no camera to render from; give at least one")
    for name, tensor, shape in (("viewmats", viewmats, (4, 4)), ("Ks", Ks, (3, 3)), ("backgrounds", backgrounds, (3,))):
        if tensor.shape != (count, *shape):
            raise InvalidViewsError(f"{name} must be of shape {(count, *shape)}, not {tuple(tensor.shape)}")
        if tensor.requires_grad:
            raise UnsupportedError("the rasteriser has no gradients by cameras and backgrounds; detach them")


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *inputs: Any) -> tuple[Tensor, Tensor]:  # noqa: ANN401
        parameters, others = inputs[: len(ATTRIBUTES)], inputs[len(ATTRIBUTES) :]
        cameras, backgrounds, antialiased, threads, receive = others
        means, quats, scales, opacities, sh0, shN = (each.detach().contiguous().numpy() for each in parameters)
        splats = Splats(
            means=means, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN, antialiased=antialiased
        )
        with Workers(threads) as pool:
            frames = [draw(splats, camera, colour, pool) for camera, colour in zip(cameras, backgrounds, strict=True)]
        ctx.frames, ctx.threads, ctx.receive = frames, threads, receive
        ctx.save_for_backward(*parameters)  # so that torch notices if one is changed before the backward pass
        return _stack([frame.image for frame in frames]), _stack([1 - frame.transmittance for frame in frames])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_images: Tensor, v_alphas: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        parameters = ctx.saved_tensors
        frames: list[Frame] = ctx.frames
        image_gradients, alpha_gradients = v_images.contiguous().numpy(), v_alphas.contiguous().numpy()
        receive: Callable[[Gradients], None] | None = ctx.receive
        totals: list[np.ndarray] = []
        if receive is None:
            totals = [np.empty(tuple(parameter.shape), np.float32) for parameter in parameters]
            for total in totals:
                total.fill(0)
        with Workers(ctx.threads) as pool:
            for frame, v_image, v_alpha in zip(frames, image_gradients, alpha_gradients, strict=True):
                found = differentiate(frame, v_image, v_alpha, pool)
                if receive is not None:
                    receive(found)
                for name, total in zip(ATTRIBUTES, totals, strict=False):
                    found.add_to(name, total)
        if receive is not None:
            return (None,) * (len(parameters) + 5)
        return (*(torch.from_numpy(total) for total in totals), *(None,) * 5)


def _stack(images: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(images[0][None] if len(images) == 1 else np.stack(images))
