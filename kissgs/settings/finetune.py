"""``FinetuneSettings``: training of the quantised levels through the decoder."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from kissgs.settings.stage import Rate, Weight, of_preset
from kissgs.settings.training import TrainingViewSettings


class FinetuneSettings(TrainingViewSettings):
    """Settings of fine-tuning: training of the levels, so that the decoded scene renders closer to the targets."""

    enabled: bool | None = Field(
        None,
        description="Fine-tune, against photographs if there are any, else renderings. auto: with a goal other than "
        "psnr and held-out photographs or no capture, where torch is installed.",
    )
    steps: int = Field(
        1000,
        ge=1,
        le=1_000_000,
        description="Number of training steps; a fifth more where auto_count of compact leaves training to complete.",
    )
    batch: Annotated[int, Field(ge=1, le=64)] = of_preset(1, "Images per training step.")
    prune_threshold_bits: Annotated[float, Field(ge=0, le=200)] = of_preset(
        100.0, "As that of encode, if that is not 0, before training, which closes the holes."
    )
    lr: Rate = of_preset(0.06, "Initial learning rate of all but the SH codebook, in quantisation steps.")
    codebook_lr: Rate = of_preset(0.2, "Initial learning rate of the SH codebook, in quantisation steps.")
    synthetic_lr_scale: Rate = of_preset(0.3, "Factor on both where targets are renderings, which leave less error.")
    final_lr_scale: Annotated[float, Field(gt=0, le=1)] = of_preset(0.05, "Factor on both at the last step.")
    rate_weight: Weight = of_preset(
        2.0, "Weight of the estimated rate, in units of rd_lambda, against the image error."
    )
    tv_weight: Weight = of_preset(0.0, "Weight of the total variation of the planes, in units of the paper's.")
