"""``FinetuneSettings``: training of the quantised levels through the decoder."""

from __future__ import annotations

from pydantic import Field

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
    batch: int = Field(1, ge=1, le=64, description="Images per training step.")
    prune_threshold_bits: float = Field(
        100.0,
        ge=0,
        le=200,
        description="With rate_distortion: before training, prune Gaussians whose removal costs less than this many "
        "bits are worth; training closes the holes. No effect below prune_threshold_bits of encode, or if that is 0.",
    )
    lr: float = Field(
        0.06,
        gt=0,
        le=10,
        description="Initial learning rate of all attributes but the SH codebook, in quantisation steps.",
    )
    codebook_lr: float = Field(
        0.2, gt=0, le=10, description="Initial learning rate of the SH codebook, in quantisation steps."
    )
    synthetic_lr_scale: float = Field(
        0.3,
        gt=0,
        le=10,
        description="Factor on both learning rates when training targets are renderings: they leave less error to "
        "correct than photographs do.",
    )
    final_lr_scale: float = Field(0.05, gt=0, le=1, description="Factor on both learning rates at the last step.")
    rate_weight: float = Field(
        2.0,
        ge=0,
        le=100,
        description="Weight of the estimated rate against the image error, in units of the rd_lambda by which the "
        "levels were chosen. Moves levels to frequent ones, and entries of the codebook towards their neighbours.",
    )
    tv_weight: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Weight of the total variation of the planes, in units of the paper's; it grows from 0 between "
        "0.35 and 0.6 of the steps.",
    )
