"""The differentiable rasteriser for torch, on the device of the parameters, and the loss of training."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from kissgs.core.array_types import Float
from kissgs.core.context import TORCH_MISSING, Workers
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.constants import DILATION
from kissgs.rendering.cpu.frame import Gradients, differentiate, draw
from kissgs.rendering.cpu.records import Frame
from kissgs.rendering.metrics import differences_and_ssim

try:
    import torch
    from torch import Tensor
    from torch.autograd.function import BackwardCFunction, FunctionCtx, once_differentiable
except ModuleNotFoundError as error:
    raise UnsupportedError(f"gradients need {TORCH_MISSING}") from error

Parameters = Mapping[str, Tensor]  # stored parameters of a scene, by the names in Splats


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
    """Render images ``(C, H, W, 3)``, not clamped, and alphas ``(C, H, W)``, with gradients by all parameters. On the
    CPU by kissgs' own kernels, on CUDA by gsplat (extra ``kissgs[cuda]``), both with the image model of
    :mod:`kissgs.rendering.constants`. Cameras ``(C, 4, 4)`` and ``(C, 3, 3)``, and backgrounds ``(C, 3)``, have no
    gradient. ``receive`` is called in the backward pass on the CPU with the gradients of each image, in place of
    autograd: most Gaussians have none, and arrays for all of them take longer to fill than to compute."""
    tensors, device = [parameters[name] for name in ATTRIBUTES], parameters["means"].device
    if backgrounds is None:
        backgrounds = torch.zeros((len(viewmats), 3))
    _check_views(viewmats, Ks, backgrounds)
    if any(tensor.dtype != torch.float32 or tensor.device != device for tensor in tensors):
        raise UnsupportedError("the rasteriser takes float32 parameters on one device only; convert or move the others")
    if device.type == "cuda":
        from kissgs.rendering.rasterizer import rasterize_on_cuda

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
        arrays = (each.detach().contiguous().numpy() for each in parameters)
        splats = Splats(**dict(zip(ATTRIBUTES, arrays, strict=True)), antialiased=antialiased)
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
        totals = [np.zeros(tuple(each.shape), np.float32) for each in (parameters if receive is None else ())]
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


def photometric_loss(
    image: Float[torch.Tensor, "..."],
    target: Float[torch.Tensor, "..."],
    *,
    ssim_weight: float = 0.2,
    mse_weight: float = 0.0,
    threads: int = 0,
) -> Float[torch.Tensor, ""]:
    """Return (1 - w) · mean |d| + w · (1 - SSIM) + m · mean d², for d = image - target and weights ``ssim_weight``, w,
    and ``mse_weight``, m. Where |d| is above 1, 2 |d| - 1 takes the place of d², so that a diverged pixel does not
    outweigh all others. SSIM is that of :func:`kissgs.rendering.metrics.ssim`. With m = 0 it is the loss of Kerbl et
    al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM Transactions on Graphics 42 (2023),
    equation 7. On the CPU in float32 the gradient is computed together with the value; elsewhere by autograd. Images
    are ``(H, W, 3)`` or ``(C, H, W, 3)``, not clamped, except at ±1e9."""
    if image.shape != target.shape or image.ndim not in (3, 4) or image.shape[-1] != 3 or image.numel() == 0:
        raise InvalidViewsError(
            f"images to compare must have one shape, (height, width, 3) or (count, height, width, 3), not "
            f"{tuple(image.shape)} and {tuple(target.shape)}"
        )
    if target.requires_grad:
        raise ValueError("the loss has no gradient by its target; detach it")
    if image.device.type != "cpu" or image.dtype != torch.float32 or target.dtype != torch.float32:
        return plain_photometric_loss(image, target, ssim_weight, mse_weight)
    if image.requires_grad and torch.is_grad_enabled():
        return _Photometric.apply(image, target, (ssim_weight, mse_weight), threads)  # type: ignore[no-untyped-call]
    return _photometric(image, target, (ssim_weight, mse_weight), threads, None)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, image: torch.Tensor, target: torch.Tensor, weights: tuple[float, float], threads: int
    ) -> torch.Tensor:
        gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
        ctx.save_for_backward(gradient)
        return _photometric(image, target, weights, threads, gradient)

    @staticmethod
    @once_differentiable
    def backward(ctx: BackwardCFunction, upstream: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        # By NumPy, because threads of torch wait for each other longer than this takes.
        return torch.from_numpy(gradient.numpy() * upstream.numpy()), None, None, None


def _photometric(
    image: torch.Tensor, target: torch.Tensor, weights: tuple[float, float], threads: int, gradient: torch.Tensor | None
) -> torch.Tensor:
    """Return the loss with ``weights`` of SSIM and of the squares; write its gradient into ``gradient`` if given."""
    count, (ssim_weight, mse_weight) = image.numel(), weights
    factors = (1 - ssim_weight) / count, mse_weight / count, -ssim_weight / count
    with Workers(threads) as pool:
        gradients = None if gradient is None else _views(gradient)
        difference, squares, similarity = differences_and_ssim(_views(image), _views(target), pool, gradients, factors)
    loss = ((1 - ssim_weight) * difference + mse_weight * squares + ssim_weight * (count - similarity)) / count
    return torch.tensor(loss, dtype=torch.float32)


def _views(images: torch.Tensor) -> np.ndarray:
    return images.detach().contiguous().reshape(-1, *images.shape[-3:]).numpy()


def plain_photometric_loss(
    image: Float[torch.Tensor, "..."], target: Float[torch.Tensor, "..."], ssim_weight: float, mse_weight: float = 0.0
) -> Float[torch.Tensor, ""]:
    """Return the loss of :func:`photometric_loss` by plain torch operations, on any device and in any dtype."""
    x, y = (images.reshape(-1, *images.shape[-3:]).clamp(-1e9, 1e9) for images in (image, target))
    s, d = x + y, x - y
    S, D, SS, DD = _blur(torch.cat([s, d, s * s, d * d], dim=-1).permute(0, 3, 1, 2)).chunk(4, dim=1)
    P, Q = (SS - S * S).clamp_min(0), (DD - D * D).clamp_min(0)
    luminance = (S * S - D * D + 2e-4) / (S * S + D * D + 2e-4)
    structure = (P - Q + 18e-4) / (P + Q + 18e-4)
    dissimilarity, bounded = 1 - (luminance * structure).mean(), d.abs().clamp_max(1)
    return (
        (1 - ssim_weight) * d.abs().mean()
        + ssim_weight * dissimilarity
        + mse_weight * (bounded * (2 * d.abs() - bounded)).mean()
    )


def _blur(maps: torch.Tensor) -> torch.Tensor:
    """Blur each channel of ``(V, C, H, W)`` with the window of SSIM. Contiguous depthwise convolutions, because torch
    computes those in full float32 on a GPU, others perhaps in TF32."""
    channels = maps.shape[1]
    offsets = torch.arange(-5, 6, dtype=maps.dtype, device=maps.device)
    window = torch.softmax(-offsets.square() / 4.5, dim=0).expand(channels, 1, 11)
    down = torch.nn.functional.conv2d(maps.contiguous(), window[..., None], padding=(5, 0), groups=channels)
    return torch.nn.functional.conv2d(down, window[:, :, None], padding=(0, 5), groups=channels)
