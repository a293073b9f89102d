"""``CompactSettings``: how a scene comes to have fewer Gaussians."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from kissgs.settings.training import TrainingViewSettings


class CompactSettings(TrainingViewSettings):
    """How many Gaussians are left, and how they learn to do the work of the others."""

    count: int | None = Field(None, ge=1, description="Keep so many Gaussians; a scene with fewer stays as it is.")
    ratio: float | None = Field(None, gt=0, le=1, description="Keep this share of the Gaussians.")
    max_psnr_drop: float | None = Field(
        None,
        gt=0,
        le=20,
        description="Keep as few as are found whose pictures from held-out views lose at most so many decibels. "
        "Takes several compactions. Without photographs, from cameras drawn as for 'evaluate', but others, and as if "
        "the scene were 30 dB from them.",
    )
    auto_count: bool = Field(
        False,
        description="Keep as many as serve the goal of encode best: where target_size, psnr or max_psnr_drop is given.",
    )
    max_compactions: int = Field(
        3, ge=1, le=20, description="Where auto_count is true: compactions that are tried, at most."
    )
    min_keep_per_scoring: float = Field(
        0.8,
        ge=0,
        le=0.99,
        description="The smallest share that one scoring may leave; pruning that goes further scores again in between, "
        "because Gaussians may cover for each other. 0: one scoring will do.",
    )
    initial_prune_fraction: float = Field(
        0.43,
        ge=0,
        le=1,
        description="How much of the way the first pruning goes, on a scale of ratios: of a scene that shall keep "
        "20 %, 0.43 keeps 50 %.",
    )
    sparsify_steps: int = Field(
        1500, ge=0, le=1_000_000, description="Steps of training while the rest of the Gaussians go; 0: all go at once."
    )
    prune_rounds: int = Field(
        5,
        ge=1,
        le=1000,
        description="Prunings along these steps, by the same factor each; the paper has one, at their end.",
    )
    refine_steps: int = Field(1500, ge=0, le=1_000_000, description="Steps of training when all have gone.")
    admm_rho: float = Field(
        0.0, ge=0, le=10, description="How hard opacities of those that shall go next are drawn to 0 before; 0: not."
    )
    admm_interval: int = Field(
        50, ge=1, le=100_000, description="Steps between two such pulls, counted anew after each pruning."
    )
    erank_weight: float = Field(
        0.0, ge=0, le=100, description="Of effective rank in the loss: keeps Gaussians from becoming needles."
    )
    min_scale_weight: float = Field(
        0.0,
        ge=0,
        le=1000,
        description="Of the smallest extent of each Gaussian in the loss, in extents of the cameras.",
    )
    means_lr_scale: float = Field(
        1.0, gt=0, le=100, description="Learning rate of positions, in units of that with which 3DGS begins."
    )
    final_means_lr_scale: float = Field(0.01, gt=0, le=100, description="The same at the end of the last steps.")
    lr_scale: float = Field(
        2.0, gt=0, le=100, description="All other learning rates, in units of those of 3DGS, until the last steps."
    )
    final_lr_scale: float = Field(0.1, gt=0, le=100, description="The same at the end of the last steps.")
    synthetic_lr_scale: float = Field(
        0.5,
        gt=0,
        le=100,
        description="All learning rates times this where renderings of the scene teach: they leave less to learn than "
        "photographs do.",
    )
    views: int = Field(
        384,
        ge=1,
        le=10_000,
        description="Virtual views where there is no capture to learn from, up to four times as many for a scene of "
        "several objects, an eighth of them held out; every fourth of the rest scores. Without training a quarter of "
        "them, and all score. Their sides are three fifths of view_size. Beside each that scores there are four "
        "close-ups with sides a quarter as long.",
    )

    @property
    def enabled(self) -> bool:
        """Whether a budget is given: without one, a scene keeps all its Gaussians."""
        return bool(self._given)

    @property
    def steps(self) -> int:
        """Of training, in all."""
        return self.sparsify_steps + self.refine_steps

    @property
    def trains(self) -> bool:
        """Whether what is left is fitted to pictures; else it is pruned and nothing more."""
        return self.steps > 0

    @model_validator(mode="after")
    def _one_budget(self) -> Self:
        given = self._given
        if len(given) > 1:
            raise ValueError(f"{given[0]} and {given[1]} cannot both be met; give one")
        return self

    @property
    def _given(self) -> list[str]:
        return [name for name in BUDGETS if getattr(self, name) not in (None, False)]


BUDGETS = ("count", "ratio", "max_psnr_drop", "auto_count")
