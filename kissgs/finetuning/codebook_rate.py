"""``CodebookRate``: estimated bits of the SH codebook's image, for fine-tuning."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from kissgs.core.array_types import Float32
from kissgs.finetuning.even_plane import EvenPlane
from kissgs.planning.sh_codebook import COEFFICIENTS

DIFFERENCE_OFFSET = 0.3
"""Added to mean differences, levels; it bounds the bits of a level where neighbours are nearly equal."""


class CodebookRate:
    """Bits of the square image of an SH codebook.

    WebP subtracts green from red and blue, predicts each from its neighbours, and codes the rest. So the bits of a
    level are those of its difference from the entries beside and above it, in Laplace distributions: the mean of both
    differences, over ln 2 times the mean difference of its colour and coefficient. Only their derivative matters; the
    constant is left out.

    Attributes:
        table: ``(3, 15)`` float32, mean difference by colour and coefficient, plus :data:`DIFFERENCE_OFFSET`,
            levels; the colours are red - green, green and blue - green.
    """

    table: Float32[np.ndarray, "3 15"]

    def __init__(self, plane: EvenPlane) -> None:
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
