"""``TrainingViewSettings``: the loss, the views and the seed of compaction and fine-tuning."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from kissgs.settings.stage import Pixels, Seed, Share, StageSettings, Weight, of_preset

SSIM_WEIGHT, SSIM_GOAL_WEIGHT = 0.3, 0.4
"""Usual weight of 1 - SSIM in the loss, and that where a goal limits the loss of SSIM; 3DGS has 0.2, without the
squared error."""


class TrainingViewSettings(StageSettings):
    """Values that compaction and fine-tuning share: loss, training views and seed."""

    ssim_weight: Share = of_preset(
        SSIM_WEIGHT, f"Weight of 1 - SSIM in the loss; {SSIM_GOAL_WEIGHT} with max_ssim_drop."
    )
    mse_weight: Weight = of_preset(5.0, "Weight of the mean squared error; L1 has the rest of 1 beside SSIM.")
    synthetic_view_share: Annotated[float, Field(ge=0, le=0.9)] = of_preset(
        0.05, "With a capture: share of steps by renderings of the original scene from virtual cameras."
    )
    views: Annotated[int, Field(ge=1, le=10_000)] = of_preset(
        384, "Virtual views without a capture, up to four times as many for several objects; an eighth is held out."
    )
    view_size: Pixels = of_preset(640, "Longer side of training images, pixels; of virtual views three fifths of it.")
    seed: Seed = of_preset(0, "Seed of the order of images and of virtual cameras: that of encode.")
