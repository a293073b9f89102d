"""Loss terms of fine-tuning for the size of the container: estimated bits of the levels, and total variation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.progress import Pace
from kissgs.finetuning import kernels
from kissgs.finetuning.planes import Plane
from kissgs.finetuning.quantized_scene import QuantizedScene
from kissgs.planning.layout import Grid
from kissgs.planning.rdo_quantize import UNUSED_COUNT
from kissgs.planning.sh_codebook import COEFFICIENTS
from kissgs.rendering.tensors import Parameters
from kissgs.training.loop import TrainableScene

# ``CodebookRate``: estimated bits of the SH codebook's image, for fine-tuning.

DIFFERENCE_OFFSET = 0.3
"""Added to mean differences, levels; it bounds the bits of a level where neighbours are nearly equal."""


class CodebookRate:
    """Bits of the square image of an SH codebook.

    WebP subtracts green from red and blue, predicts each from its neighbours, and codes the rest. So the bits of a
    level are those of its difference from the entries beside and above it, in Laplace distributions: the mean of both
    differences, over ln 2 times the mean difference of its colour and coefficient. Only their derivative matters; the
    constant is left out.
    """

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


ENTROPY_FIELDS = ("opacities", "scales", "quaternions", "f_dc")
"""Fields whose bits are estimated from the histograms of their levels; positions have too many levels for that.

Entries of the SH codebook are added where they are a list, sorted by frequency: neighbours then predict nothing.
In a square they predict each other (:class:`kissgs.finetuning.losses.CodebookRate`).
"""

RECOUNT_STEPS = 25
"""Number of steps between two updates of the histograms and of the mean differences."""


class RateLoss:
    """Regularizer: estimated bits of all levels.

    The bits are those of an ideal entropy code with one histogram per sensitivity class and channel. WebP's entropy
    image comes near to it, and RDO quantisation uses it too (:mod:`kissgs.planning.rdo_quantize`). Between two levels,
    bits are interpolated linearly, so that the gradient moves latents to the cheaper neighbouring level. Those of a
    square SH codebook come from differences of neighbouring entries.
    """

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

    def update(self, step: int, scene: TrainableScene) -> None:
        """Do nothing: :meth:`penalty` updates what it needs."""

    def state(self) -> dict[str, np.ndarray]:
        """Return the rate tables by field, see :meth:`restore`."""
        return {f"{name}.bits": rate.table for name, rate in self._rates.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state`."""
        for name, rate in self._rates.items():
            rate.table = state[f"{name}.bits"]


PAPER_TV_WEIGHTS = {"opacities": 1e-4, "scales": 1e-4, "means": 1e-4, "f_dc": 1e-4, "quaternions": 1e-2}
"""Weights of total variation by field (KISS-GS, appendix); for positions, of each of the two byte images."""

TV_RAMP = (0.35, 0.6)
"""Fractions of the steps between which these weights grow linearly from 0 (KISS-GS, appendix)."""


class TotalVariationLoss:
    """Regularizer: masked L1 total variation of the images, the paper's term for small files.

    For each image it is the mean absolute difference of levels over all pairs of neighbouring cells that hold Gaussians
    and over channels. The paper does not state the unit; here it is levels.
    """

    def __init__(self, scene: QuantizedScene, weight: float, pace: Pace) -> None:
        """Prepare the loss."""
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
            levels = self._scene.planes[name].levels(self._scene.latents[name])
            for image in _bytes(levels) if name == "means" else (levels,):
                total = total + factor * (image[self._one] - image[self._other]).abs().mean()
        return weight * total

    def update(self, step: int, scene: TrainableScene) -> None:
        """Do nothing: the loss has no state."""


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


class _LevelRate:
    """Rate of the levels of one field."""

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
        ctx: Any,  # noqa: ANN401
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
            return float(kernels.level_bits(start, found, codes, bits_of, symbols, first, last, slopes))

        bits = kernels.each_part(part, len(slopes), torch.get_num_threads())
        ctx.save_for_backward(torch.from_numpy(slopes))
        return torch.tensor(math.fsum(bits), dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        (slopes,) = ctx.saved_tensors
        return torch.from_numpy(slopes.numpy() * upstream.numpy()), None, None, None, None
