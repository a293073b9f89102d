"""The loss of training: mean absolute and squared difference and SSIM between a rendering and its target image."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.threads import Workers
from kissgs.rendering.metrics import differences_and_ssim

try:
    import torch
    from torch.autograd.function import BackwardCFunction, FunctionCtx, once_differentiable
except ModuleNotFoundError as error:
    raise UnsupportedError(
        "the training loss needs torch, which is not installed: pip install 'kissgs[train]'"
    ) from error


def photometric_loss(
    image: Float[torch.Tensor, "..."],
    target: Float[torch.Tensor, "..."],
    *,
    ssim_weight: float = 0.2,
    mse_weight: float = 0.0,
    threads: int = 0,
) -> Float[torch.Tensor, ""]:
    """Return (1 - w) · mean |d| + w · (1 - SSIM) + m · mean d², for the difference d = image - target.

    Where |d| is above 1, 2 |d| - 1 takes the place of d², so that a diverged pixel does not outweigh all others.
    SSIM is that of :func:`kissgs.rendering.metrics.ssim`. With m = 0 it is the loss of Kerbl et al., "3D Gaussian
    Splatting for Real-Time Radiance Field Rendering", ACM Transactions on Graphics 42 (2023), equation 7. On the CPU in
    float32 the gradient is computed together with the value; elsewhere by autograd.

    Args:
        image: ``(H, W, 3)`` or ``(C, H, W, 3)``, any values: renderings are not clamped. Values beyond ±1e9 are
            clamped; NaN gives NaN.
        target: of the same shape, dtype and device; gets no gradient.
        ssim_weight: w, from 0 to 1.
        mse_weight: m, 0 or more.
        threads: number of CPU threads; 0 means one per processor. The result does not depend on it.

    Raises:
        InvalidViewsError: the tensors are not images of the same size.
        ValueError: the target requires a gradient.
    """
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
    image: torch.Tensor,
    target: torch.Tensor,
    weights: tuple[float, float],
    threads: int,
    gradient: torch.Tensor | None,
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
    image: Float[torch.Tensor, "..."],
    target: Float[torch.Tensor, "..."],
    ssim_weight: float,
    mse_weight: float = 0.0,
) -> Float[torch.Tensor, ""]:
    """Return the loss of :func:`photometric_loss` by plain torch operations, on any device and in any dtype.

    As in the kernels, the sum, the difference and their squares are blurred, so that 1 - SSIM of nearly equal images is
    accurate in float32.
    """
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
    """Blur each channel of ``(V, C, H, W)`` with the window of SSIM.

    Contiguous depthwise convolutions, because torch computes those in full float32 on a GPU, others perhaps in TF32.
    """
    channels = maps.shape[1]
    offsets = torch.arange(-5, 6, dtype=maps.dtype, device=maps.device)
    window = torch.softmax(-offsets.square() / 4.5, dim=0).expand(channels, 1, 11)
    down = torch.nn.functional.conv2d(maps.contiguous(), window[..., None], padding=(5, 0), groups=channels)
    return torch.nn.functional.conv2d(down, window[:, :, None], padding=(0, 5), groups=channels)
