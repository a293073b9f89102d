"""``CompactSettings``: how many Gaussians compaction keeps, and how it prunes and trains."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from kissgs.settings.stage import Count, Rate, Share, Steps, Weight, of_preset
from kissgs.settings.training import TrainingViewSettings

BUDGETS = ("count", "ratio", "max_psnr_drop", "auto_count")


class CompactSettings(TrainingViewSettings):
    """Settings of compaction: the number of Gaussians to keep, the pruning schedule and the training."""

    count: Annotated[int, Field(ge=1)] | None = Field(
        None, description="Number of Gaussians to keep, if there are more."
    )
    ratio: Annotated[float, Field(gt=0, le=1)] | None = Field(None, description="Share of the Gaussians to keep.")
    max_psnr_drop: Annotated[float, Field(gt=0, le=20)] | None = Field(
        None, description="Keep as few Gaussians as lose at most this PSNR, decibels, measured as for that of encode."
    )
    auto_count: bool | None = Field(
        None,
        description="Choose the number of Gaussians that serves the goal of encode best. auto: with a goal other than "
        "psnr, held-out photographs or fine-tuning without a capture, and torch, unless another budget is given.",
    )
    method: Literal["prune", "merge"] = Field(
        "prune",
        description="prune: remove the Gaussians that images miss least, and train the rest. merge: replace neighbours "
        "by one Gaussian with their mean, covariance, colour and opacity; no images, no cameras, no training.",
    )
    max_compactions: Annotated[int, Field(ge=1, le=20)] = Field(
        3, description="With auto_count: largest number of containers that are made of trained scenes."
    )
    min_keep_per_scoring: Annotated[float, Field(ge=0, le=0.99)] = of_preset(
        0.8, "Smallest share that pruning by one scoring may leave; deeper pruning scores again. 0: score once."
    )
    initial_prune_fraction: Share = of_preset(0.43, "Share of the first pruning in the logarithm of all pruning.")
    sparsify_steps: Steps = of_preset(1500, "Training steps during gradual pruning; 0: prune all at once.")
    prune_rounds: Count = of_preset(5, "Prunings during sparsify_steps, by equal factors; the paper has one.")
    refine_steps: Steps = of_preset(1500, "Training steps after the last pruning.")
    admm_rho: Weight = of_preset(0.0, "Penalty of ADMM, which pulls opacities of candidates for pruning towards 0.")
    admm_interval: Annotated[int, Field(ge=1)] = of_preset(50, "Steps between two updates of ADMM.")
    erank_weight: Weight = of_preset(0.0, "Weight of the effective rank: keeps Gaussians from becoming needles.")
    min_scale_weight: Weight = of_preset(0.0, "Weight of the smallest scales, in units of the cameras' extent.")
    means_lr_scale: Rate = of_preset(1.0, "Learning rate of positions, in units of the initial one of 3DGS.")
    final_means_lr_scale: Rate = of_preset(0.01, "The same at the end of refine_steps.")
    lr_scale: Rate = of_preset(2.0, "Other learning rates before refine_steps, in units of those of 3DGS.")
    final_lr_scale: Rate = of_preset(0.1, "The same at the end of refine_steps.")
    synthetic_lr_scale: Rate = of_preset(0.5, "Factor on all where targets are renderings, which leave less error.")

    @property
    def enabled(self) -> bool:
        """Whether a budget is given; without one, all Gaussians are kept."""
        return bool(self._given)

    @property
    def steps(self) -> int:
        """Total number of training steps; 0 where Gaussians merge."""
        return 0 if self.method == "merge" else self.sparsify_steps + self.refine_steps

    @property
    def trains(self) -> bool:
        """Whether the scene is trained."""
        return self.steps > 0

    @model_validator(mode="after")
    def _one_budget(self) -> Self:
        given = self._given
        if len(given) > 1:
            raise ValueError(f"{given[0]} and {given[1]} cannot both be met; give one")
        return self

    @property
    def _given(self) -> list[str]:
        return [name for name in BUDGETS if getattr(self, name)]
