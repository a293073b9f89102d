"""The loss of 3DGS training: mean absolute difference and SSIM between a rendering and the photograph."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.threads import Workers
from kissgs.rendering.metrics import difference_and_ssim

try:
    import torch
    from torch.autograd.function import BackwardCFunction, FunctionCtx, once_differentiable
except ModuleNotFoundError as error:
    raise UnsupportedError("this loss is torch's, which is missing: pip install 'kissgs[train]'") from error


def photometric_loss(
    image: Float[torch.Tensor, "..."],
    target: Float[torch.Tensor, "..."],
    *,
    ssim_weight: float = 0.2,
    threads: int = 0,
) -> Float[torch.Tensor, ""]:
    """(1 - w) · mean |image - target| + w · (1 - SSIM), with the SSIM of :func:`kissgs.rendering.metrics.ssim`.

    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", ACM Transactions on Graphics 42
    (2023), equation 7. On the CPU in float32 the gradient is computed together with the value; elsewhere by autograd.

    Args:
        image: ``(H, W, 3)`` or ``(C, H, W, 3)``, any values: renderings are not clamped. Values beyond ±1e9 count as
            that; NaN gives NaN.
        target: of the same shape, type and device; gets no gradient.
        ssim_weight: w, from 0 to 1.
        threads: for the CPU; below 1 all processors. No bit of the result depends on it.

    Raises:
        InvalidViewsError: the tensors are not images of the same size.
        ValueError: the target requires a gradient.
    """
    if image.shape != target.shape or image.ndim not in (3, 4) or image.shape[-1] != 3 or image.numel() == 0:
        raise InvalidViewsError(
            f"images to compare must both be (height, width, 3) or stacks of such, not {tuple(image.shape)} and "
            f"{tuple(target.shape)}"
        )
    if target.requires_grad:
        raise ValueError("the loss has no gradient by its target: detach it")
    if image.device.type != "cpu" or image.dtype != torch.float32 or target.dtype != torch.float32:
        return plain_photometric_loss(image, target, ssim_weight)
    if image.requires_grad and torch.is_grad_enabled():
        return _Photometric.apply(image, target, ssim_weight, threads)  # type: ignore[no-untyped-call]
    return _photometric(image, target, ssim_weight, threads, None)


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: FunctionCtx, image: torch.Tensor, target: torch.Tensor, ssim_weight: float, threads: int
    ) -> torch.Tensor:
        gradient = torch.empty_like(image, memory_format=torch.contiguous_format)
        ctx.save_for_backward(gradient)
        return _photometric(image, target, ssim_weight, threads, gradient)

    @staticmethod
    @once_differentiable
    def backward(ctx: BackwardCFunction, upstream: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream, None, None, None


def _photometric(
    image: torch.Tensor, target: torch.Tensor, ssim_weight: float, threads: int, gradient: torch.Tensor | None
) -> torch.Tensor:
    """The loss, and into ``gradient`` its gradient by the image."""
    count = image.numel()
    weights = (1 - ssim_weight) / count, -ssim_weight / count
    with Workers(threads) as pool:
        slopes = None if gradient is None else _views(gradient)
        difference, similarity = difference_and_ssim(_views(image), _views(target), pool, slopes, weights)
    loss = ((1 - ssim_weight) * difference + ssim_weight * (count - similarity)) / count
    return torch.tensor(loss, dtype=torch.float32)


def _views(images: torch.Tensor) -> np.ndarray:
    return images.detach().contiguous().reshape(-1, *images.shape[-3:]).numpy()


def plain_photometric_loss(
    image: Float[torch.Tensor, "..."], target: Float[torch.Tensor, "..."], ssim_weight: float
) -> Float[torch.Tensor, ""]:
    """The same by plain torch operations, on any device, in any type.

    Like the kernels it blurs sum, difference and their squares: in float32, 1 - SSIM then keeps its digits where the
    images are nearly equal.
    """
    x, y = (images.reshape(-1, *images.shape[-3:]).clamp(-1e9, 1e9) for images in (image, target))
    s, d = x + y, x - y
    S, D, SS, DD = _blur(torch.cat([s, d, s * s, d * d], dim=-1).permute(0, 3, 1, 2)).chunk(4, dim=1)
    P, Q = (SS - S * S).clamp_min(0), (DD - D * D).clamp_min(0)
    light = (S * S - D * D + 2e-4) / (S * S + D * D + 2e-4)
    shape = (P - Q + 18e-4) / (P + Q + 18e-4)
    return (1 - ssim_weight) * d.abs().mean() + ssim_weight * (1 - (light * shape).mean())


def _blur(maps: torch.Tensor) -> torch.Tensor:
    """With the window of SSIM, each channel of ``(V, C, H, W)`` by itself.

    Contiguous depthwise convolutions: those torch computes in full float32 on a GPU, others it may round to TF32.
    """
    channels = maps.shape[1]
    offsets = torch.arange(-5, 6, dtype=maps.dtype, device=maps.device)
    window = torch.softmax(-offsets.square() / 4.5, dim=0).expand(channels, 1, 11)
    down = torch.nn.functional.conv2d(maps.contiguous(), window[..., None], padding=(5, 0), groups=channels)
    return torch.nn.functional.conv2d(down, window[:, :, None], padding=(0, 5), groups=channels)
