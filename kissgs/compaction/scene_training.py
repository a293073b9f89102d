"""``SceneTraining``: a scene that is pruned and trained in turn, and its state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from kissgs.cameras.virtual.scene_bounds import scene_bounds
from kissgs.compaction.schedule import BASE_LR, Phase, lr_schedule
from kissgs.compaction.scoring import prune_by_score
from kissgs.core.array_types import Float32, Int
from kissgs.core.deadline import Deadline, Pace
from kissgs.core.progress import Progress
from kissgs.core.splats import Splats
from kissgs.rendering.rasterizer import Device
from kissgs.settings import CompactSettings
from kissgs.training.supervision import SupervisionViews

if TYPE_CHECKING:
    from kissgs.compaction.checkpoint_state import State
    from kissgs.training.loop import Regularizer
    from kissgs.training.model import GaussianModel
    from kissgs.training.targets import TrainingTargets

MIN_RELATIVE_EXTENT = 1e-4
"""Extent of the cameras, in radii of the scene, up to which they count as being at one position: a rotating camera,
whose extent is 0 except for rounding."""

MOST_STEP_PER_SIZE = 0.025
"""Largest learning rate of a position, in units of the Gaussian's size: the middle one of its three scales."""

MIN_SCORE = {True: 0.05, False: 0.3}
"""Lowest score, in units of the score that an unobstructed camera nearby would find: True with a capture, whose cameras
show what matters, False for virtual views."""


@dataclass(slots=True, eq=False)
class SceneTraining:
    """Prunes and trains one scene, step by step.

    Attributes:
        source: the scene before any pruning, clean.
        settings: settings of pruning and training.
        supervision: views that score and train.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        device: device of the training. Scores are always computed on the CPU.
        index: ``(M,)`` index in ``source`` of each Gaussian that is left, ascending.
    """

    source: Splats
    settings: CompactSettings
    supervision: SupervisionViews
    threads: int = 0
    device: Device = "cpu"
    index: Int[np.ndarray, " M"] = field(init=False)
    _model: GaussianModel | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.index = np.arange(len(self.source))

    def __len__(self) -> int:
        return len(self.index)

    @property
    def trained(self) -> GaussianModel:
        """The trainable scene, after :meth:`begin`."""
        assert self._model is not None  # noqa: S101  callers begin first
        return self._model

    @property
    def begun(self) -> bool:
        """Whether the scene is trainable."""
        return self._model is not None

    def splats(self) -> Splats:
        """Return the current scene."""
        if self._model is not None:
            return self.trained.splats()
        return self.source if len(self) == len(self.source) else self.source.select(self.index)

    def prune(self, count: int, progress: Progress) -> None:
        """Keep the ``count`` Gaussians that images would miss most; reports the stage "score"."""
        kept = prune_by_score(
            self.splats(),
            self.supervision.score,
            self.supervision.background,
            count,
            min_keep_per_scoring=self.settings.min_keep_per_scoring,
            min_score=MIN_SCORE[self.supervision.captured],
            threads=self.threads,
            progress=progress,
        )
        self.index = self.index[kept]
        if self._model is not None:
            self._model.keep(kept)

    def begin(self, targets: TrainingTargets) -> None:
        """Make the current scene trainable."""
        from kissgs.training.model import GaussianModel

        self._model = GaussianModel(self.splats(), self.device, self._position_extents(targets))

    def restore(self, state: State, index: Int[np.ndarray, " M"], targets: TrainingTargets) -> None:
        """Continue from the :meth:`kissgs.training.model.GaussianModel.state` of the Gaussians at ``index``."""
        from kissgs.training.model import GaussianModel

        self.index = index
        self._model = GaussianModel.restored(state, self.source, self.device, self._position_extents(targets))

    def state(self) -> State:
        """Return a copy of the state of the training, see :meth:`restore`."""
        return {name: array.copy() for name, array in self.trained.state().items()}

    def train(
        self,
        phase: Phase,
        targets: TrainingTargets,
        seed: Sequence[int],
        *,
        regularizers: tuple[Regularizer, ...] = (),
        first: int = 0,
        after: Callable[[int], None] = lambda done: None,
        deadline: Deadline | None = None,
        progress: Progress,
    ) -> None:
        """Train for one phase, with fewer steps where ``deadline`` comes first.

        The other arguments are those of :func:`kissgs.training.loop.train`.
        """
        from kissgs.training.loop import TrainingPlan, train

        plan = TrainingPlan(
            stage=phase.name,
            pace=Pace(phase.steps, deadline),
            rates=lr_schedule(self.settings, phase, targets.target_source),
            ssim_weight=self.settings.used_ssim_weight,
            mse_weight=self.settings.mse_weight,
            seed=seed,
            regularizers=(*self._shape_regularizers(targets), *regularizers),
        )
        train(self.trained, targets, plan, first=first, after=after, threads=self.threads, progress=progress)

    def _shape_regularizers(self, targets: TrainingTargets) -> tuple[Regularizer, ...]:
        settings = self.settings
        if not (settings.erank_weight or settings.min_scale_weight):
            return ()
        from kissgs.compaction.regularizers import ShapeRegularizer

        return (ShapeRegularizer(settings.erank_weight, settings.min_scale_weight, self._camera_extent(targets)),)

    def _camera_extent(self, targets: TrainingTargets) -> float:
        """Return the extent of the cameras, world units; the scene's radius if they are nearly at one position."""
        radius = scene_bounds(self.source).radius
        return targets.extent if targets.extent > MIN_RELATIVE_EXTENT * radius else radius

    def _position_extents(self, targets: TrainingTargets) -> Float32[np.ndarray, " M"]:
        """Return the unit of the position learning rate of each Gaussian, from its position and size in the source.

        The rate of 3DGS is a share of the extent of the cameras. In a detailed scene that is much of a Gaussian's size,
        and positions become noise. So no rate of these settings is more than :data:`MOST_STEP_PER_SIZE` sizes.
        """
        settings = self.settings
        extents = targets.local_extents(self.source.means[self.index], self._camera_extent(targets))
        sizes = np.exp(np.median(self.source.scales[self.index].astype(np.float64), axis=1))
        most = BASE_LR["means"] * max(settings.means_lr_scale, settings.final_means_lr_scale)
        return np.minimum(MOST_STEP_PER_SIZE / most * sizes, extents).astype(np.float32)
