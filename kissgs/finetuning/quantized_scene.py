"""``QuantizedScene``: the differentiable decoder of fine-tuning, from latents to levels to a scene.

Every level is ``stride * round(multiple + latent)``, with the multiple of the encoding plan. The latents are trained;
their unit is the step size of the row's sensitivity class. Rounding passes gradients straight through (Bengio et al.
2013): the gradient of a decoded value becomes that of its latent. Order, rotation forms, labels and ranges are those of
the plan; the images that are written contain exactly the rounded levels.

Straight-through training alone does not converge: if the best value is between two levels, its latent oscillates across
the boundary and may end at the worse level. So a quadratic term attracts each latent to its current level, with the
curvature that the loss has there. The latent converges to the result of one Newton step from the level,
``level - gradient / curvature``, which is the same point from both levels, and is rounded to the nearer one. The
curvature follows from the costs of errors (:class:`kissgs.planning.rd_model.Costs`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.signed_log import signed_exp
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.quantize import MEANS_TOP, Quantized
from kissgs.planning.rd_model import Costs
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.rendering.rasterizer import Device
from kissgs.training.optimizer import PrunableAdam

ATTRIBUTE_FIELDS = {"quats": "quaternions", "scales": "scales", "sh0": "f_dc"}
"""Fields that hold an attribute without transformation, by attribute."""

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")
"""Trained fields of the metadata."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """One field: maps latents to levels to values.

    Attributes:
        field: levels of the plan, ``(R, C)``; one row per Gaussian, or per entry of the codebook.
        base_multiples: ``(R, C)`` float64, each level of the plan as a multiple of its stride.
        stride: ``(R, 1)`` float64, distance between the levels that a row uses.
        shift: ``(R, C)`` float64, added to multiples times stride to give levels: ``-field.level_offset``, except for
            frozen levels.
        min_latent: ``(R, C)`` float32, smallest latent whose level the image can hold; 0 for frozen levels.
        max_latent: ``(R, C)`` float32, largest such latent; 0 for frozen levels.
        low: ``(C,)`` float64, value of level 0.
        step: ``(C,)`` float64, difference of the values of consecutive levels.
    """

    field: Quantized
    base_multiples: Float64[Tensor, "R C"]
    stride: Float64[Tensor, "R 1"]
    shift: Float64[Tensor, "R C"]
    min_latent: Float32[Tensor, "R C"]
    max_latent: Float32[Tensor, "R C"]
    low: Float64[Tensor, " C"]
    step: Float64[Tensor, " C"]

    @classmethod
    def of(cls, field: Quantized, device: Device, *, freeze_top: bool = False) -> Plane:
        """Return the plane of a field; a level that is no multiple of its stride starts at the nearest multiple.

        Args:
            field: levels of the plan.
            device: device of the tensors.
            freeze_top: whether levels equal to ``field.top`` are not trained.
        """
        levels = field.levels.astype(np.float64)
        stride = np.broadcast_to(np.reshape(field.level_stride, (-1, 1)), (len(levels), 1)).astype(np.float64)
        low = field.low.astype(np.float64)
        step = (field.high.astype(np.float64) - low) / field.top
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

    def values(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return the decoded values of the levels, differentiable like :meth:`levels`."""
        return self.low + self.step * self.levels(latents)

    def quantized(self, latents: Float32[Tensor, "R C"]) -> Quantized:
        """Return the field with the levels of these latents."""
        levels = self.levels(latents.detach()).cpu().numpy()
        return replace(self.field, levels=levels.astype(self.field.levels.dtype))


class QuantizedScene:
    """An encoding plan whose levels :func:`kissgs.training.loop.train` can fit.

    Attributes:
        planes: planes by field of the metadata.
        classes: ``(M,)`` sensitivity class of each Gaussian.
        grid: cell of each Gaussian.
    """

    def __init__(self, plan: EncodingPlan, sh_degree: int, device: Device = "cpu") -> None:
        """Start from a plan; ``sh_degree`` is that of the decoded scene."""
        self._plan, self._sh_degree = plan, sh_degree
        filled, count = np.flatnonzero(plan.grid.mask), int(plan.grid.mask.sum())
        self.planes = {
            name: Plane.of(
                field if name == "f_rest_centroids" else field.take(filled),
                device,
                freeze_top=name == "means" and field.top == MEANS_TOP,
            )
            for name, field in plan.fields.items()
        }
        self.classes, self.grid = plan.classes, plan.grid
        self._labels = _Labels(plan.codebook.labels[:count], plan.codebook.side**2, device)
        self._adam = PrunableAdam({name: torch.zeros_like(plane.min_latent) for name, plane in self.planes.items()})
        self._curvature = {name: torch.zeros_like(plane.min_latent) for name, plane in self.planes.items()}

    @property
    def latents(self) -> dict[str, Tensor]:
        """Trained latents by field, ``(R, C)`` float32 each."""
        return self._adam.parameters

    def set_curvature(self, costs: Costs, loss_per_error: float) -> None:
        """Set the curvature of the quadratic attraction, 0 before, to that of the loss.

        Args:
            costs: mean squared image error per squared unit of each attribute, ``(M,)`` each.
            loss_per_error: derivative of the loss with respect to the mean squared image error.
        """
        labels = self._labels
        # All SH basis functions have one norm, so a coefficient of shN costs as much as one of the base colour.
        entries = np.bincount(labels.index.cpu().numpy(), costs.color, labels.entries)
        by_field = {
            "means": costs.position,
            "opacities": costs.opacity,
            "scales": costs.scale,
            "quaternions": 3 * costs.rotation,  # a change of a quaternion by 1 is a rotation by 2 radians
            "f_dc": costs.color,
            "f_rest_centroids": entries,
        }
        for name, plane in self.planes.items():
            cost = torch.from_numpy(np.ascontiguousarray(by_field[name])).to(plane.step.device)[:, None]
            self._curvature[name] = (2 * loss_per_error * cost * (plane.step * plane.stride) ** 2).float()

    def __len__(self) -> int:
        return len(self.latents["means"])

    def gaussians(self) -> dict[str, Tensor]:
        """Return the decoded scene by the names in :class:`kissgs.core.splats.Splats`, differentiable."""
        values = {name: self.planes[name].values(latents) for name, latents in self.latents.items()}
        decoded = {name: values[field].float() for name, field in ATTRIBUTE_FIELDS.items()}
        coefficients = SH_REST_COUNTS[self._sh_degree]
        entries = values["f_rest_centroids"].float().reshape(-1, 3, COEFFICIENTS)[:, :, :coefficients]
        decoded["shN"] = _LookUp.apply(entries.transpose(1, 2).contiguous(), self._labels)  # type: ignore[no-untyped-call]
        decoded["means"] = _SignedExp.apply(values["means"])  # type: ignore[no-untyped-call]
        decoded["opacities"] = values["opacities"][:, 0].float()
        return decoded

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an Adam step of the latents, with quadratic attraction, within the levels that the images can hold.

        Args:
            rates: learning rates by field, and ``"attraction"``: factor of the quadratic attraction, 0 to 1.
        """
        with torch.no_grad():
            for name, latents in self.latents.items():
                if latents.grad is not None:
                    plane = self.planes[name]
                    level = (torch.round(plane.base_multiples + latents) - plane.base_multiples).float()
                    latents.grad += rates["attraction"] * self._curvature[name] * (latents - level)
        self._adam.step(rates)
        with torch.no_grad():
            for name, latents in self.latents.items():
                latents.clamp_(self.planes[name].min_latent, self.planes[name].max_latent)

    def plan(self) -> EncodingPlan:
        """Return the plan with the current levels."""
        grid, former = self._plan.grid, self._plan.fields
        fields, errors = {}, dict(self._plan.errors)
        for name, latents in self.latents.items():
            field = self.planes[name].quantized(latents)
            moved = np.abs(field.values() - self.planes[name].field.values()).max(axis=0, initial=0.0)
            errors[name] = (np.array(errors[name]) + moved[: len(errors[name])]).tolist()
            fields[name] = field if name == "f_rest_centroids" else field.take(grid.cell_to_gaussian)
        return replace(
            self._plan,
            fields={name: fields[name] for name in former},
            codebook=replace(self._plan.codebook, centroids=fields["f_rest_centroids"]),
            errors=errors,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the training, see :meth:`restore`."""
        return self._adam.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state` of a scene with an equal plan."""
        self._adam.restore(state)


class _SignedExp(torch.autograd.Function):
    """sign(y) (e^|y| - 1) by the decoder's own function: computed in float64, rounded to float32."""

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


class _Labels:
    """Codebook entry of each Gaussian.

    Attributes:
        entries: number of entries.
        index: ``(M,)`` entry of each Gaussian.
        order: ``(M,)`` Gaussians sorted by entry.
        used: entries that occur, ascending.
        starts: start of each of these in ``order``.
    """

    def __init__(self, labels: Int[np.ndarray, " M"], entries: int, device: Device) -> None:
        self.entries = entries
        self.index = torch.from_numpy(labels.astype(np.int64)).to(device)
        self.order = np.argsort(labels, kind="stable")
        self.used, self.starts = np.unique(labels[self.order], return_index=True)


class _LookUp(torch.autograd.Function):
    """Codebook look-up. On the CPU, gradients are summed in a fixed order, unlike those of torch's indexing."""

    @staticmethod
    def forward(ctx: Any, entries: Float32[Tensor, "E K 3"], labels: _Labels) -> Float32[Tensor, "M K 3"]:  # noqa: ANN401
        ctx.labels = labels
        return entries[labels.index]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "M K 3"]) -> tuple[Float[Tensor, "E K 3"], None]:  # noqa: ANN401
        labels: _Labels = ctx.labels
        total = gradient.new_zeros((labels.entries, *gradient.shape[1:]))
        if gradient.device.type != "cpu":
            return total.index_add_(0, labels.index, gradient), None
        if gradient.numel():
            rows = gradient.numpy().reshape(len(gradient), -1)[labels.order]
            sums = np.add.reduceat(rows, labels.starts, axis=0)
            total.view(labels.entries, -1)[labels.used] = torch.from_numpy(sums)
        return total, None
