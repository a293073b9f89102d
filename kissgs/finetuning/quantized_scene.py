"""``QuantizedScene``: the differentiable decoder of fine-tuning, and the loss terms of the container's size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.context import Device, Pace, blas_workers
from kissgs.core.positions import signed_exp
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.finetuning.planes import Ctx, Plane, each_part, level_bits, planes_of, sum_by_label
from kissgs.planning import rotation_forms
from kissgs.planning.layout import Grid
from kissgs.planning.planner import EncodingPlan
from kissgs.planning.quantize import EVEN_LEVELS, ContainerModel, Quantized, half_steps, quantize
from kissgs.planning.rd_fields import UNUSED_COUNT, Costs, decoded_quats
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.rendering.differentiable import Parameters
from kissgs.training.loop import Regularizer
from kissgs.training.model import PrunableAdam

# The decoders' own functions for training: exact values forward, gradients backward.

SMALLEST_DIVISOR = 0.05  # smallest missing component of a rotation by which its gradient is divided


class _SignedExp(torch.autograd.Function):
    """Positions of signed logarithms, sign(y) (e^|y| - 1): computed in float64, rounded to float32."""

    @staticmethod
    def forward(ctx: Ctx, y: Float64[Tensor, "..."]) -> Float32[Tensor, "..."]:
        x = torch.from_numpy(signed_exp(y.detach().cpu().numpy())).to(y.device)
        ctx.save_for_backward(x)
        return x.float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Ctx, gradient: Float32[Tensor, "..."]) -> Float64[Tensor, "..."]:
        (x,) = ctx.saved_tensors
        return gradient.double() * (1 + x.abs())


class _SmallestThree(torch.autograd.Function):
    """Quaternions of length 1 from three components and the index of the missing one, which is not negative."""

    @staticmethod
    def forward(ctx: Ctx, small: Float64[Tensor, "M 3"], omitted: Int[Tensor, "M 1"]) -> Float32[Tensor, "M 4"]:
        whole = rotation_forms.whole(small.detach().cpu().numpy(), omitted[:, 0].cpu().numpy())
        quats = torch.from_numpy(whole).to(small.device)
        ctx.save_for_backward(small, omitted, quats.gather(1, omitted))
        return quats.float()

    @staticmethod
    @once_differentiable
    def backward(ctx: Ctx, gradient: Float32[Tensor, "M 4"]) -> tuple[Float64[Tensor, "M 3"], None]:
        small, omitted, missing = ctx.saved_tensors
        kept = torch.from_numpy(rotation_forms.KEPT).to(small.device)[omitted[:, 0]]
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
    def forward(ctx: Ctx, entries: Float32[Tensor, "E K 3"], labels: Labels) -> Float32[Tensor, "M K 3"]:
        ctx.labels = labels
        if entries.device.type != "cpu":
            return entries[labels.index]
        out = np.empty((len(labels.index), *entries.shape[1:]), np.float32)
        np.take(entries.detach().numpy(), labels.index.numpy(), axis=0, out=out, mode="clip")
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Ctx, gradient: Float[Tensor, "M K 3"]) -> tuple[Float[Tensor, "E K 3"], None]:
        labels: Labels = ctx.labels
        total = gradient.new_zeros((labels.entries, *gradient.shape[1:]))
        if gradient.device.type != "cpu":
            return total.index_add_(0, labels.index, gradient), None
        rows, totals = (tensor.contiguous().numpy().reshape(len(tensor), -1) for tensor in (gradient, total))
        if gradient.numel():
            own = labels.order, labels.used, labels.starts
            each_part(lambda first, last: sum_by_label(rows, *own, first, last, totals), len(labels.used))
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
# curvature follows from the costs of errors (:class:`kissgs.planning.rd_fields.Costs`).

ATTRIBUTE_FIELDS = {"quats": "quaternions", "scales": "scales", "sh0": "f_dc"}  # without transformation
REFORMED = ("quaternions", "scales")  # fields that another form of a Gaussian changes


class QuantizedScene:
    """An encoding plan whose levels :func:`kissgs.training.loop.train` can fit."""

    def __init__(
        self, plan: EncodingPlan, sh_degree: int, device: Device = "cpu", container: ContainerModel = EVEN_LEVELS
    ) -> None:
        """Start from a plan for ``container``; ``sh_degree`` is that of the decoded scene."""
        self._plan, self._sh_degree, self._device = plan, sh_degree, device
        self._rates_of_attributes, self._reformed = False, dict[str, Quantized]()
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

    def take_rates_of_attributes(self) -> None:
        """Take learning rates in units of attributes, those of positions at the slope of their logarithm now."""
        self._rates_of_attributes = True
        for name, latents in self._adam.parameters.items():
            self._adam.replace(name, latents, self._per_unit(name))

    def _per_unit(self, name: str) -> Tensor:
        """Return the latents of one unit of the attribute, at the plan's levels; 0 for what cannot change."""
        if name not in self.planes:
            unit = self.trained_tables[name.removesuffix(".table")].unit
        else:
            plane, level = self.planes[name], torch.zeros_like(self.planes[name].min_latent)
            unit = plane.units(level) * (plane.values(level).abs().exp() if name == "means" else 1)
        return torch.where(unit > 0, 1 / unit, 0).float()

    def choose_forms(self, decay: float, threads: int) -> None:
        """Choose the forms of rotations and scales anew by PRAS, and round both in new ranges, as the paper does."""
        grid, exact = self._plan.grid, dict[str, Float64[np.ndarray, "M C"]]()
        for name in REFORMED:
            plane, latents = self.planes[name], self.latents[name].detach()
            place = plane.base_multiples + latents
            beside = plane.units(latents) * (place - torch.round(place))
            exact[name] = (plane.values(latents) + beside).cpu().numpy()
        quats, scales = exact["quaternions"], exact["scales"].astype(np.float32)
        quats /= np.linalg.norm(quats, axis=1, keepdims=True)
        with blas_workers(threads) as pool:
            rows = grid.cell_to_gaussian
            forms = rotation_forms.pras_forms(quats[rows], scales[rows], grid.side, pool, decay=decay)[grid.mask]
        for name, values in zip(REFORMED, rotation_forms.apply_forms(quats, scales, forms), strict=True):
            self._adopt(name, quantize(values, step=1, shared=False, max_top=self.planes[name].field.top), values)

    def _adopt(self, name: str, field: Quantized, values: Float[np.ndarray, "M C"]) -> None:
        """Continue with other levels and ranges of a field, and with latents of these values, which it rounds."""
        self._reformed[name] = field
        fields = {**self._plan.fields, name: field.take(self._plan.grid.cell_to_gaussian)}
        self._plan = replace(self._plan, fields=fields, errors={**self._plan.errors, name: half_steps(field)})
        plane = self.planes[name] = Plane.even(field, self._device)
        per_unit, rounded = self._per_unit(name), plane.values(torch.zeros_like(plane.min_latent))
        latents = ((torch.from_numpy(values).to(self._device) - rounded) * per_unit).float()
        latents.clamp_(plane.min_latent, plane.max_latent)
        self._adam.replace(name, latents, per_unit if self._rates_of_attributes else None)

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
        ``rates`` has learning rates by field and :func:`table_name`, and the factor of the ``"attraction"``, 0 to 1."""
        rotations = self.latents["quaternions"].detach().clone() if self._omitted is not None else None
        if self._weights and rates["attraction"] > 0:
            with torch.no_grad():
                tables = self.tables()
                for name, latents in self.latents.items():
                    if latents.grad is not None:
                        plane, factor = self.planes[name], rates["attraction"]
                        plane.attract(latents.grad, latents, tables.get(name), self._weights[name], factor)
        self._adam.step(rates)
        with torch.no_grad():
            for name, latents in self.latents.items():
                latents.clamp_(self.planes[name].min_latent, self.planes[name].max_latent)
            for name, latents in self.table_latents.items():
                latents.clamp_(self.trained_tables[name].min_latent, self.trained_tables[name].max_latent)
            if rotations is not None:  # a step is taken back if three components leave no room for a fourth
                latents = self.latents["quaternions"]
                squares = self.planes["quaternions"].values(latents).square().sum(dim=1, keepdim=True)
                latents.copy_(torch.where(squares > 1, rotations, latents))

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
        codebook = replace(self._plan.codebook, centroids=fields["f_rest_centroids"])
        return replace(self._plan, fields=fields, codebook=codebook, errors=errors)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state of the training, see :meth:`restore`."""
        levels = {f"{name}.levels": field.levels for name, field in self._reformed.items()}
        return {**self._adam.state(), **levels, **{f"{n}.values": each.table for n, each in self._reformed.items()}}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state` of a scene with an equal plan."""
        for name in REFORMED:
            if f"{name}.levels" in state:
                field = Quantized(state[f"{name}.levels"], state[f"{name}.values"])
                self._adopt(name, field, field.values())
        self._adam.restore(state)


def table_name(field: str) -> str:
    """Return the name of the learning rate of a field's table."""
    return f"{field}.table"


def _values(name: str, fields: Mapping[str, Quantized]) -> Float64[np.ndarray, "R C"]:
    return decoded_quats(dict(fields)) if name == "quaternions" else fields[name].values()


# ``CodebookRate``: estimated bits of the SH codebook's image, for fine-tuning.

DIFFERENCE_OFFSET = 0.3  # added to mean differences, levels; it bounds the bits where neighbours are equal


class CodebookRate:
    """Bits of the square image of an SH codebook. WebP subtracts green from red and blue, predicts each from its
    neighbours, and codes the rest. So the bits of a level are those of its difference from the entries beside and above
    it, in Laplace distributions: the mean of both differences, over ln 2 times the mean difference of its colour and
    coefficient. Only their derivative matters; the constant is left out."""

    table: Float32[np.ndarray, "3 15"]  # mean difference plus DIFFERENCE_OFFSET of red - green, green and blue - green

    def __init__(self, plane: Plane) -> None:
        """Prepare the rate of the codebook ``plane``, of S · S entries in row-major order."""
        self._base = plane.base_multiples.float()
        self._side = math.isqrt(len(self._base))
        self.table = np.ones((3, COEFFICIENTS), np.float32)

    def count(self, latents: Float32[Tensor, "entries 45"]) -> None:
        """Set the table from the current levels."""
        with torch.no_grad():
            beside, above = self._differences(torch.round(self._base + latents) - self._base)
        # By NumPy, whose sums do not depend on the number of threads.
        means = [difference.abs().cpu().numpy().mean(axis=(0, 1), dtype=np.float64) for difference in (beside, above)]
        self.table = (np.mean(means, axis=0) + DIFFERENCE_OFFSET).astype(np.float32)

    def bits(self, latents: Float32[Tensor, "entries 45"]) -> Tensor:
        """Return the bits of all levels together but for a constant, a scalar."""
        beside, above = self._differences(latents)
        per_level = torch.from_numpy(0.5 / (math.log(2) * self.table)).to(latents.device)
        return (beside.abs() * per_level).sum() + (above.abs() * per_level).sum()

    def _differences(self, latents: Float32[Tensor, "entries 45"]) -> tuple[Tensor, Tensor]:
        """Return the differences of neighbouring entries, ``(S, S - 1, 3, 15)`` and ``(S - 1, S, 3, 15)``."""
        levels = (self._base + latents).reshape(self._side, self._side, 3, COEFFICIENTS)
        red, green, blue = levels.unbind(dim=2)
        colors = torch.stack([red - green, green, blue - green], dim=2)
        return colors[:, 1:] - colors[:, :-1], colors[1:] - colors[:-1]


class _LevelRate:
    table: Float32[np.ndarray, "classes channels symbols"]  # bits of each level; the last entry is repeated

    def __init__(self, plane: Plane, classes: Int[np.ndarray, " M"], channels: Int[np.ndarray, " C"]) -> None:
        """Prepare the rate of ``plane``; rows of one of ``classes`` and columns of one of ``channels`` share a code."""
        multiples = plane.base_multiples.cpu().numpy()
        first = int(np.floor(multiples + plane.min_latent.cpu().numpy()).min(initial=0))
        self._symbols = int(np.ceil(multiples + plane.max_latent.cpu().numpy()).max(initial=0)) - first + 1
        number = int(channels.max(initial=-1)) + 1
        rows = (classes[:, None] * number + channels) * (self._symbols + 1)
        self._rows = torch.from_numpy(rows).to(plane.base_multiples.device)
        self._base: Float64[Tensor, "M C"] = plane.base_multiples - first
        self.table = np.zeros((int(classes.max(initial=0)) + 1, number, self._symbols + 1), np.float32)

    def count(self, latents: Float32[Tensor, "M C"]) -> None:
        """Set the table from the histograms of the current levels."""
        symbols = np.rint(self._base.cpu().numpy() + latents.detach().cpu().numpy()).astype(np.int64)
        rows = self._rows.cpu().numpy() + symbols
        counts = np.bincount(rows.reshape(-1), minlength=self.table.size).reshape(self.table.shape)
        frequencies = counts[:, :, :-1] + UNUSED_COUNT
        self.table[:, :, :-1] = np.log2(frequencies.sum(axis=2, keepdims=True)) - np.log2(frequencies)
        self.table[:, :, -1] = self.table[:, :, -2]

    def bits(self, latents: Float32[Tensor, "M C"]) -> Tensor:
        """Return the bits of all levels together, a scalar."""
        table = torch.from_numpy(self.table.reshape(-1))
        if latents.device.type == "cpu":
            return _Bits.apply(latents, self._base, self._rows, table, self._symbols)  # type: ignore[no-untyped-call]
        position = self._base + latents
        below = torch.floor(position.detach()).clamp(0, self._symbols - 1)
        index, table = self._rows + below.long(), table.to(latents.device)
        lower, upper = table[index], table[index + 1]
        return (lower + (position - below).float() * (upper - lower)).sum()


class _Bits(torch.autograd.Function):
    """Bits of all levels on the CPU, independent of the number of threads."""

    @staticmethod
    def forward(
        ctx: Ctx,
        latents: Float32[Tensor, "M C"],
        base: Float64[Tensor, "M C"],
        rows: Int[Tensor, "M C"],
        table: Float32[Tensor, " T"],
        symbols: int,
    ) -> Tensor:
        start, codes, bits_of = base.numpy(), rows.numpy(), table.numpy()
        found = latents.detach().contiguous().numpy()
        slopes = np.empty(tuple(latents.shape), np.float32)

        def part(first: int, last: int) -> float:
            return float(level_bits(start, found, codes, bits_of, symbols, first, last, slopes))

        bits = each_part(part, len(slopes))
        ctx.save_for_backward(torch.from_numpy(slopes))
        return torch.tensor(math.fsum(bits), dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Ctx, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return torch.from_numpy(slopes.numpy() * upstream.numpy()), None, None, None, None


# Fields whose bits are estimated from the histograms of their levels; positions have too many levels for that. Entries
# of the SH codebook are added where they are a list, sorted by frequency: neighbours then predict nothing. In a square
# they predict each other (CodebookRate).
ENTROPY_FIELDS = ("opacities", "scales", "quaternions", "f_dc")

RECOUNT_STEPS = 25  # number of steps between two updates of the histograms and of the mean differences


class RateLoss(Regularizer):
    """Regularizer: estimated bits of all levels. The bits are those of an ideal entropy code with one histogram per
    sensitivity class and channel. WebP's entropy image comes near to it, and RDO quantisation uses it too
    (:mod:`kissgs.planning.rd_fields`). Between two levels, bits are interpolated linearly, so that the gradient moves
    latents to the cheaper neighbouring level. Those of a square SH codebook come from differences of neighbouring
    entries."""

    def __init__(self, scene: QuantizedScene, weight: float) -> None:
        """Prepare the loss of ``scene``; ``weight`` is the weight of one bit."""
        self._scene, self._weight = scene, weight
        self._rates: dict[str, _LevelRate | CodebookRate] = {}
        for name in ENTROPY_FIELDS:
            plane = scene.planes[name]
            self._rates[name] = _LevelRate(plane, scene.classes, np.arange(plane.base_multiples.shape[1]))
        codebook = scene.planes["f_rest_centroids"]
        if not scene.trained_tables:
            self._rates["f_rest_centroids"] = CodebookRate(codebook)
        else:
            used = (codebook.min_latent < codebook.max_latent).any(dim=0).cpu().numpy()
            # An image has one code per colour, for all coefficients; those that are not stored get one of their own.
            colors = np.where(used, np.arange(len(used)) // COEFFICIENTS, 3)
            self._rates["f_rest_centroids"] = _LevelRate(codebook, np.zeros(len(codebook.start), np.int64), colors)

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the weighted bits of the current levels, but for a constant; ``parameters`` are not used."""
        if self._weight == 0 or len(self._scene) == 0:
            return None
        latents = self._scene.latents
        if step % RECOUNT_STEPS == 0:
            for name, rate in self._rates.items():
                rate.count(latents[name])
        return self._weight * sum((rate.bits(latents[name]) for name, rate in self._rates.items()), torch.tensor(0.0))

    def state(self) -> dict[str, np.ndarray]:
        """Return the rate tables by field, see :meth:`restore`."""
        return {f"{name}.bits": rate.table for name, rate in self._rates.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state`."""
        for name, rate in self._rates.items():
            rate.table = state[f"{name}.bits"]


PAPER_TV_WEIGHTS = {"opacities": 1e-4, "scales": 1e-4, "means": 1e-4, "f_dc": 1e-4, "quaternions": 1e-2}
"""Weights of total variation by field (KISS-GS, appendix); for positions, of each of the two byte images."""

TV_RAMP = (0.35, 0.6)  # fractions of the steps between which these weights grow linearly from 0 (KISS-GS, appendix)


class TotalVariationLoss(Regularizer):
    """Regularizer: masked L1 total variation of the images, the paper's term for small files. For each image it is the
    mean absolute difference over all pairs of neighbouring cells that hold Gaussians and over channels, with levels as
    numbers from 0 to 1. The paper does not state the unit; of levels, the term would outweigh the photographs."""

    def __init__(self, scene: QuantizedScene, weight: float, pace: Pace) -> None:
        self._scene, self._weight, self._pace = scene, weight, pace
        device = scene.latents["means"].device
        self._one, self._other = (torch.from_numpy(side).to(device) for side in _neighbours(scene.grid))

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the weighted total variation of the current levels; ``parameters`` are not used."""
        begin, end = TV_RAMP
        weight = self._weight * min(max((step / self._pace.steps - begin) / (end - begin), 0.0), 1.0)
        if weight == 0 or len(self._one) == 0:
            return None
        total = torch.zeros((), dtype=torch.float64, device=self._one.device)
        for name, factor in PAPER_TV_WEIGHTS.items():
            plane = self._scene.planes[name]
            levels = plane.levels(self._scene.latents[name])
            top = 255 if name == "means" else max(plane.field.top, 1)  # 0 of a table with one value
            for image in _bytes(levels) if name == "means" else (levels,):
                total = total + factor / top * (image[self._one] - image[self._other]).abs().mean()
        return weight * total


def _neighbours(grid: Grid) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """Return all pairs of Gaussians in horizontally or vertically adjacent cells, each pair once."""
    index = np.where(grid.mask, np.cumsum(grid.mask) - 1, -1).reshape(grid.side, grid.side)
    horizontal = (index[:, :-1].reshape(-1), index[:, 1:].reshape(-1))
    vertical = (index[:-1].reshape(-1), index[1:].reshape(-1))
    one, other = (np.concatenate(ends) for ends in zip(horizontal, vertical, strict=True))
    both = (one >= 0) & (other >= 0)
    return one[both], other[both]


def _bytes(levels: Float64[Tensor, "M 3"]) -> tuple[Float64[Tensor, "M 3"], Float64[Tensor, "M 3"]]:
    """Split 16-bit levels into low and high bytes; the gradient of the high byte is that of a division by 256."""
    high = levels / 256
    high = high + (torch.floor(high) - high).detach()
    return levels - 256 * high.detach(), high
