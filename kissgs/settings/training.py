"""``TrainingViewSettings``: the views that compaction and fine-tuning train on."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TrainingViewSettings(BaseModel):
    """Settings that compaction and fine-tuning share: loss, training views and seed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ssim_weight: float = Field(0.2, ge=0, le=1, description="Weight of 1 - SSIM in the loss; the rest is L1.")
    synthetic_view_share: float = Field(
        0.1,
        ge=0,
        le=0.9,
        description="With a capture: share of training steps that use a virtual camera around the scene, with a "
        "rendering of the original scene as target. Preserves parts that no photograph shows.",
    )
    views: int = Field(
        384,
        ge=1,
        le=10_000,
        description="Number of virtual views without a capture, up to four times as many for a scene of several "
        "objects; an eighth of them is held out. Their sides are three fifths of view_size.",
    )
    view_size: int = Field(640, ge=16, le=8192, description="Largest longer side of the training images, pixels.")
    seed: int = Field(
        0,
        ge=0,
        lt=2**31,
        description="Seed of the order of the training images and of the virtual cameras. Equal seeds give equal "
        "scenes.",
    )
