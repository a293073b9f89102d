"""The decoders' own functions for training: exact values forward, gradients backward."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.signed_log import signed_exp
from kissgs.finetuning.kernels import each_part, sum_by_label
from kissgs.planning import smallest_three
from kissgs.rendering.rasterizer import Device

SMALLEST_DIVISOR = 0.05
"""Smallest missing component of a rotation by which its gradient is divided."""


def positions(logs: Float64[Tensor, "..."]) -> Float32[Tensor, "..."]:
    """Return the positions of signed logarithms, sign(y) (e^|y| - 1): computed in float64, rounded to float32."""
    return _SignedExp.apply(logs)  # type: ignore[no-untyped-call]


def quaternions(small: Float64[Tensor, "M 3"], omitted: Int[Tensor, "M 1"]) -> Float32[Tensor, "M 4"]:
    """Return quaternions of length 1 from three components and the index of the missing one, which is not negative."""
    return _SmallestThree.apply(small, omitted)  # type: ignore[no-untyped-call]


class _SignedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, y: Float64[Tensor, "..."]) -> Float32[Tensor, "..."]:  # noqa: ANN401
        x = torch.from_numpy(signed_exp(y.detach().cpu().numpy())).to(y.device)
        ctx.save_for_backward(x)
        return x.float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float32[Tensor, "..."]) -> Float64[Tensor, "..."]:  # noqa: ANN401
        (x,) = ctx.saved_tensors
        return gradient.double() * (1 + x.abs())


class _SmallestThree(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, small: Float64[Tensor, "M 3"], omitted: Int[Tensor, "M 1"]) -> Float32[Tensor, "M 4"]:  # noqa: ANN401
        whole = smallest_three.whole(small.detach().cpu().numpy(), omitted[:, 0].cpu().numpy())
        quats = torch.from_numpy(whole).to(small.device)
        ctx.save_for_backward(small, omitted, quats.gather(1, omitted))
        return quats.float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float32[Tensor, "M 4"]) -> tuple[Float64[Tensor, "M 3"], None]:  # noqa: ANN401
        small, omitted, missing = ctx.saved_tensors
        kept = torch.from_numpy(smallest_three.KEPT).to(small.device)[omitted[:, 0]]
        wide = gradient.double()
        return wide.gather(1, kept) - wide.gather(1, omitted) * small / missing.clamp(SMALLEST_DIVISOR), None


class Labels:
    """Codebook entry of each Gaussian.

    Attributes:
        entries: number of entries.
        index: ``(M,)`` entry of each Gaussian.
        order: ``(M,)`` Gaussians sorted by entry.
        used: entries that occur, ascending.
        starts: start of each of these in ``order``, and its end.
    """

    def __init__(self, labels: Int[np.ndarray, " M"], entries: int, device: Device) -> None:
        self.entries = entries
        self.index = torch.from_numpy(labels.astype(np.int64)).to(device)
        self.order = np.argsort(labels, kind="stable")
        self.used, starts = np.unique(labels[self.order].astype(np.int64), return_index=True)
        self.starts = np.append(starts, len(labels))


def look_up(entries: Float32[Tensor, "E K 3"], labels: Labels) -> Float32[Tensor, "M K 3"]:
    """Return the codebook entry of each Gaussian.

    On the CPU, gradients are summed in a fixed order, unlike those of torch's indexing.
    """
    return _LookUp.apply(entries, labels)  # type: ignore[no-untyped-call]


class _LookUp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, entries: Float32[Tensor, "E K 3"], labels: Labels) -> Float32[Tensor, "M K 3"]:  # noqa: ANN401
        ctx.labels = labels
        if entries.device.type != "cpu":
            return entries[labels.index]
        out = np.empty((len(labels.index), *entries.shape[1:]), np.float32)
        np.take(entries.detach().numpy(), labels.index.numpy(), axis=0, out=out, mode="clip")
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "M K 3"]) -> tuple[Float[Tensor, "E K 3"], None]:  # noqa: ANN401
        labels: Labels = ctx.labels
        total = gradient.new_zeros((labels.entries, *gradient.shape[1:]))
        if gradient.device.type != "cpu":
            return total.index_add_(0, labels.index, gradient), None
        rows, totals = (tensor.contiguous().numpy().reshape(len(tensor), -1) for tensor in (gradient, total))

        def part(first: int, last: int) -> None:
            sum_by_label(rows, labels.order, labels.used, labels.starts, first, last, totals)

        if gradient.numel():
            each_part(part, len(labels.used), torch.get_num_threads())
        return total, None
