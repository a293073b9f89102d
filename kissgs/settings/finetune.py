"""``FinetuneSettings``: how levels become better when all else is chosen."""

from __future__ import annotations

from pydantic import Field

from kissgs.settings.training import TrainingViewSettings


class FinetuneSettings(TrainingViewSettings):
    """How the numbers in the images are improved against pictures of what a decoder makes of them."""

    enabled: bool = Field(False, description="Fine-tune. Takes pictures to learn from: photographs are the best.")
    steps: int = Field(1000, ge=1, le=1_000_000, description="Of training.")
    batch: int = Field(1, ge=1, le=64, description="Pictures in each step.")
    prune_threshold_bits: float = Field(
        100.0,
        ge=0,
        le=200,
        description="Where bits are weighed: leave out Gaussians that show less than so many bits are worth before "
        "training, which closes the holes. Without effect where it is less than that of encoding, or that is 0.",
    )
    lr: float = Field(
        0.06, gt=0, le=10, description="Learning rate at the beginning, in steps of each attribute; SH's entries apart."
    )
    codebook_lr: float = Field(0.2, gt=0, le=10, description="The same of the SH codebook's entries.")
    synthetic_lr_scale: float = Field(
        0.3,
        gt=0,
        le=10,
        description="Both times this where renderings of the scene teach: they leave less to learn.",
    )
    final_lr_scale: float = Field(0.05, gt=0, le=1, description="What is left of both at the end.")
    rate_weight: float = Field(
        2.0,
        ge=0,
        le=100,
        description="Weight of bytes against errors: 1 is that by which levels were chosen. Levels become such as many "
        "others have.",
    )
    tv_weight: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Weight of differences between neighbouring pixels of the images, in units of the paper's; from "
        "0.35 to 0.6 of the steps it grows from nothing.",
    )
