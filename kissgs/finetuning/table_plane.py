"""``TablePlane`` and ``ValueTable``: levels that stand for the values of a table, and the training of its values.

The rows of a sensitivity class use the levels that occur in it. A latent beside each level is in units of the distance
to the next level of the class, so it is rounded to the level of the nearest value. The values of the table are trained
as well: the gradient of each is the sum over everything that uses it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int
from kissgs.planning.quantize import Quantized
from kissgs.planning.value_table import SIZE, short_values, table_field
from kissgs.rendering.rasterizer import Device

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
