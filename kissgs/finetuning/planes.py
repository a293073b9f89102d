"""Levels of a field in training, even or of a table, and the planes of an encoding plan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.finetuning import kernels
from kissgs.planning import smallest_three
from kissgs.planning.container_model import ByteTables
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.quantize import MEANS_TOP, Quantized
from kissgs.planning.rdo_quantize import CAPTURED
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.planning.value_table import SIZE, short_values, table_field
from kissgs.rendering.rasterizer import Device

# ``EvenPlane``: levels that are evenly spaced over a range per channel, of which a row uses multiples of its stride.
#
# Every level is ``stride * round(multiple + latent)``, with the multiple of the encoding plan. The unit of a latent is
# the step size of the row's sensitivity class.


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


# ``TablePlane`` and ``ValueTable``: levels that stand for the values of a table, and the training of its values.
#
# The rows of a sensitivity class use the levels that occur in it. A latent beside each level is in units of the
# distance to the next level of the class, so it is rounded to the level of the nearest value. The values of the table
# are trained as well: the gradient of each is the sum over everything that uses it.

REACH = 0.45
"""Largest change of a value of a table, in units of the distance to its neighbour, so that the order stays."""


@dataclass(frozen=True, slots=True, eq=False)
class ValueTable:
    """Table whose values are trained.

    Attributes:
        start: ``(L,)`` float64, ascending values of the plan.
        unit: ``(L,)`` float64, change of a value per unit of its latent: the distance to the nearer neighbour, or the
            median one if that is smaller; 0 for frozen values.
        min_latent: ``(L,)`` float32, smallest latent.
        max_latent: ``(L,)`` float32, largest latent.
    """

    start: Float64[Tensor, " L"]
    unit: Float64[Tensor, " L"]
    min_latent: Float32[Tensor, " L"]
    max_latent: Float32[Tensor, " L"]

    @classmethod
    def of(
        cls, table: Float32[np.ndarray, " L"], device: Device, *, freeze_zero: bool, largest_gap: float
    ) -> ValueTable:
        """Return the table of a plan.

        Args:
            table: ascending values.
            device: device of the tensors.
            freeze_zero: whether 0 stays 0.
            largest_gap: largest unit.
        """
        start = table.astype(np.float64)
        if len(start) < 2:
            gaps = np.zeros((2, len(start)))
        else:
            between = np.diff(start)
            gaps = np.stack([np.r_[between[:1], between], np.r_[between, between[-1:]]])  # below and above
        usual = np.quantile(gaps[0], 0.5, method="lower") if len(start) else 0.0
        unit = np.minimum(gaps.min(axis=0), min(usual, largest_gap))
        unit = np.where(freeze_zero & (start == 0), 0.0, unit)
        below, above = REACH * gaps * (unit > 0) / np.where(unit > 0, unit, 1)
        arrays = (start, unit, -below.astype(np.float32), above.astype(np.float32))
        return cls(*(torch.from_numpy(array).to(device) for array in arrays))

    def values(self, latents: Float32[Tensor, " L"]) -> Float64[Tensor, " L"]:
        """Return the values with the digits that are stored, ascending; their gradient ignores the rounding."""
        return _Short.apply(self.start + self.unit * latents)  # type: ignore[no-untyped-call]


@dataclass(frozen=True, slots=True, eq=False)
class TablePlane:
    """One field: maps latents to levels to the values of a table.

    Attributes:
        field: levels of the plan, ``(R, C)``; one row per Gaussian, or per entry of the codebook.
        base_multiples: ``(R, C)`` float64, place of each level of the plan in the list of its row, from 0.
        min_latent: ``(R, C)`` float32, latent of the first level of the row's list; 0 for frozen levels.
        max_latent: ``(R, C)`` float32, latent of the last one; 0 for frozen levels.
        lists: ``(K, S)`` int64, K ascending lists of levels; the last of each is repeated.
        first: ``(R, 1)`` int64, position of the list of each row in the flattened lists.
        fixed: ``(L,)`` float64, value of each level; None if the table is trained.
    """

    field: Quantized
    base_multiples: Float64[Tensor, "R C"]
    min_latent: Float32[Tensor, "R C"]
    max_latent: Float32[Tensor, "R C"]
    lists: Int[Tensor, "K S"]
    first: Int[Tensor, "R 1"]
    fixed: Float64[Tensor, " L"] | None

    @classmethod
    def of(
        cls,
        field: Quantized,
        lists: list[Int[np.ndarray, " levels"]],
        rows: Int[np.ndarray, " R"],
        frozen: Bool[np.ndarray, "R C"],
        device: Device,
        *,
        fixed: Float64[np.ndarray, " L"] | None = None,
        usable: tuple[int, int] = (0, SIZE - 1),
        largest_gap: float = np.inf,
    ) -> TablePlane:
        """Return the plane of a field.

        Args:
            field: levels of the plan.
            lists: levels of each class, ascending.
            rows: class of each row; all levels of the row are in its list.
            frozen: levels that are not trained.
            device: device of the tensors.
            fixed: value of each level; None if the table is trained.
            usable: smallest and largest level that training may choose.
            largest_gap: largest distance of values that a latent crosses: a step over a wider one, as between the flat
                and the thick axes of discs, would make a different Gaussian.
        """
        longest = max(len(levels) for levels in lists)
        padded = np.stack(
            [np.pad(levels.astype(np.int64), (0, longest - len(levels)), mode="edge") for levels in lists]
        )
        scale = fixed if fixed is not None else field.table
        if scale is None:
            raise ValueError("the field has no table")
        lowest, highest = np.empty(field.levels.shape, np.int64), np.empty(field.levels.shape, np.int64)
        place = np.empty(field.levels.shape, np.int64)
        for number, levels in enumerate(lists):
            inside = rows == number
            place[inside] = np.searchsorted(levels, field.levels[inside])
            allowed = np.searchsorted(levels, [usable[0], usable[1] + 1])
            ends = _reachable(scale[levels].astype(np.float64), allowed, largest_gap)
            lowest[inside], highest[inside] = (end[place[inside]] for end in ends)
        bounds = (np.where(frozen, 0, bound - place).astype(np.float32) for bound in (lowest, highest))
        first = (rows * longest)[:, None].astype(np.int64)
        arrays = (place.astype(np.float64), *bounds, padded, first, *(() if fixed is None else (fixed,)))
        base, least, most, every, start, *values = (
            torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays
        )
        return cls(field, base, least, most, every, start, values[0] if values else None)

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return levels; their gradient is that of a line to the next level of the list."""
        numbers = torch.arange(int(self.lists.max()) + 1, dtype=torch.float64, device=self.lists.device)
        return _TableValues.apply(latents, numbers, self)  # type: ignore[no-untyped-call]

    def values(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the values of the levels in ``table``, or in the fixed one, differentiable by both."""
        return _TableValues.apply(latents, self._values(table), self)  # type: ignore[no-untyped-call]

    def units(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the change of each value per unit of its latent: the distance to the next level of the list."""
        return self._units(latents, self.positions(latents), self._values(table).detach())

    def quantized(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Quantized:
        """Return the field with the levels of these latents, and the values of ``table``."""
        levels = self.lists.reshape(-1)[self.positions(latents)].cpu().numpy().astype(np.uint8)
        if table is None:
            return replace(self.field, levels=levels)
        return table_field(table.detach().cpu().numpy().astype(np.float32), levels)

    def positions(self, latents: Float32[Tensor, "R C"]) -> Int[Tensor, "R C"]:
        """Return the position of each current level in the flattened lists."""
        return self.first + torch.round(self.base_multiples + latents.detach()).long()

    def _values(self, table: Tensor | None) -> Float64[Tensor, " L"]:
        values = self.fixed if table is None else table
        if values is None:
            raise ValueError("the values of a trained table must be given")
        return values

    def _units(
        self, latents: Float32[Tensor, "R C"], positions: Int[Tensor, "R C"], values: Float64[Tensor, " L"]
    ) -> Float64[Tensor, "R C"]:
        here = values[self.lists]
        ends = here[:, :1], here[:, -1:]
        below, above = torch.cat([ends[0], here[:, :-1]], 1), torch.cat([here[:, 1:], ends[1]], 1)
        down, up = here - below, above - here
        down, up = torch.where(down > 0, down, up), torch.where(up > 0, up, down)  # outside of either end
        sides = torch.stack([down, (down + up) / 2, up], dim=2).reshape(-1)
        offset = self.base_multiples + latents.detach()
        side = torch.sign(offset - torch.round(offset)).long()
        return sides[positions * 3 + 1 + side]


class _Short(torch.autograd.Function):
    """Values rounded to the digits that are stored; the gradient ignores the rounding."""

    @staticmethod
    def forward(ctx: Any, values: Float64[Tensor, " L"]) -> Float64[Tensor, " L"]:  # noqa: ANN401
        short = short_values(values.detach().cpu().numpy().astype(np.float32)).astype(np.float64)
        return torch.from_numpy(short).to(values.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float64[Tensor, " L"]) -> Float64[Tensor, " L"]:  # noqa: ANN401
        return gradient


class _TableValues(torch.autograd.Function):
    """Table look-up. On the CPU, gradients of values are summed in a fixed order."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        latents: Float32[Tensor, "R C"],
        values: Float64[Tensor, " L"],
        plane: TablePlane,
    ) -> Float64[Tensor, "R C"]:
        positions = plane.positions(latents)
        levels = plane.lists.reshape(-1)[positions]
        ctx.save_for_backward(plane._units(latents, positions, values.detach()), levels)
        ctx.size = len(values)
        return values.detach()[levels]

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,  # noqa: ANN401
        gradient: Float[Tensor, "R C"],
    ) -> tuple[Float32[Tensor, "R C"], Float64[Tensor, " L"] | None, None]:
        units, levels = ctx.saved_tensors
        total = None
        if ctx.needs_input_grad[1]:
            total = _sums(gradient.double().reshape(-1), levels.reshape(-1), ctx.size)
        return (gradient * units).float(), total, None


def _reachable(
    values: Float64[np.ndarray, " levels"], usable: Int[np.ndarray, " 2"], largest_gap: float
) -> tuple[Int[np.ndarray, " levels"], Int[np.ndarray, " levels"]]:
    """Return the first and the last place that each place of a list reaches without a wide gap.

    Args:
        values: ascending.
        usable: first place that may be used, and the one after the last.
        largest_gap: largest gap that is not wide.
    """
    wide = np.diff(values) > largest_gap
    part, places = np.concatenate([[0], np.cumsum(wide)]), np.arange(len(values))
    first, last = np.searchsorted(part, part), np.searchsorted(part, part, side="right") - 1
    return np.minimum(np.maximum(first, usable[0]), places), np.maximum(np.minimum(last, usable[1] - 1), places)


def _sums(terms: Float64[Tensor, " T"], groups: Int[Tensor, " T"], size: int) -> Float64[Tensor, " size"]:
    if terms.device.type != "cpu":
        return terms.new_zeros(size).index_add_(0, groups, terms)
    return torch.from_numpy(np.bincount(groups.numpy(), terms.numpy(), minlength=size))


# ``Plane``: what training needs of a field's levels, even or of a table; and the planes of an encoding plan.

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")
"""Trained fields of an encoding plan."""

TABLES = ("scales", "f_dc", "f_rest_centroids")
"""Fields whose tables are trained, in a container with tables."""


class Plane(Protocol):
    """One field: maps latents, ``(R, C)`` float32, to levels to values."""

    @property
    def field(self) -> Quantized:
        """Levels of the plan, ``(R, C)``; one row per Gaussian, or per entry of the codebook."""

    @property
    def base_multiples(self) -> Float64[Tensor, "R C"]:
        """Number of each level of the plan among those that its row may use."""

    @property
    def min_latent(self) -> Float32[Tensor, "R C"]:
        """Smallest latent whose level the row may use; 0 for frozen levels."""

    @property
    def max_latent(self) -> Float32[Tensor, "R C"]:
        """Largest latent whose level the row may use; 0 for frozen levels."""

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return levels, whole numbers; their gradient ignores the rounding."""

    def values(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the decoded values of the levels, differentiable; ``table`` holds the values of a trained table."""

    def units(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the change of each value per unit of its latent."""

    def quantized(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Quantized:
        """Return the field with the levels of these latents and the values of that table."""


def planes_of(
    plan: EncodingPlan, sh_degree: int, tables: ByteTables | None, device: Device
) -> tuple[dict[str, Plane], dict[str, ValueTable]]:
    """Return the plane of each trained field, and the tables that are trained.

    Args:
        plan: the plan.
        sh_degree: that of the decoded scene.
        tables: tables of the container; None for even levels.
        device: device of the tensors.
    """
    filled = plan.grid.mask.nonzero()[0]
    fields = {name: field if name == "f_rest_centroids" else field.take(filled) for name, field in plan.fields.items()}
    if tables is None:
        return {name: _even(name, field, device) for name, field in fields.items()}, {}
    planes: dict[str, Plane] = {}
    trained: dict[str, ValueTable] = {}
    for name, field in fields.items():
        if name == "f_rest_centroids" and field.table is not None:
            planes[name] = _codebook(field, field.table, sh_degree, device)
        elif name in ("opacities", "quaternions", "scales", "f_dc"):
            planes[name] = _of_table(name, field, plan.classes.astype(np.int64), tables, device)
        elif name in FIELDS:
            planes[name] = _even(name, field, device, as_text=True)
        if name in TABLES and field.table is not None:
            trained[name] = ValueTable.of(
                field.table,
                device,
                freeze_zero=name == "f_rest_centroids",
                largest_gap=CAPTURED.get(name, CAPTURED["f_dc"]),
            )
    return planes, trained


def _even(name: str, field: Quantized, device: Device, *, as_text: bool = False) -> EvenPlane:
    return EvenPlane.of(field, device, freeze_top=name == "means" and field.top == MEANS_TOP, as_text=as_text)


def _codebook(field: Quantized, table: Float32[np.ndarray, " L"], sh_degree: int, device: Device) -> TablePlane:
    levels = np.arange(len(table))
    frozen = np.zeros(field.levels.shape, bool)
    frozen[:, np.arange(field.levels.shape[1]) % COEFFICIENTS >= SH_REST_COUNTS[sh_degree]] = True
    rows = np.zeros(len(frozen), np.int64)
    return TablePlane.of(field, [levels], rows, frozen, device, largest_gap=CAPTURED["f_dc"])


def _of_table(
    name: str, field: Quantized, classes: Int[np.ndarray, " M"], tables: ByteTables, device: Device
) -> TablePlane:
    usable = (0, SIZE - 1)
    if name == "opacities":  # those that renderers do not draw stay invisible
        usable = tables.first_drawn, tables.last_drawn
    frozen = (field.levels < usable[0]) | (field.levels > usable[1])
    lists = [np.unique(field.levels[classes == number]) for number in range(int(classes.max()) + 1)]
    fixed = {"opacities": tables.opacity_logits, "quaternions": smallest_three.TABLE}.get(name)
    return TablePlane.of(field, lists, classes, frozen, device, fixed=fixed, usable=usable, largest_gap=CAPTURED[name])
