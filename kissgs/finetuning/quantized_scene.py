"""``QuantizedScene``: the differentiable decoder of fine-tuning, from latents to levels to a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.signed_log import signed_exp
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.finetuning.kernels import each_part, sum_by_label
from kissgs.finetuning.planes import planes_of
from kissgs.planning import smallest_three
from kissgs.planning.container_model import EVEN_LEVELS, ContainerModel
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.quantize import Quantized
from kissgs.planning.rd_criterion import Costs
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.planning.table_fields import decoded_quats
from kissgs.rendering.rasterizer import Device
from kissgs.training.optimizer import PrunableAdam

# The decoders' own functions for training: exact values forward, gradients backward.

SMALLEST_DIVISOR = 0.05
"""Smallest missing component of a rotation by which its gradient is divided."""


class _SignedExp(torch.autograd.Function):
    """Positions of signed logarithms, sign(y) (e^|y| - 1): computed in float64, rounded to float32."""

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
    """Quaternions of length 1 from three components and the index of the missing one, which is not negative."""

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
    """Codebook entry of each Gaussian."""

    def __init__(self, labels: Int[np.ndarray, " M"], entries: int, device: Device) -> None:
        self.entries = entries
        self.index = torch.from_numpy(labels.astype(np.int64)).to(device)
        self.order = np.argsort(labels, kind="stable")
        self.used, starts = np.unique(labels[self.order].astype(np.int64), return_index=True)
        self.starts = np.append(starts, len(labels))


class _LookUp(torch.autograd.Function):
    """Codebook entry of each Gaussian. On the CPU, gradients are summed in a fixed order, unlike those of torch."""

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


# ``QuantizedScene``: the differentiable decoder of fine-tuning, from latents to levels to a scene.
#
# Every level has a latent, which is rounded to one of the levels that its row may use
# (:class:`~kissgs.finetuning.planes.Plane`). Free tables of values are trained as well. The unit of a latent is the
# step size of the row's sensitivity class. Rounding passes gradients straight through (Bengio et al. 2013): the
# gradient of a decoded value becomes that of its latent. Order, rotation forms, labels and ranges are those of the
# plan; the images that are written contain exactly the rounded levels.
#
# Straight-through training alone does not converge: if the best value is between two levels, its latent oscillates
# across the boundary and may end at the worse level. So a quadratic term attracts each latent to its current level,
# with the curvature that the loss has there. The latent converges to the result of one Newton step from the level,
# ``level - gradient / curvature``, which is the same point from both levels, and is rounded to the nearer one. The
# curvature follows from the costs of errors (:class:`kissgs.planning.rd_criterion.Costs`).

ATTRIBUTE_FIELDS = {"quats": "quaternions", "scales": "scales", "sh0": "f_dc"}
"""Fields that hold an attribute without transformation, by attribute."""


class QuantizedScene:
    """An encoding plan whose levels :func:`kissgs.training.loop.train` can fit."""

    def __init__(
        self, plan: EncodingPlan, sh_degree: int, device: Device = "cpu", container: ContainerModel = EVEN_LEVELS
    ) -> None:
        """Start from a plan for ``container``; ``sh_degree`` is that of the decoded scene."""
        self._plan, self._sh_degree = plan, sh_degree
        count = int(plan.grid.mask.sum())
        self.planes, self.trained_tables = planes_of(plan, sh_degree, container.tables, device)
        self.classes, self.grid = plan.classes.astype(np.int64), plan.grid
        self._labels = Labels(plan.codebook.labels[:count], len(plan.codebook.centroids.levels), device)
        self._omitted = None
        if "omitted" in plan.fields:
            omitted = plan.fields["omitted"].take(plan.grid.mask).levels.astype(np.int64)
            self._omitted = torch.from_numpy(omitted).to(device)
        trained = {name: plane.min_latent for name, plane in self.planes.items()}
        trained |= {table_name(name): table.min_latent for name, table in self.trained_tables.items()}
        self._adam = PrunableAdam({name: torch.zeros_like(latent) for name, latent in trained.items()})
        self._weights: dict[str, Tensor] = {}

    @property
    def latents(self) -> dict[str, Tensor]:
        """Trained latents of the levels by field, ``(R, C)`` float32 each."""
        parameters = self._adam.parameters
        return {name: parameters[name] for name in self.planes}

    @property
    def table_latents(self) -> dict[str, Tensor]:
        """Trained latents of the tables by field, ``(L,)`` float32 each; empty for even levels."""
        parameters = self._adam.parameters
        return {name: parameters[table_name(name)] for name in self.trained_tables}

    def tables(self) -> dict[str, Tensor]:
        """Return the values of the trained tables by field, ``(L,)`` float64 each, differentiable."""
        return {name: self.trained_tables[name].values(latents) for name, latents in self.table_latents.items()}

    def set_curvature(self, costs: Costs, loss_per_error: float) -> None:
        """Set the curvature of the quadratic attraction, 0 before, from the loss per mean squared image error."""
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
        for name, latents in self.latents.items():
            cost = torch.from_numpy(np.ascontiguousarray(by_field[name])).to(latents.device)[:, None]
            self._weights[name] = 2 * loss_per_error * cost

    def __len__(self) -> int:
        return len(self.latents["means"])

    def gaussians(self) -> dict[str, Tensor]:
        """Return the decoded scene by the names in :class:`kissgs.core.splats.Splats`, differentiable."""
        tables = self.tables()
        values = {name: self.planes[name].values(latents, tables.get(name)) for name, latents in self.latents.items()}
        decoded = {name: values[field].float() for name, field in ATTRIBUTE_FIELDS.items()}
        if self._omitted is not None:
            decoded["quats"] = _SmallestThree.apply(values["quaternions"], self._omitted)  # type: ignore[no-untyped-call]
        coefficients = SH_REST_COUNTS[self._sh_degree]
        entries = values["f_rest_centroids"].float().reshape(-1, 3, COEFFICIENTS)[:, :, :coefficients]
        decoded["shN"] = _LookUp.apply(entries.transpose(1, 2).contiguous(), self._labels)  # type: ignore[no-untyped-call]
        decoded["means"] = _SignedExp.apply(values["means"])  # type: ignore[no-untyped-call]
        decoded["opacities"] = values["opacities"][:, 0].float()
        return decoded

    @property
    def antialiased(self) -> bool:
        """See :class:`kissgs.Splats`."""
        return self._plan.scene.antialiased

    @property
    def receive(self) -> None:
        """There is no receiver of gradients: autograd passes them on to the latents."""

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an Adam step of the latents, with quadratic attraction, within the levels that the images can hold.

        ``rates`` has learning rates by field and :func:`table_name`, and the factor of the ``"attraction"``, 0 to 1.
        """
        rotations = self.latents["quaternions"].detach().clone() if self._omitted is not None else None
        if self._weights and rates["attraction"] > 0:
            self._attract(rates["attraction"])
        self._adam.step(rates)
        with torch.no_grad():
            for name, latents in self.latents.items():
                latents.clamp_(self.planes[name].min_latent, self.planes[name].max_latent)
            for name, latents in self.table_latents.items():
                latents.clamp_(self.trained_tables[name].min_latent, self.trained_tables[name].max_latent)
            if rotations is not None:
                self._keep_unit_length(rotations)

    def _attract(self, factor: float) -> None:
        """Add the gradient of the quadratic attraction of each latent to its current level."""
        with torch.no_grad():
            tables = self.tables()
            for name, latents in self.latents.items():
                if latents.grad is not None:
                    self.planes[name].attract(latents.grad, latents, tables.get(name), self._weights[name], factor)

    def _keep_unit_length(self, former: Float32[Tensor, "M 3"]) -> None:
        """Take back a step after which the three components of a rotation leave no room for a fourth."""
        latents = self.latents["quaternions"]
        squares = self.planes["quaternions"].values(latents).square().sum(dim=1, keepdim=True)
        latents.copy_(torch.where(squares > 1, former, latents))

    def plan(self) -> EncodingPlan:
        """Return the plan with the current levels and tables."""
        grid, former = self._plan.grid, self._plan.fields
        filled, tables = np.flatnonzero(grid.mask), self.tables()
        before = {name: field if name == "f_rest_centroids" else field.take(filled) for name, field in former.items()}
        after = {**before}
        for name, latents in self.latents.items():
            after[name] = self.planes[name].quantized(latents, tables.get(name))
        errors = dict(self._plan.errors)
        used = np.unique(self._labels.index.cpu().numpy())  # the rate moves other entries too, which matter to nothing
        for name, error in errors.items():
            one, other = (_values(name, fields) for fields in (before, after))
            moved = np.abs(other - one)
            moved = (moved[used] if name == "f_rest_centroids" else moved).max(axis=0, initial=0.0)
            errors[name] = (np.array(error) + moved[: len(error)]).tolist()
        fields = {
            name: after[name] if name == "f_rest_centroids" else after[name].take(grid.cell_to_gaussian)
            for name in former
        }
        return replace(
            self._plan,
            fields=fields,
            codebook=replace(self._plan.codebook, centroids=fields["f_rest_centroids"]),
            errors=errors,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the training, see :meth:`restore`."""
        return self._adam.state()

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state` of a scene with an equal plan."""
        self._adam.restore(state)


def table_name(field: str) -> str:
    """Return the name of the learning rate of a field's table."""
    return f"{field}.table"


def _values(name: str, fields: Mapping[str, Quantized]) -> Float64[np.ndarray, "R C"]:
    return decoded_quats(dict(fields)) if name == "quaternions" else fields[name].values()
