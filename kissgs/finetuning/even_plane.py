"""``EvenPlane``: levels that are evenly spaced over a range per channel, of which a row uses multiples of its stride.

Every level is ``stride * round(multiple + latent)``, with the multiple of the encoding plan. The unit of a latent is
the step size of the row's sensitivity class.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float32, Float64
from kissgs.finetuning import kernels
from kissgs.planning.quantize import Quantized
from kissgs.rendering.rasterizer import Device


@dataclass(frozen=True, slots=True, eq=False)
class EvenPlane:
    """One field: maps latents to levels to values.

    Attributes:
        field: levels of the plan, ``(R, C)``; one row per Gaussian, or per entry of the codebook.
        base_multiples: ``(R, C)`` float64, each level of the plan as a multiple of its stride.
        stride: ``(R, 1)`` or ``(R, C)`` float64, distance between the levels that a row uses.
        shift: ``(R, C)`` float64, added to multiples times stride to give levels: ``-field.level_offset``, except for
            frozen levels.
        min_latent: ``(R, C)`` float32, smallest latent whose level the image can hold; 0 for frozen levels.
        max_latent: ``(R, C)`` float32, largest such latent; 0 for frozen levels.
        low: ``(C,)`` float64, value of level 0.
        step: ``(C,)`` float64, difference of the values of consecutive levels.
    """

    field: Quantized
    base_multiples: Float64[Tensor, "R C"]
    stride: Float64[Tensor, "R _"]
    shift: Float64[Tensor, "R C"]
    min_latent: Float32[Tensor, "R C"]
    max_latent: Float32[Tensor, "R C"]
    low: Float64[Tensor, " C"]
    step: Float64[Tensor, " C"]

    @classmethod
    def of(cls, field: Quantized, device: Device, *, freeze_top: bool = False, as_text: bool = False) -> EvenPlane:
        """Return the plane of a field; a level that is no multiple of its stride starts at the nearest multiple.

        Args:
            field: levels of the plan.
            device: device of the tensors.
            freeze_top: whether levels equal to ``field.top`` are not trained.
            as_text: whether decoders read the range as the shortest decimal numbers of its float32, as from JSON.
        """
        levels = field.levels.astype(np.float64)
        stride = np.asarray(field.level_stride)
        stride = stride if stride.ndim == 2 else np.reshape(stride, (-1, 1))
        stride = np.broadcast_to(stride, (len(levels), stride.shape[1])).astype(np.float64)
        low, high = (_as_read(end) if as_text else end.astype(np.float64) for end in (field.low, field.high))
        step = (high - low) / field.top
        first, last = np.ceil(field.level_offset / stride), np.floor((field.top + field.level_offset) / stride)
        frozen = (first > last) | (step == 0) | (freeze_top & (levels == field.top))
        multiples = np.rint((levels + field.level_offset) / stride)
        multiples = np.where(frozen, multiples, np.clip(multiples, first, last))
        shift = np.where(frozen, levels - multiples * stride, -field.level_offset)
        bounds = (np.where(frozen, 0, bound - multiples).astype(np.float32) for bound in (first, last))
        arrays = (multiples, stride, shift, *bounds, low, step)
        return cls(field, *(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return levels, whole numbers from 0 to the field's top; their gradient ignores the rounding."""
        multiples = torch.round(self.base_multiples + latents.detach())
        return (multiples + (latents - latents.detach())) * self.stride + self.shift

    def values(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the decoded values of the levels, differentiable like :meth:`levels`; there is no ``table``."""
        if latents.device.type == "cpu":
            return _Values.apply(latents, self)  # type: ignore[no-untyped-call]
        return self.low + self.step * self.levels(latents)

    def add_attraction(
        self,
        gradient: Float32[Tensor, "R C"],
        latents: Float32[Tensor, "R C"],
        weights: Float64[Tensor, "R 1"],
        factor: float,
    ) -> None:
        """Add the gradient of the quadratic attraction of each latent to its current level, on the CPU.

        Args:
            gradient: gradient by the latents; changed.
            latents: the latents.
            weights: curvature of the loss by the values.
            factor: factor of the attraction.
        """
        base, stride, step = self.base_multiples.numpy(), self.stride.numpy(), self.step.numpy()
        values, curvature, slopes = latents.detach().numpy(), weights.numpy(), gradient.numpy()

        def part(first: int, last: int) -> None:
            kernels.attract(base, values, stride, step, curvature, factor, first, last, slopes)

        kernels.each_part(part, len(latents), torch.get_num_threads())

    def units(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the change of each value per unit of its latent."""
        return self.step * self.stride

    def quantized(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Quantized:
        """Return the field with the levels of these latents."""
        levels = self.levels(latents.detach()).cpu().numpy()
        return replace(self.field, levels=levels.astype(self.field.levels.dtype))


class _Values(torch.autograd.Function):
    """Decoded values on the CPU; the gradient ignores the rounding."""

    @staticmethod
    def forward(ctx: Any, latents: Float32[Tensor, "R C"], plane: EvenPlane) -> Float64[Tensor, "R C"]:  # noqa: ANN401
        ctx.plane = plane
        base, stride, shift = plane.base_multiples.numpy(), plane.stride.numpy(), plane.shift.numpy()
        low, step, found = plane.low.numpy(), plane.step.numpy(), latents.detach().contiguous().numpy()
        values = np.empty(tuple(latents.shape), np.float64)

        def part(first: int, last: int) -> None:
            kernels.even_values(base, found, stride, shift, low, step, first, last, values)

        kernels.each_part(part, len(values), torch.get_num_threads())
        return torch.from_numpy(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float64[Tensor, "R C"]) -> tuple[Float32[Tensor, "R C"], None]:  # noqa: ANN401
        plane: EvenPlane = ctx.plane
        v_values, stride, step = gradient.contiguous().numpy(), plane.stride.numpy(), plane.step.numpy()
        v_latents = np.empty(tuple(gradient.shape), np.float32)

        def part(first: int, last: int) -> None:
            kernels.even_values_backward(v_values, stride, step, first, last, v_latents)

        kernels.each_part(part, len(v_latents), torch.get_num_threads())
        return torch.from_numpy(v_latents), None


def _as_read(end: Float32[np.ndarray, " C"]) -> Float64[np.ndarray, " C"]:
    return np.array([float(str(value)) for value in end])
