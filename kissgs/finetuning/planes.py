"""Planes of levels in fine-tuning, and the compiled loops of its gradients and bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import torch
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int, Int64
from kissgs.core.context import Device, Workers
from kissgs.core.numba_kernels import compiled
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.planning.planner import EncodingPlan
from kissgs.planning.quantize import MEANS_TOP, SIZE, ByteTables, Quantized, short_values, table_field
from kissgs.planning.rd_fields import CAPTURED
from kissgs.planning.sh_codebook import COEFFICIENTS

# Numba kernels of fine-tuning: one pass over the levels in place of a dozen operations with arrays in float64.

T = TypeVar("T")
Ctx = Any  # context of a torch.autograd.Function

PART = 1 << 16  # number of rows that a thread processes at a time; sums of parts are added in order


def each_part(work: Callable[[int, int], T], rows: int) -> list[T]:
    """Call ``work`` with the first row of each part and the end of its rows; return the results in order."""
    with Workers(torch.get_num_threads()) as pool:
        return pool.map(lambda first: work(first, min(first + PART, rows)), range(0, rows, PART))


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], int64, int64, float64[:, ::1])"
)
def level_values(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    first: int,
    last: int,
    values: Float64[np.ndarray, "R C"],  # written
) -> None:
    """Write the values of the levels of a plane, rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            at = start[n, c if start.shape[1] > 1 else 0] + np.int64(np.rint(base[n, c] + latents[n, c]))
            values[n, c] = table[lists[at], c if table.shape[1] > 1 else 0]


@njit(nogil=True, error_model="numpy", inline="always")
def _unit(place: float, start: int, lists: np.ndarray, table: np.ndarray, column: int) -> float:
    """Return the change of a value per unit of its latent, see :meth:`kissgs.finetuning.planes.Plane.units`."""
    near = np.rint(place)
    at = start + np.int64(near)
    here = table[lists[at], column]
    below, above = here - table[lists[at - 1], column], table[lists[at + 1], column] - here
    down, up = below if below > 0 else above, above if above > 0 else below  # outside of either end
    return down if place < near else up if place > near else (down + up) / 2


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], int64, int64,"
    " float32[:, ::1])"
)
def level_gradients(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    gradient: Float64[np.ndarray, "R C"],  # by the values
    first: int,
    last: int,
    v_latents: Float32[np.ndarray, "R C"],  # written
) -> None:
    """Write the gradients by the latents of rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            own, column = start[n, c if start.shape[1] > 1 else 0], c if table.shape[1] > 1 else 0
            v_latents[n, c] = gradient[n, c] * _unit(base[n, c] + latents[n, c], own, lists, table, column)


@compiled(
    "void(float64[:, ::1], float32[:, ::1], int64[:, ::1], int64[::1], float64[:, ::1], float64[:, ::1], float64,"
    " int64, int64, float32[:, ::1])"
)
def attract(
    base: Float64[np.ndarray, "R C"],
    latents: Float32[np.ndarray, "R C"],
    start: Int64[np.ndarray, "R _"],
    lists: Int64[np.ndarray, " P"],
    table: Float64[np.ndarray, "L _"],
    weights: Float64[np.ndarray, "R 1"],  # curvature of the loss by the values
    factor: float,
    first: int,
    last: int,
    gradient: Float32[np.ndarray, "R C"],  # changed
) -> None:
    """Add the gradient of the quadratic attraction of latents to their levels, rows ``first`` to before ``last``."""
    for n in range(first, last):
        for c in range(base.shape[1]):
            own, column = start[n, c if start.shape[1] > 1 else 0], c if table.shape[1] > 1 else 0
            unit = _unit(base[n, c] + latents[n, c], own, lists, table, column)
            level = np.float32(np.rint(base[n, c] + latents[n, c]) - base[n, c])
            gradient[n, c] += np.float32(factor * weights[n, 0] * unit * unit) * (latents[n, c] - level)


@compiled(
    "float64(float64[:, ::1], float32[:, ::1], int64[:, ::1], float32[::1], int64, int64, int64, float32[:, ::1])"
)
def level_bits(
    base: Float64[np.ndarray, "R C"],  # symbol of each level of the plan
    latents: Float32[np.ndarray, "R C"],
    rows: Int64[np.ndarray, "R C"],  # index of each level's code in ``table``
    table: Float32[np.ndarray, " _"],  # bits of the symbols of all codes; between two symbols they are interpolated
    symbols: int,  # number of symbols of a code; ``symbols + 1`` entries of ``table`` belong to it
    first: int,
    last: int,  # exclusive
    slopes: Float32[np.ndarray, "R C"],  # written: gradient by the latents
) -> float:
    """Return the bits of the levels of rows ``first`` to ``last`` (exclusive)."""
    total = 0.0
    for n in range(first, last):
        for c in range(base.shape[1]):
            position = base[n, c] + latents[n, c]
            below = min(max(np.floor(position), 0.0), symbols - 1.0)
            index = rows[n, c] + np.int64(below)
            slopes[n, c] = table[index + 1] - table[index]
            total += table[index] + np.float32(position - below) * slopes[n, c]
    return total


@compiled("void(float32[:, ::1], int64[::1], int64[::1], int64[::1], int64, int64, float32[:, ::1])")
def sum_by_label(
    rows: Float32[np.ndarray, "M C"],
    order: Int64[np.ndarray, " M"],  # rows sorted by label
    used: Int64[np.ndarray, " U"],  # labels that occur
    starts: Int64[np.ndarray, " U+1"],  # start of each of these in ``order``, and the end
    first: int,
    last: int,  # exclusive
    totals: Float32[np.ndarray, "E C"],  # sums; rows are added
) -> None:
    """Add up the rows of each label, of the labels ``used[first:last]``."""
    for u in range(first, last):
        for i in range(starts[u], starts[u + 1]):
            for c in range(rows.shape[1]):
                totals[used[u], c] += rows[order[i], c]


# Levels of a field in training, and the tables whose values are trained.

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")  # trained
TABLES = ("scales", "f_dc", "f_rest_centroids")  # fields whose tables are trained, in a container with tables
REACH = 0.45  # largest change of a value of a table, in units of the distance to its neighbour, so that the order stays


@dataclass(frozen=True, slots=True, eq=False)
class ValueTable:
    """Table whose values are trained: the gradient of each is the sum over everything that uses it."""

    start: Float64[Tensor, " L"]  # ascending values of the plan
    # Change of a value per unit of its latent: the distance to the nearer neighbour, or the median one if that is
    # smaller; 0 for frozen values.
    unit: Float64[Tensor, " L"]
    min_latent: Float32[Tensor, " L"]
    max_latent: Float32[Tensor, " L"]

    @classmethod
    def of(
        cls, start: Float64[np.ndarray, " L"], device: Device, *, freeze_zero: bool, largest_gap: float
    ) -> ValueTable:
        """Return the table of a plan; 0 stays 0 if it is frozen, and no unit is above ``largest_gap``."""
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
        return cls(*(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))

    def values(self, latents: Float32[Tensor, " L"]) -> Float64[Tensor, " L"]:
        """Return the values with the digits that are stored, ascending; their gradient ignores the rounding."""
        return _Short.apply(self.start + self.unit * latents)  # type: ignore[no-untyped-call]


class _Short(torch.autograd.Function):
    """Values rounded to the digits that are stored; the gradient ignores the rounding."""

    @staticmethod
    def forward(ctx: Ctx, values: Float64[Tensor, " L"]) -> Float64[Tensor, " L"]:
        short = short_values(values.detach().cpu().numpy().astype(np.float32)).astype(np.float64)
        return torch.from_numpy(short).to(values.device)

    @staticmethod
    @once_differentiable
    def backward(ctx: Ctx, gradient: Float64[Tensor, " L"]) -> Float64[Tensor, " L"]:
        return gradient


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """One field: maps latents to levels to values of its table. A row uses some of the levels, which are a list. A
    latent beside each level is in units of the distance to the next level of the list, so it is rounded to the level of
    the nearest value."""

    field: Quantized  # levels of the plan; one row per Gaussian, or per entry of the codebook
    base_multiples: Float64[Tensor, "R C"]  # place of each level of the plan in the list of its row
    min_latent: Float32[Tensor, "R C"]  # of the first level that training may choose; 0 for frozen levels
    max_latent: Float32[Tensor, "R C"]  # of the last one; 0 for frozen levels
    lists: Int[Tensor, " P"]  # ascending lists of levels, one after the other; the ends of each are repeated
    start: Int[Tensor, "R _"]  # where place 0 of each row is in the lists
    table: Float64[Tensor, "L _"]  # value of each level, for each channel or for all

    @classmethod
    def of(
        cls,
        field: Quantized,
        lists: list[Int[np.ndarray, " levels"]],
        numbers: Int[np.ndarray, "R _"],
        frozen: Bool[np.ndarray, "R C"],
        device: Device,
        *,
        usable: tuple[int, int] = (0, SIZE - 1),
        largest_gap: float = np.inf,
    ) -> Plane:
        """Return the plane of a field whose rows use the levels of the ``lists`` with these ``numbers``. No latent
        crosses a larger distance of values than ``largest_gap``: a step over a wider one, as between the flat and the
        thick axes of discs, would make a different Gaussian."""
        starts = np.cumsum([1] + [len(levels) + 2 for levels in lists])
        lowest, highest = np.empty(field.levels.shape, np.int64), np.empty(field.levels.shape, np.int64)
        place = np.empty(field.levels.shape, np.int64)
        for number, levels in enumerate(lists):
            inside = np.broadcast_to(numbers == number, place.shape)
            place[inside] = np.searchsorted(levels, field.levels[inside])
            allowed = np.searchsorted(levels, [usable[0], usable[1] + 1])
            ends = _reachable(field.table[levels, 0], allowed, largest_gap)
            lowest[inside], highest[inside] = (end[place[inside]] for end in ends)
        least, most = (np.where(frozen, 0, bound - place) for bound in (lowest, highest))
        return cls._from(field, place, least, most, lists, starts[numbers], device)

    @classmethod
    def even(cls, field: Quantized, device: Device, *, freeze_top: bool = False) -> Plane:
        """Return the plane of a field with even levels, of which a row uses the multiples of its stride. A level that
        is no multiple of its stride starts at the nearest multiple."""
        levels, offset = field.levels.astype(np.int64), field.level_offset
        stride = np.asarray(field.level_stride, np.int64)
        stride = np.broadcast_to(stride if stride.ndim == 2 else stride.reshape(-1, 1), levels.shape)
        first, last = -(-offset // stride), (field.top + offset) // stride
        frozen = (first > last) | (field.table[-1] == field.table[0]) | (freeze_top & (levels == field.top))
        multiples = np.rint((levels + offset) / stride).astype(np.int64)
        multiples = np.where(frozen, multiples, np.clip(multiples, first, last))
        # Frozen levels need not be multiples: all levels are one more list.
        spacings, numbers = np.unique(stride, return_inverse=True)
        lists = [np.arange(min(-offset % spacing, field.top), field.top + 1, spacing) for spacing in spacings]
        starts = np.cumsum([1] + [len(own) + 2 for own in lists])
        start = starts[numbers.reshape(levels.shape)] - first
        start = np.where(frozen, starts[-1] + levels - multiples, start)
        least, most = (np.where(frozen, 0, bound - multiples) for bound in (first, last))
        return cls._from(field, multiples, least, most, [*lists, np.arange(field.top + 1)], start, device)

    @classmethod
    def _from(
        cls,
        field: Quantized,
        places: Int[np.ndarray, "R C"],
        lowest: Int[np.ndarray, "R C"],
        highest: Int[np.ndarray, "R C"],
        lists: list[Int[np.ndarray, " levels"]],
        start: Int[np.ndarray, "R _"],
        device: Device,
    ) -> Plane:
        padded = np.concatenate([np.pad(levels.astype(np.int64), 1, mode="edge") for levels in lists])
        bounds = (bound.astype(np.float32) for bound in (lowest, highest))
        arrays = (places.astype(np.float64), *bounds, padded, start.astype(np.int64), field.table)
        return cls(field, *(torch.from_numpy(np.ascontiguousarray(array)).to(device) for array in arrays))

    def levels(self, latents: Float32[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
        """Return levels, whole numbers; their gradient is that of a line to the next level of the list."""
        numbers = torch.arange(len(self.table), dtype=torch.float64, device=self.table.device)
        return _Values.apply(latents, numbers[:, None], self)  # type: ignore[no-untyped-call]

    def values(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the values of the levels in a trained ``table``, or in the plan's, differentiable by both."""
        return _Values.apply(latents, self._values(table), self)  # type: ignore[no-untyped-call]

    def units(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Float64[Tensor, "R C"]:
        """Return the change of each value per unit of its latent: the distance to the next level of the list."""
        latents, values = latents.detach(), self._values(table).detach()
        at = self.positions(latents)
        below, here, above = (_entries(values, self.lists[at + side]) for side in (-1, 0, 1))
        down, up = here - below, above - here
        down, up = torch.where(down > 0, down, up), torch.where(up > 0, up, down)  # outside of either end
        side = torch.sign(self.base_multiples + latents - torch.round(self.base_multiples + latents))
        return torch.where(side < 0, down, torch.where(side > 0, up, (down + up) / 2))

    def attract(
        self,
        gradient: Float32[Tensor, "R C"],
        latents: Float32[Tensor, "R C"],
        table: Tensor | None,
        weights: Float64[Tensor, "R 1"],
        factor: float,
    ) -> None:
        """Add ``factor`` times the gradient of the quadratic attraction of each latent to its current level.
        ``weights`` are the curvature of the loss by the values."""
        if latents.device.type != "cpu":
            level = (torch.round(self.base_multiples + latents) - self.base_multiples).float()
            gradient += (factor * weights * self.units(latents, table) ** 2).float() * (latents - level)
            return
        levels, curvature, slopes = self._arrays(latents, self._values(table)), weights.numpy(), gradient.numpy()
        each_part(lambda a, b: attract(*levels, curvature, factor, a, b, slopes), len(latents))

    def _arrays(
        self, latents: Float32[Tensor, "R C"], table: Float64[Tensor, "L _"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return what the kernels need of a plane on the CPU."""
        own, values = latents.detach().contiguous().numpy(), table.detach().contiguous().numpy()
        return self.base_multiples.numpy(), own, self.start.numpy(), self.lists.numpy(), values

    def quantized(self, latents: Float32[Tensor, "R C"], table: Tensor | None = None) -> Quantized:
        """Return the field with the levels of these latents, and the values of ``table``."""
        levels = self.lists[self.positions(latents)].cpu().numpy().astype(self.field.levels.dtype)
        if table is None:
            return replace(self.field, levels=levels)
        return table_field(table.detach().cpu().numpy().astype(np.float32), levels)

    def positions(self, latents: Float32[Tensor, "R C"]) -> Int[Tensor, "R C"]:
        """Return the position of each current level in the lists."""
        return self.start + torch.round(self.base_multiples + latents.detach()).long()

    def _values(self, table: Tensor | None) -> Float64[Tensor, "L _"]:
        return self.table if table is None else table.reshape(len(table), -1)


class _Values(torch.autograd.Function):
    """Table look-up. On the CPU, gradients of values are summed in a fixed order."""

    @staticmethod
    def forward(
        ctx: Ctx, latents: Float32[Tensor, "R C"], table: Float64[Tensor, "L _"], plane: Plane
    ) -> Float64[Tensor, "R C"]:
        ctx.plane = plane
        ctx.save_for_backward(latents.detach(), table.detach())
        if latents.device.type != "cpu":
            return _entries(table.detach(), plane.lists[plane.positions(latents)])
        levels, values = plane._arrays(latents, table), np.empty(tuple(latents.shape))
        each_part(lambda first, last: level_values(*levels, first, last, values), len(values))
        return torch.from_numpy(values)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Ctx, gradient: Float[Tensor, "R C"]
    ) -> tuple[Float32[Tensor, "R C"], Float64[Tensor, "L _"] | None, None]:
        latents, table = ctx.saved_tensors
        plane: Plane = ctx.plane
        total = None
        if ctx.needs_input_grad[1]:
            levels = plane.lists[plane.positions(latents)]
            total = _sums(gradient.double().reshape(-1), levels.reshape(-1), len(table))[:, None]
        if latents.device.type != "cpu":
            return (gradient * plane.units(latents, table)).float(), total, None
        arrays, v_values = plane._arrays(latents, table), gradient.double().contiguous().numpy()
        v_latents = np.empty(tuple(gradient.shape), np.float32)
        each_part(lambda first, last: level_gradients(*arrays, v_values, first, last, v_latents), len(v_latents))
        return torch.from_numpy(v_latents), total, None


def _entries(table: Float64[Tensor, "L _"], levels: Int[Tensor, "R C"]) -> Float64[Tensor, "R C"]:
    """Return the values of levels in a table with a column for each channel, or one for all."""
    return table[:, 0][levels] if table.shape[1] == 1 else table.gather(0, levels)


def _reachable(
    values: Float64[np.ndarray, " levels"], usable: Int[np.ndarray, " 2"], largest_gap: float
) -> tuple[Int[np.ndarray, " levels"], Int[np.ndarray, " levels"]]:
    """Return the first and the last place that each place of a list reaches without a wide gap. ``usable`` are the
    first place that may be used, and the one after the last."""
    wide = np.diff(values) > largest_gap
    part, places = np.concatenate([[0], np.cumsum(wide)]), np.arange(len(values))
    first, last = np.searchsorted(part, part), np.searchsorted(part, part, side="right") - 1
    return np.minimum(np.maximum(first, usable[0]), places), np.maximum(np.minimum(last, usable[1] - 1), places)


def _sums(terms: Float64[Tensor, " T"], groups: Int[Tensor, " T"], size: int) -> Float64[Tensor, " size"]:
    if terms.device.type != "cpu":
        return terms.new_zeros(size).index_add_(0, groups, terms)
    return torch.from_numpy(np.bincount(groups.numpy(), terms.numpy(), minlength=size))


def planes_of(
    plan: EncodingPlan, sh_degree: int, tables: ByteTables | None, device: Device
) -> tuple[dict[str, Plane], dict[str, ValueTable]]:
    """Return the plane of each trained field of a plan, and the tables that are trained."""
    filled = plan.grid.mask.nonzero()[0]
    planes: dict[str, Plane] = {}
    for name in FIELDS:
        field = plan.fields[name] if name == "f_rest_centroids" else plan.fields[name].take(filled)
        if tables is None or name == "means":
            # Some readers need the largest position to be the largest level.
            planes[name] = Plane.even(field, device, freeze_top=name == "means" and field.top == MEANS_TOP)
        elif name == "f_rest_centroids":  # every entry uses all values; missing bands are frozen
            frozen = np.zeros(field.levels.shape, bool)
            frozen[:, np.arange(field.levels.shape[1]) % COEFFICIENTS >= SH_REST_COUNTS[sh_degree]] = True
            rows, lists = np.zeros((len(frozen), 1), np.int64), [np.arange(len(field.table))]
            planes[name] = Plane.of(field, lists, rows, frozen, device, largest_gap=CAPTURED["f_dc"])
        else:
            planes[name] = _of_classes(name, field, plan.classes.astype(np.int64), tables, device)
    trained = {}
    for name in () if tables is None else TABLES:
        values, gap = planes[name].field.table[:, 0], CAPTURED.get(name, CAPTURED["f_dc"])
        trained[name] = ValueTable.of(values, device, freeze_zero=name == "f_rest_centroids", largest_gap=gap)
    return planes, trained


def _of_classes(
    name: str, field: Quantized, classes: Int[np.ndarray, " M"], tables: ByteTables, device: Device
) -> Plane:
    """Return the plane of a field with a table, in which a sensitivity class uses the levels that occur in it."""
    usable = (0, SIZE - 1)
    if name == "opacities":  # those that renderers do not draw stay invisible
        usable = tables.first_drawn, tables.last_drawn
    frozen = (field.levels < usable[0]) | (field.levels > usable[1])
    lists = [np.unique(field.levels[classes == number]) for number in range(int(classes.max()) + 1)]
    return Plane.of(field, lists, classes[:, None], frozen, device, usable=usable, largest_gap=CAPTURED[name])
