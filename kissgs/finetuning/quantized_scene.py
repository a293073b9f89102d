"""The codec as a differentiable function: levels that gradients can move, and what a decoder makes of them.

Every level is ``spacing * round(symbol + latent)``, the symbol being the multiple that was chosen. Latents are what is
learned, in units of the step that the row's class of Gaussians has. Rounding passes gradients straight through (Bengio
et al. 2013): what the loss says of a decoded value is said of its latent. Order, forms, labels and ranges stay as they
were chosen; the images that are written hold these very levels.

Straight-through training alone does not settle: where the best value lies between two levels, its latent crosses to
and fro, and ends at the worse one as often as at the better. So each latent hangs on a spring at its level, as stiff as
the loss bends there. It comes to rest where one Newton step from the level would lead, ``level - slope / bend``: that
is one place, whichever of the two levels is taken, and it is rounded to the nearer one. How fast the loss bends is
known from what errors cost in pictures (:class:`kissgs.planning.rd_model.Costs`).
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

ATTRIBUTE = {"quats": "quaternions", "scales": "scales", "sh0": "f_dc"}
"""Attributes whose values are those of a field as they are, by field."""

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """One field: from latents to levels to values.

    Attributes:
        field: levels as they were, ``(R, C)``; a row for each Gaussian, or for each entry of the codebook.
        base_multiples: ``(R, C)`` float64, which multiple of its spacing each level was.
        spacing: ``(R, 1)`` float64.
        shift: ``(R, C)`` float64, from multiples to levels: ``-field.level_offset``, but for those that must not move.
        min_latent: ``(R, C)`` float32: lowest and highest latents whose levels the image can hold; 0 for those that
            must not move.
        max_latent: see ``min_latent``.
        low: ``(C,)`` float64: value of level 0.
        step: ``(C,)`` float64: distance of the values of two levels.
    """

    field: Quantized
    base_multiples: Float64[Tensor, "R C"]
    spacing: Float64[Tensor, "R 1"]
    shift: Float64[Tensor, "R C"]
    min_latent: Float32[Tensor, "R C"]
    max_latent: Float32[Tensor, "R C"]
    low: Float64[Tensor, " C"]
    step: Float64[Tensor, " C"]

    @classmethod
    def of(cls, field: Quantized, device: Device, *, pinned: bool = False) -> Plane:
        """A level that is no multiple of its spacing begins at the nearest; ``pinned``: the top level stays."""
        levels = field.levels.astype(np.float64)
        spacing = np.broadcast_to(np.reshape(field.level_stride, (-1, 1)), (len(levels), 1)).astype(np.float64)
        low = field.low.astype(np.float64)
        step = (field.high.astype(np.float64) - low) / field.top
        first, last = np.ceil(field.level_offset / spacing), np.floor((field.top + field.level_offset) / spacing)
        fixed = (first > last) | (step == 0) | (pinned & (levels == field.top))
        symbols = np.rint((levels + field.level_offset) / spacing)
        symbols = np.where(fixed, symbols, np.clip(symbols, first, last))
        shift = np.where(fixed, levels - symbols * spacing, -field.level_offset)
        bounds = (np.where(fixed, 0, bound - symbols).astype(np.float32) for bound in (first, last))
        arrays = (symbols, spacing, shift, *bounds, low, step)
        return cls(field, *(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Whole numbers from 0 to the field's top, with the gradient of the latents as they are, without rounding."""
        whole = torch.round(self.base_multiples + latents.detach())
        return (whole + (latents - latents.detach())) * self.spacing + self.shift

    def values(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """What a decoder makes of the levels, with the same gradient."""
        return self.low + self.step * self.levels(latents)

    def quantized(self, latents: Float32[Tensor, "R C"]) -> Quantized:
        """The field with these levels."""
        levels = self.levels(latents.detach()).cpu().numpy()
        return replace(self.field, levels=levels.astype(self.field.levels.dtype))


class QuantizedScene:
    """A choice that is being improved: what :func:`kissgs.training.loop.train` fits.

    Attributes:
        planes: by field of the metadata.
        classes: ``(M,)`` kind of each Gaussian.
        grid: which Gaussian sits where.
    """

    def __init__(self, choice: EncodingPlan, sh_degree: int, device: Device = "cpu") -> None:
        self._choice, self._sh_degree = choice, sh_degree
        shown, count = np.flatnonzero(choice.grid.mask), int(choice.grid.mask.sum())
        self.planes = {
            name: Plane.of(
                field if name == "f_rest_centroids" else field.take(shown),
                device,
                pinned=name == "means" and field.top == MEANS_TOP,
            )
            for name, field in choice.fields.items()
        }
        self.classes, self.grid = choice.classes, choice.grid
        self._labels = _Labels(choice.codebook.labels[:count], choice.codebook.side**2, device)
        self._leaves = PrunableAdam({name: torch.zeros_like(plane.min_latent) for name, plane in self.planes.items()})
        self._bend = {name: torch.zeros_like(plane.min_latent) for name, plane in self.planes.items()}

    @property
    def latents(self) -> dict[str, Tensor]:
        """What is learned, by field."""
        return self._leaves.by_name

    def hang(self, costs: Costs, steepness: float) -> None:
        """Make the springs as stiff as the loss bends: by what errors cost in pictures. Before, there are none.

        Args:
            costs: mean squared error of pictures by an error of one unit, ``(M,)`` for each attribute.
            steepness: how much the loss grows with that error.
        """
        labels = self._labels
        # An error of a coefficient of gloss costs what one of the base colour does: all are of one norm.
        entries = np.bincount(labels.index.cpu().numpy(), costs.color, labels.entries)
        of = {
            "means": costs.position,
            "opacities": costs.opacity,
            "scales": costs.scale,
            "quaternions": 3 * costs.rotation,  # a quaternion's change of 1 turns by 2
            "f_dc": costs.color,
            "f_rest_centroids": entries,
        }
        for name, plane in self.planes.items():
            cost = torch.from_numpy(np.ascontiguousarray(of[name])).to(plane.step.device)[:, None]
            self._bend[name] = (2 * steepness * cost * (plane.step * plane.spacing) ** 2).float()

    def __len__(self) -> int:
        return len(self.latents["means"])

    def gaussians(self) -> dict[str, Tensor]:
        """What a decoder makes of the levels, by the names in :class:`kissgs.core.splats.Splats`."""
        values = {name: self.planes[name].values(latents) for name, latents in self.latents.items()}
        shown = {name: values[field].float() for name, field in ATTRIBUTE.items()}
        kinds = SH_REST_COUNTS[self._sh_degree]
        entries = values["f_rest_centroids"].float().reshape(-1, 3, COEFFICIENTS)[:, :, :kinds]
        shown["shN"] = _Entries.apply(entries.transpose(1, 2).contiguous(), self._labels)  # type: ignore[no-untyped-call]
        shown["means"] = _SignedExp.apply(values["means"])  # type: ignore[no-untyped-call]
        shown["opacities"] = values["opacities"][:, 0].float()
        return shown

    def step(self, rates: Mapping[str, float]) -> None:
        """Move the latents against their gradients and springs, as far as the images can hold their levels.

        Args:
            rates: learning rates by field; and ``"spring"``, the share of the springs' strength.
        """
        with torch.no_grad():
            for name, latents in self.latents.items():
                if latents.grad is not None:
                    plane = self.planes[name]
                    level = (torch.round(plane.base_multiples + latents) - plane.base_multiples).float()
                    latents.grad += rates["spring"] * self._bend[name] * (latents - level)
        self._leaves.step(rates)
        with torch.no_grad():
            for name, latents in self.latents.items():
                latents.clamp_(self.planes[name].min_latent, self.planes[name].max_latent)

    def choice(self) -> EncodingPlan:
        """The choice with the levels as they are now."""
        grid, before = self._choice.grid, self._choice.fields
        fields, errors = {}, dict(self._choice.errors)
        for name, latents in self.latents.items():
            field = self.planes[name].quantized(latents)
            moved = np.abs(field.values() - self.planes[name].field.values()).max(axis=0, initial=0.0)
            errors[name] = (np.array(errors[name]) + moved[: len(errors[name])]).tolist()
            fields[name] = field if name == "f_rest_centroids" else field.take(grid.cell_to_gaussian)
        return replace(
            self._choice,
            fields={name: fields[name] for name in before},
            codebook=replace(self._choice.codebook, centroids=fields["f_rest_centroids"]),
            errors=errors,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Everything, to go on from later."""
        return self._leaves.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from there."""
        self._leaves.restore(state)


class _SignedExp(torch.autograd.Function):
    """sign(y) (e^|y| - 1), by the very function that the decoder uses; in float64, rounded to float32."""

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
    """Which Gaussians share an entry, sorted once."""

    def __init__(self, labels: Int[np.ndarray, " M"], entries: int, device: Device) -> None:
        self.entries = entries
        self.index = torch.from_numpy(labels.astype(np.int64)).to(device)
        self.order = np.argsort(labels, kind="stable")
        self.used, self.starts = np.unique(labels[self.order], return_index=True)


class _Entries(torch.autograd.Function):
    """Its entry for each Gaussian. On the processor gradients are summed in a fixed order, unlike torch's own."""

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
