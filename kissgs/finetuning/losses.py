"""What fine-tuning wants of the levels beside good pictures: that they take few bytes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.finetuning.quantized_scene import Plane, QuantizedScene
from kissgs.planning.layout import Grid
from kissgs.planning.rdo_quantize import UNUSED_COUNT
from kissgs.training.loop import Parameters, TrainableScene

COUNTED = ("opacities", "scales", "quaternions", "f_dc")
"""Fields whose bits are told from how many have a level. Positions have nearly as many levels as Gaussians."""

RECOUNT = 25
"""Steps between two counts."""


class CodeLength:
    """Bits of all levels, if an ideal entropy code knew how many of each class of Gaussians have which.

    WebP's entropy image comes near to it, and levels were chosen by it (:mod:`kissgs.planning.rdo_quantize`). Between
    two levels, bits are interpolated: latents are drawn to the cheaper one of their neighbours.
    """

    def __init__(self, roundtrip: QuantizedScene, weight: float) -> None:
        """``weight``: of one bit in the loss."""
        self._roundtrip, self._weight = roundtrip, weight
        self._coders = {name: _Coder(roundtrip.planes[name], roundtrip.classes) for name in COUNTED}

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Of the levels as they are; ``parameters`` are what becomes of them."""
        if self._weight == 0 or len(self._roundtrip) == 0:
            return None
        latents = self._roundtrip.latents
        if step % RECOUNT == 0:
            for name, coder in self._coders.items():
                coder.count(latents[name])
        return self._weight * sum(
            (coder.bits(latents[name]) for name, coder in self._coders.items()), torch.tensor(0.0)
        )

    def update(self, step: int, learner: TrainableScene) -> None:
        """Nothing."""

    def state(self) -> dict[str, np.ndarray]:
        """To go on from later."""
        return {f"{name}.bits": coder.table for name, coder in self._coders.items()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from there."""
        for name, coder in self._coders.items():
            coder.table = state[f"{name}.bits"]


PAPER_WEIGHTS = {"opacities": 1e-4, "scales": 1e-4, "means": 1e-4, "f_dc": 1e-4, "quaternions": 1e-2}
"""Of total variation (KISS-GS, appendix); of each of the positions' two bytes."""

RAMP = (0.35, 0.6)
"""Shares of the steps between which these weights grow from nothing (the same)."""


class Smoothness:
    """The paper's wish for small files: that levels of neighbouring pixels be alike.

    Masked L1 total variation: for each image the mean, over all pairs of neighbouring cells that hold Gaussians, and
    over channels, of the distance of their levels. Not published is in which unit; here it is levels.
    """

    def __init__(self, roundtrip: QuantizedScene, weight: float, steps: int) -> None:
        """``weight``: in units of the paper's."""
        self._roundtrip, self._weight, self._steps = roundtrip, weight, steps
        device = roundtrip.latents["means"].device
        self._one, self._other = (torch.from_numpy(side).to(device) for side in _neighbours(roundtrip.grid))

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Of the levels as they are; ``parameters`` are what becomes of them."""
        begin, end = RAMP
        weight = self._weight * min(max((step / self._steps - begin) / (end - begin), 0.0), 1.0)
        if weight == 0 or len(self._one) == 0:
            return None
        total = torch.zeros((), dtype=torch.float64, device=self._one.device)
        for name, share in PAPER_WEIGHTS.items():
            levels = self._roundtrip.planes[name].levels(self._roundtrip.latents[name])
            for image in _bytes(levels) if name == "means" else (levels,):
                total = total + share * (image[self._one] - image[self._other]).abs().mean()
        return weight * total

    def update(self, step: int, learner: TrainableScene) -> None:
        """Nothing is remembered."""


def _neighbours(grid: Grid) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]:
    """All pairs of Gaussians in cells that touch, each once."""
    number = np.where(grid.mask, np.cumsum(grid.mask) - 1, -1).reshape(grid.side, grid.side)
    beside = (number[:, :-1].reshape(-1), number[:, 1:].reshape(-1))
    below = (number[:-1].reshape(-1), number[1:].reshape(-1))
    one, other = (np.concatenate(pair) for pair in zip(beside, below, strict=True))
    both = (one >= 0) & (other >= 0)
    return one[both], other[both]


def _bytes(levels: Float64[Tensor, "M 3"]) -> tuple[Float64[Tensor, "M 3"], Float64[Tensor, "M 3"]]:
    """Low and high; the gradient of the high one is that of a division without rest."""
    high = levels / 256
    high = high + (torch.floor(high) - high).detach()
    return levels - 256 * high.detach(), high


class _Coder:
    """Of one field.

    Attributes:
        table: ``(classes, C, symbols + 1)`` float32: bits of each, the last one twice.
    """

    table: Float32[np.ndarray, "classes C symbols"]

    def __init__(self, plane: Plane, classes: Int[np.ndarray, " M"]) -> None:
        whole = plane.base_multiples.cpu().numpy()
        self._first = int(np.floor(whole + plane.min_latent.cpu().numpy()).min(initial=0))
        self._symbols = int(np.ceil(whole + plane.max_latent.cpu().numpy()).max(initial=0)) - self._first + 1
        self._kinds, self._channels = int(classes.max(initial=0)) + 1, whole.shape[1]
        rows = (classes[:, None] * self._channels + np.arange(self._channels)) * (self._symbols + 1)
        self._rows = torch.from_numpy(rows).to(plane.base_multiples.device)
        self._begun: Float64[Tensor, "M C"] = plane.base_multiples - self._first
        self.table = np.zeros((self._kinds, self._channels, self._symbols + 1), np.float32)

    def count(self, latents: Float32[Tensor, "M C"]) -> None:
        """Set the table by the levels as they are."""
        symbols = np.rint(self._begun.cpu().numpy() + latents.detach().cpu().numpy()).astype(np.int64)
        rows = self._rows.cpu().numpy() + symbols
        counts = np.bincount(rows.reshape(-1), minlength=self.table.size).reshape(self.table.shape)
        likely = counts[:, :, :-1] + UNUSED_COUNT
        self.table[:, :, :-1] = np.log2(likely.sum(axis=2, keepdims=True)) - np.log2(likely)
        self.table[:, :, -1] = self.table[:, :, -2]

    def bits(self, latents: Float32[Tensor, "M C"]) -> Tensor:
        """Of all levels together."""
        place = self._begun + latents
        below = torch.floor(place.detach()).clamp(0, self._symbols - 1)
        index = self._rows + below.long()
        table = torch.from_numpy(self.table.reshape(-1)).to(latents.device)
        here, next_ = table[index], table[index + 1]
        return (here + (place - below).float() * (next_ - here)).sum()
