"""``Pruning``: points of a training path that are pruned without training, and what each of them loses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kissgs.compaction.result import CountTrial
from kissgs.core.splats import Splats
from kissgs.evaluation.psnr_loss import drop_of
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.path_points import count_at
from kissgs.pipeline.trial import Trial

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.training_path import PathPoint, TrainingPath


PRUNABLE_DROP = 1.0
"""Drop of PSNR, decibels, up to which pruning goes on without training."""


def is_prunable(trial: Trial) -> bool:
    """Whether a point may be pruned further without training."""
    return (trial.drop or 0.0) <= PRUNABLE_DROP  # false where a rendering failed


@dataclass(slots=True, eq=False)
class Pruning:
    """Prunes a scene along its path without training, and measures what that loses.

    Attributes:
        goal: what the losses are measured for.
        compactor: compactor of the scene.
        path: its path.
        losses: figures of the points 1, 2 and so on that were measured, without an encoding.
        tried: the same for the report, and of any other scene that was measured.
    """

    goal: Goal
    compactor: Compactor
    path: TrainingPath
    losses: list[Trial] = field(default_factory=list)
    tried: list[CountTrial] = field(default_factory=list)

    def prune_to(self, number: int) -> PathPoint:
        """Prune up to a point of the path, and return the last one."""
        while len(self.path.points) <= number:
            self.path.prune(count_at(len(self.path.points), len(self.compactor.splats)))
        return self.path.points[-1]

    def prune_while(self, useful: Callable[[Trial], bool], most: int) -> None:
        """Prune and measure point after point up to number ``most``, or to the first that is not ``useful``."""
        while len(self.path.points) <= most and len(self.path.points[-1]) > 1:
            trial = self.measure(self.prune_to(len(self.path.points)).splats)
            self.losses.append(trial)
            if not useful(trial):
                break

    def last(self, serves: Callable[[Trial], bool]) -> int:
        """Return the number of the last measured point that ``serves``; 0 for none."""
        return max((number for number, trial in enumerate(self.losses, 1) if serves(trial)), default=0)

    def measure(self, splats: Splats) -> Trial:
        """Return the figures of a scene that is not encoded, and record them for the report."""
        evaluation = self.compactor.evaluate(splats)
        trial = self.goal.measured(Trial(len(splats), None, 0), evaluation)
        ssim_decides = self.goal.decisive(trial).setting == "max_ssim_drop"
        self.tried.append(CountTrial(len(splats), drop_of(evaluation), trial.ssim_drop, ssim_decides))
        return trial
