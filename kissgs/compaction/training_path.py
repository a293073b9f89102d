"""``TrainingPath``: one training through falling numbers of Gaussians, which can be completed at any of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from kissgs.compaction.popspa import Popspa
from kissgs.compaction.result import Compacted, CompactionReport
from kissgs.compaction.scene_training import Phase, SceneTraining
from kissgs.core.array_types import Int
from kissgs.core.progress import Deadline, load_kernels
from kissgs.core.splats import Splats

if TYPE_CHECKING:
    from kissgs.training.supervision import TrainingTargets

REFINEMENT = 1_000_000
"""Number of the refinement in seeds: no path has as many points."""

POINT_STEPS = {"photos": 3, "renderings": 1}
"""Training steps at a point by the targets, in units of those between two prunings of a compaction to one number.

With photographs, a third of them saves 42 % of the processor time of a first container and takes 5 to 7 % more bytes
(docs/method/research-log.md, "More training").
"""


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """The scene at one number of Gaussians."""

    number: int  # on its path, 0 for the whole scene
    splats: Splats
    index: Int[np.ndarray, " M"]  # in the whole scene, ascending
    trained: bool = False
    state: Mapping[str, np.ndarray] | None = None  # from which training continues; None if it is forgotten

    def __len__(self) -> int:
        return len(self.splats)


@dataclass(slots=True, eq=False)
class TrainingPath:
    """Prunes and trains a scene in turn, and keeps the scene at every number of Gaussians.

    Learning rates stay high along the path. :meth:`compacted` lets them fall from any of its points, which a compaction
    to that number alone would do at its end. So several numbers of Gaussians share one training.
    """

    task: Popspa
    keep_states: bool = True  # every point, not just the last one, can be refined: that takes three times the memory
    points: list[PathPoint] = field(init=False)  # the whole scene first
    whole: PathPoint = field(init=False)  # without training, also after the first point was trained
    _loaded: TrainingTargets | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.whole = PathPoint(0, self.task.splats, np.arange(len(self.task.splats)))
        self.points = [self.whole]

    def prune(self, count: int) -> PathPoint:
        """Prune to ``count`` Gaussians, and return the new point; reports the stages "kernels" and "score".

        If a progress receiver raises here or in :meth:`train`, the path stays as it was.
        """
        load_kernels(self.task.progress)
        training = self._at(self.points[-1])
        training.prune(count, self.task.progress)
        return self._add(training, len(self.points))

    def train(self, deadline: Deadline | None = None) -> PathPoint:
        """Train the last point, and return it; reports "sparsify".

        :data:`POINT_STEPS` times ``sparsify_steps / prune_rounds`` steps are made, rounded down; with a deadline, as
        many of them as fit in.
        """
        task, point = self.task, self.points[-1]
        if task.settings.sparsify_steps == 0:
            return point
        steps = POINT_STEPS[self.targets.target_source] * task.settings.sparsify_steps // task.settings.prune_rounds
        if steps == 0:
            return point
        training = self._at(point)
        if not point.trained:
            training.begin(self.targets)
        self._train(training, Phase("sparsify", steps, len(point)), point.number, deadline)
        self.points.pop()
        return self._add(training, point.number)

    def compacted(self, point: PathPoint, *, refine: bool, deadline: Deadline | None = None) -> Compacted:
        """Return a point as a compacted scene; ``refine`` completes its training with falling learning rates.

        With a ``deadline``, as many of its steps are made as fit in; reports the stage "refine".
        """
        task, splats = self.task, point.splats
        if refine and task.settings.refine_steps:
            training = self._at(point)
            if not point.trained:
                training.begin(self.targets)
            phase = Phase("refine", task.settings.refine_steps, len(point))
            self._train(training, phase, REFINEMENT + point.number, deadline)
            splats = training.splats()
        report = CompactionReport(
            source_count=len(task.splats),
            count=len(splats),
            target_source=self.targets.target_source if point.trained or refine else "nothing",
            source=task.supervision.source,
            steps=(),
            note=task.supervision.note,
        )
        return Compacted(splats, point.index, report)

    def _train(self, training: SceneTraining, phase: Phase, number: int, deadline: Deadline | None = None) -> None:
        task = self.task
        seed = (task.settings.seed, number)
        training.train(phase, self.targets, seed, deadline=deadline, progress=task.progress)

    @property
    def targets(self) -> TrainingTargets:
        """Target images of the training, which are loaded or rendered when they are first needed."""
        if self._loaded is None:
            self._loaded = self.task.load_targets()
        return self._loaded

    def _at(self, point: PathPoint) -> SceneTraining:
        task = self.task
        training = SceneTraining(task.splats, task.settings, task.supervision, task.threads, task.device)
        training.index = point.index
        if point.state is not None:
            training.restore(point.state, point.index, self.targets)
        return training

    def _add(self, training: SceneTraining, number: int) -> PathPoint:
        """Add the state of a training as the last point."""
        state = training.state() if training.begun else None
        if self.points and not self.keep_states:
            self.points[-1] = replace(self.points[-1], state=None)
        self.points.append(PathPoint(number, training.splats(), training.index, training.begun, state))
        return self.points[-1]
