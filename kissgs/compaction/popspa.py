"""``Popspa``: score and prune, train while pruning further, refine (POPSpa, KISS-GS, section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs.cameras.virtual.scene_bounds import scene_bounds
from kissgs.compaction.checkpoint_state import State, Status, work_key
from kissgs.compaction.evaluate import step_log
from kissgs.compaction.result import Compacted, CompactionReport
from kissgs.compaction.schedule import Phase, first_pruning_count, lr_schedule, stage_progress, training_phases
from kissgs.compaction.scoring import prune_by_score
from kissgs.compaction.step_log import StepLog
from kissgs.core.array_types import Float32, Int
from kissgs.core.errors import OutputError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.rasterizer import Device, load_kernels
from kissgs.settings import CompactSettings
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews

if TYPE_CHECKING:
    from kissgs.compaction.regularizers import ShapeRegularizer
    from kissgs.compaction.sparsify import AdmmSparsifier
    from kissgs.training.model import GaussianModel
    from kissgs.training.targets import TrainingTargets

MIN_RELATIVE_EXTENT = 1e-4
"""Extent of the cameras, in radii of the scene, up to which they count as being at one position: a rotating camera,
whose extent is 0 except for rounding."""

MIN_SCORE = {True: 0.05, False: 0.3}
"""Lowest score, in units of the score that an unobstructed camera nearby would find: True with a capture, whose cameras
show what matters, False for virtual views."""


@dataclass(frozen=True, slots=True, eq=False)
class Popspa:
    """Compacts one scene by POPSpa.

    Attributes:
        splats: the scene, clean.
        settings: settings of pruning and training; their budget is ignored.
        supervision: views that score, train and evaluate.
        reference: the original scene, if ``splats`` is already pruned: its renderings are the targets where there are
            no photographs. By default ``splats``.
        targets: target images of the training views; by default they are loaded or rendered when needed.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        device: device of the training. ``"cuda"`` needs the extra ``kissgs[cuda]`` and adds in no fixed order, so that
            results vary slightly. Scores are always computed on the CPU.
        progress: receives the stages "kernels", "score", "targets", "sparsify", "refine" and "evaluate".
    """

    splats: Splats
    settings: CompactSettings
    supervision: SupervisionViews
    reference: Splats | None = None
    targets: TrainingTargets | None = None
    threads: int = 0
    device: Device = "cpu"
    progress: Progress = silent

    def __call__(self, count: int, *, evaluate: bool = False, checkpoint: Path | None = None) -> Compacted:
        """Return the scene with exactly ``count`` Gaussians.

        Args:
            count: number of Gaussians to keep, from 1 to that of the scene.
            evaluate: measure PSNR, SSIM, MS-SSIM and compressed bytes after every step.
            checkpoint: file for the state of the training, saved every half minute. If it exists and belongs to this
                work, training continues from it, on the CPU with the same result as without an interruption. It stays
                at the end; delete it once the result is saved.

        Raises:
            InvalidViewsError: a photograph cannot be read.
            OutputError: ``checkpoint`` belongs to other work, or cannot be written.
            UnsupportedError: torch is missing for the training; an image would take too much memory.
        """
        scenes = (self.splats, self.original)
        key = ""
        if checkpoint is not None:
            key = work_key(scenes, count, self.settings, self.supervision, evaluate, self.device)
        log = step_log(evaluate, self.original, self.supervision, self.threads, self.progress)
        compacted = _Run(self, count, Checkpoint(checkpoint, key), log).run()
        return replace(compacted, checkpoint=checkpoint) if self.settings.trains else compacted

    @property
    def original(self) -> Splats:
        """The original scene: the reference, or else the scene itself."""
        return self.reference or self.splats


@dataclass(slots=True, eq=False)
class _Run:
    """One compaction and its state, which a checkpoint saves.

    Attributes:
        task: scene, views and settings.
        count: number of Gaussians to keep.
        checkpoint: where the state is saved.
        log: steps for the report.
        index: index in the scene of each Gaussian that is left, ascending.
        model: the trainable scene; set when training begins.
        checkpoint_note: note for the user if a checkpoint could not be saved.
    """

    task: Popspa
    count: int
    checkpoint: Checkpoint
    log: StepLog
    index: Int[np.ndarray, " M"] = field(init=False)
    model: GaussianModel = field(init=False)
    checkpoint_note: str = field(init=False, default="")

    def __post_init__(self) -> None:
        self.index = np.arange(len(self.task.splats))

    def run(self) -> Compacted:
        """Do all steps, or those that remain after the checkpoint."""
        task = self.task
        load_kernels(task.progress)
        phases = training_phases(task.settings, len(task.splats), self.count)
        if not phases:
            return self._result(self._first_pruning(self.count), "nothing")
        targets = task.targets or self._load_targets()
        first, done, state = self._start(targets)
        for number in range(first, len(phases)):
            self._train(phases, number, done, state, targets)
            done, state = 0, {}
        self._save(len(phases), 0, {})
        return self._result(self.model.splats(), targets.target_source)

    def _load_targets(self) -> TrainingTargets:
        from kissgs.training.targets import training_targets

        task = self.task
        return training_targets(
            task.original,
            task.supervision.train,
            task.supervision.background,
            threads=task.threads,
            device=task.device,
            progress=task.progress,
        )

    def _start(self, targets: TrainingTargets) -> tuple[int, int, State]:
        """Do the first pruning, or load the checkpoint; return the current phase, its steps done, and the state."""
        from kissgs.training.model import GaussianModel

        task = self.task
        state = self.checkpoint.load()
        if state is not None:
            status = Status.from_state(state)
            self.index = state["index"]
            self.model = GaussianModel.restored(state, task.device, self._position_extents(targets))
            self.log.restore(status.steps, status.seconds)
            return status.phase, status.done, state
        scene = self._first_pruning(first_pruning_count(task.settings, len(task.splats), self.count))
        self.model = GaussianModel(scene, task.device, self._position_extents(targets))
        self._save(0, 0, {})  # a file that cannot be written must be reported before the training
        return 0, 0, {}

    def _first_pruning(self, count: int) -> Splats:
        """Prune the input to ``count`` Gaussians."""
        self.log.record("input", self.task.splats)
        scene = self.task.splats.select(self._prune(self.task.splats, count, self.task.progress))
        self.log.record("prune", scene)
        return scene

    def _prune(self, scene: Splats, count: int, progress: Progress) -> Int[np.ndarray, " M"]:
        """Return the indices in ``scene`` of the ``count`` Gaussians to keep, and update :attr:`index`."""
        task = self.task
        kept = prune_by_score(
            scene,
            task.supervision.score,
            task.supervision.background,
            count,
            min_keep_per_scoring=task.settings.min_keep_per_scoring,
            min_score=MIN_SCORE[task.supervision.captured],
            threads=task.threads,
            progress=progress,
        )
        self.index = self.index[kept]
        return kept

    def _train(self, phases: Sequence[Phase], number: int, done: int, state: State, targets: TrainingTargets) -> None:
        """Train phase ``number`` from step ``done`` on, then prune; ``state`` is that of the checkpoint, or empty."""
        from kissgs.training.loop import TrainingPlan, train

        phase, settings = phases[number], self.task.settings
        shape, sparsifier = self._shape_regularizer(targets), self._sparsifier(phase, state)

        def save_if_due(step: int) -> None:
            if self.checkpoint.due:
                self._save(number, step, {} if sparsifier is None else sparsifier.state())

        plan = TrainingPlan(
            stage=phase.name,
            steps=phase.steps,
            rates=lr_schedule(settings, phase, targets.target_source),
            ssim_weight=settings.ssim_weight,
            seed=(settings.seed, number),
            regularizers=tuple(term for term in (shape, sparsifier) if term is not None),
        )
        progress = stage_progress(self.task.progress, phases, number)
        train(
            self.model,
            targets,
            plan,
            first=done,
            after=save_if_due,
            threads=self.task.threads,
            progress=progress,
        )
        scene = self.model.splats()
        self.log.record(phase.name, scene)
        if len(scene) > phase.count:
            self.model.keep(self._prune(scene, phase.count, progress))
            self.log.record("prune", self.model.splats())

    def _shape_regularizer(self, targets: TrainingTargets) -> ShapeRegularizer | None:
        from kissgs.compaction.regularizers import ShapeRegularizer

        settings = self.task.settings
        if not (settings.erank_weight or settings.min_scale_weight):
            return None
        return ShapeRegularizer(settings.erank_weight, settings.min_scale_weight, self._camera_extent(targets))

    def _sparsifier(self, phase: Phase, state: State) -> AdmmSparsifier | None:
        from kissgs.compaction.sparsify import AdmmSparsifier

        settings = self.task.settings
        if phase.name != "sparsify" or not settings.admm_rho:
            return None
        opacities = self.model.parameters["opacities"]
        sparsifier = AdmmSparsifier(opacities, phase.count, settings.admm_rho, settings.admm_interval)
        if "z" in state:  # a checkpoint from before the first step of a phase has none
            sparsifier.restore(state)
        return sparsifier

    def _camera_extent(self, targets: TrainingTargets) -> float:
        """Return the extent of the cameras, world units; the scene's radius if they are nearly at one position."""
        radius = scene_bounds(self.task.splats).radius
        return targets.extent if targets.extent > MIN_RELATIVE_EXTENT * radius else radius

    def _position_extents(self, targets: TrainingTargets) -> Float32[np.ndarray, " M"]:
        """Return the unit of the position learning rate of each Gaussian left, from its position in the input."""
        return targets.local_extents(self.task.splats.means[self.index], self._camera_extent(targets))

    def _save(self, number: int, done: int, sparsifier_state: State) -> None:
        """Save the state in phase ``number`` after ``done`` of its steps.

        Raises:
            OutputError: the first checkpoint cannot be written. Later, the work continues without one.
        """
        status = Status(number, done, self.log.seconds, self.log.steps)
        state = {**self.model.state(), **sparsifier_state, "index": self.index, **status.as_state()}
        try:
            self.checkpoint.save(state)
        except OutputError as error:
            if not (number or done):
                raise
            self.checkpoint_note = f"the work went on without a checkpoint: {error}"

    def _result(self, scene: Splats, target_source: str) -> Compacted:
        supervision = self.task.supervision
        report = CompactionReport(
            source_count=len(self.task.splats),
            count=len(scene),
            target_source=target_source,
            source=supervision.source,
            steps=tuple(self.log.steps),
            note="; ".join(filter(None, [supervision.note, self.checkpoint_note])),
        )
        return Compacted(scene, self.index, report)
