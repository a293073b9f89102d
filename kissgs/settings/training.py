"""``TrainingViewSettings``: the views that compaction and fine-tuning train on."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, ConfigDict, Field

SSIM_WEIGHT, SSIM_GOAL_WEIGHT = 0.3, 0.4
"""Usual weight of 1 - SSIM in the loss, and that where a goal limits the loss of SSIM; 3DGS has 0.2, without the
squared error."""


class TrainingViewSettings(BaseModel):
    """Settings that compaction and fine-tuning share: loss, training views and seed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ssim_weight: float | None = Field(
        None,
        ge=0,
        le=1,
        description=f"Weight of 1 - SSIM in the loss; L1 has the rest of 1. auto: {SSIM_GOAL_WEIGHT} where "
        f"max_ssim_drop of encode is given, else {SSIM_WEIGHT}.",
    )
    mse_weight: float = Field(
        5.0, ge=0, le=1000, description="Weight of the mean squared error in the loss, added to SSIM and L1."
    )
    synthetic_view_share: float = Field(
        0.05,
        ge=0,
        le=0.9,
        description="With a capture: share of training steps that use a virtual camera in or around the scene, with a "
        "rendering of the original scene as target; at least one in each round of the photographs, unless it is 0. "
        "Preserves what no photograph shows.",
    )
    views: int = Field(
        384,
        ge=1,
        le=10_000,
        description="Number of virtual views without a capture, up to four times as many for a scene of several "
        "objects; an eighth of them is held out. Their sides are three fifths of view_size.",
    )
    view_size: int = Field(
        640,
        ge=16,
        le=8192,
        description="Longer side of the training images, pixels. Photographs with up to 1.5 times that are used "
        "whole; of larger ones every n-th pixel and row, so that the side is 0.75 to 1.5 times that.",
    )
    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="Seed of the order of the training images and of the virtual cameras. Equal seeds give equal "
        "scenes.",
    )

    @property
    def used_ssim_weight(self) -> float:
        """Weight of 1 - SSIM in the loss, as given or the usual one."""
        return SSIM_WEIGHT if self.ssim_weight is None else self.ssim_weight

    def with_ssim_weight(self, weight: float) -> Self:
        """Return a copy with this weight of 1 - SSIM, unless one is given."""
        return self if self.ssim_weight is not None else self.model_copy(update={"ssim_weight": weight})
