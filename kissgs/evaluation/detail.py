"""Loss of detail: changes of SSIM in small patches, which no mean over an image shows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float64

PatchChanges = Float64[np.ndarray, "_h _w"]
"""Change of SSIM in each patch of an image (:func:`kissgs.rendering.metrics.ssim_with_patches`), negative for a loss: a
candidate's less the original's, both to a photograph; without photographs the candidate's to the original, less 1."""

LARGE_LOSS = 0.05  # loss of SSIM beyond which a patch counts in share_below


@dataclass(frozen=True, slots=True)
class Detail:
    """Changes of SSIM in patches, -2 to 2 and negative for a loss; all NaN if a rendering failed.

    Attributes:
        worst: change of the worst patch.
        worst_percent: mean change of the worst 1 % of all patches, rounded up to whole patches.
        share_below: share of patches, 0 to 1, that lose more than :data:`LARGE_LOSS`.
    """

    worst: float
    worst_percent: float
    share_below: float

    @classmethod
    def of(cls, views: Sequence[PatchChanges]) -> Detail:
        """Return the figures over all patches of all views, of which there is at least one."""
        changes = np.sort(np.concatenate([view.ravel() for view in views]))  # NaN comes last
        if np.isnan(changes[-1]):
            return cls(math.nan, math.nan, math.nan)
        worst = changes[: -(-len(changes) // 100)]
        return cls(float(worst[0]), float(worst.mean()), float((changes < -LARGE_LOSS).mean()))
