"""``CompactSettings``: how many Gaussians compaction keeps, and how it prunes and trains."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from kissgs.settings.training import TrainingViewSettings


class CompactSettings(TrainingViewSettings):
    """Settings of compaction: the number of Gaussians to keep, the pruning schedule and the training."""

    count: int | None = Field(None, ge=1, description="Number of Gaussians to keep; a scene with fewer is unchanged.")
    ratio: float | None = Field(None, gt=0, le=1, description="Share of the Gaussians to keep, up to 1.")
    max_psnr_drop: float | None = Field(
        None,
        gt=0,
        le=20,
        description="Keep as few Gaussians as possible such that renderings of the held-out views lose at most this "
        "PSNR, decibels. Takes several compactions. Without a capture, the loss is estimated at random poses from "
        "which photographs might have been taken, as if the original scene had 30 dB to photographs.",
    )
    auto_count: bool | None = Field(
        None,
        description="Choose the number of Gaussians that meets the goal of encode best. Needs target_size, psnr, "
        "max_psnr_drop or max_ssim_drop of encode. auto: with a goal other than psnr and held-out photographs, or with "
        "fine-tuning and no capture, where torch is installed, unless count, ratio or max_psnr_drop is given. "
        "initial_prune_fraction and admm_rho do not apply then.",
    )
    method: Literal["prune", "merge"] = Field(
        "prune",
        description="prune: remove the Gaussians that images miss least, and train the rest. merge: replace neighbours "
        "by one Gaussian with their mean, covariance, colour and opacity; no images, no cameras, no training.",
    )
    max_compactions: int = Field(
        3,
        ge=1,
        le=20,
        description="With auto_count: largest number of containers that are made of trained scenes.",
    )
    min_keep_per_scoring: float = Field(
        0.8,
        ge=0,
        le=0.99,
        description="Smallest share of the Gaussians that pruning by one scoring may leave. Deeper pruning scores "
        "again in between, because a removal changes the scores of overlapping Gaussians. 0: score once.",
    )
    initial_prune_fraction: float = Field(
        0.43,
        ge=0,
        le=1,
        description="Share of the total pruning that the first pruning does, on a logarithmic scale: for a scene that "
        "shall keep 20 %, 0.43 keeps 50 %.",
    )
    sparsify_steps: int = Field(
        1500,
        ge=0,
        le=1_000_000,
        description="Training steps during gradual pruning; 0: prune all at once. With auto_count: "
        "sparsify_steps / prune_rounds at each number of Gaussians on the way, three times as many with photographs.",
    )
    prune_rounds: int = Field(
        5,
        ge=1,
        le=1000,
        description="Number of prunings during sparsify_steps, each by the same factor. The paper prunes once, at "
        "their end.",
    )
    refine_steps: int = Field(1500, ge=0, le=1_000_000, description="Training steps after the last pruning.")
    admm_rho: float = Field(
        0.0,
        ge=0,
        le=10,
        description="Penalty weight of ADMM, which pulls opacities of the next pruning candidates towards 0; 0: off.",
    )
    admm_interval: int = Field(
        50, ge=1, le=100_000, description="Steps between two ADMM updates, counted from the last pruning."
    )
    erank_weight: float = Field(
        0.0,
        ge=0,
        le=100,
        description="Weight of the effective rank in the loss: keeps Gaussians from becoming needles.",
    )
    min_scale_weight: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="Weight of each Gaussian's smallest scale in the loss, in units of the extent of the cameras.",
    )
    means_lr_scale: float = Field(
        1.0,
        gt=0,
        le=100,
        description="Learning rate of positions, in units of the initial one of 3DGS; lower for small Gaussians.",
    )
    final_means_lr_scale: float = Field(
        0.01,
        gt=0,
        le=100,
        description="Learning rate of positions at the end of refine_steps, in units of the initial one of 3DGS.",
    )
    lr_scale: float = Field(
        2.0, gt=0, le=100, description="All other learning rates before refine_steps, in units of those of 3DGS."
    )
    final_lr_scale: float = Field(
        0.1,
        gt=0,
        le=100,
        description="All other learning rates at the end of refine_steps, in units of those of 3DGS.",
    )
    synthetic_lr_scale: float = Field(
        0.5,
        gt=0,
        le=100,
        description="Factor on all learning rates when training targets are renderings: they leave less error to "
        "correct than photographs do.",
    )
    views: int = Field(
        384,
        ge=1,
        le=10_000,
        description="Number of virtual views without a capture, up to four times as many for a scene of several "
        "objects; an eighth of them is held out, and every fourth of the rest is used for scoring. Without training, "
        "a quarter of the number, all used for scoring. Their sides are three fifths of view_size. Each scoring view "
        "comes with four close-ups, with sides a quarter as long.",
    )

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


BUDGETS = ("count", "ratio", "max_psnr_drop", "auto_count")
