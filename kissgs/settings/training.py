"""``TrainingViewSettings``: from where a scene is looked at to learn from its pictures."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field


class TrainingViewSettings(BaseModel):
    """What is learned from, by all that trains."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    ssim_weight: float = Field(0.2, ge=0, le=1, description="Of 1 - SSIM in the loss; the rest is absolute difference.")
    synthetic_view_share: float = Field(
        0.1,
        ge=0,
        le=0.9,
        description="Where there is a capture: share of pictures from virtual cameras all around it, of the scene as "
        "it was. What was never photographed must not fall apart.",
    )
    views: int = Field(
        384,
        ge=1,
        le=10_000,
        description="Virtual views where there is no capture to learn from, up to four times as many for a scene of "
        "several objects, an eighth of them held out. Their sides "
        "are three fifths of view_size.",
    )
    view_size: int = Field(640, ge=16, le=8192, description="Longer side of pictures to learn from, pixels, at most.")
    seed: int = Field(
        0, ge=0, lt=2**31, description="Of the order of the pictures, and of virtual cameras. Same seed: same scene."
    )
