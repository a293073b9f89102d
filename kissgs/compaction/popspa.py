"""``Popspa``: score and prune, train, refine (POPSpa, KISS-GS, section 3.1); ``TrainingPath``: falling counts."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.captures.photos import open_file
from kissgs.compaction.result import Compacted, CompactionReport, CompactionStep
from kissgs.compaction.scene_training import (
    Phase,
    SceneTraining,
    State,
    Status,
    first_pruning_count,
    stage_progress,
    training_phases,
)
from kissgs.core.array_types import Int
from kissgs.core.errors import OutputError
from kissgs.core.progress import DEFAULT_CONTEXT, Context, Deadline, load_kernels
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import ImageMetrics
from kissgs.settings import CompactSettings, Preset, Settings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.encode import encode
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews

if TYPE_CHECKING:
    from kissgs.compaction.regularizers import AdmmSparsifier
    from kissgs.training.supervision import TrainingTargets


# ``StepLog``: the steps of a compaction for the report.


@dataclass(slots=True, eq=False)
class StepLog:
    """Records each step with its wall time, without that of ``evaluate``, which measures quality and size."""

    evaluate: Callable[[Splats], tuple[ImageMetrics, int]] | None
    steps: list[CompactionStep] = field(default_factory=list)
    _started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """Wall time since the last step ended, seconds."""
        return time.perf_counter() - self._started

    def record(self, name: str, scene: Splats) -> None:
        """Add the step that has just ended with ``scene``."""
        step = CompactionStep(name=name, count=len(scene), seconds=self.seconds)
        if self.evaluate is not None:
            found, size = self.evaluate(scene)
            step = replace(step, psnr=found.psnr, ssim=found.ssim, ms_ssim=found.ms_ssim, bytes=size)
        self.steps.append(step)
        self._started = time.perf_counter()

    def restore(self, steps: Sequence[CompactionStep], seconds: float) -> None:
        """Continue after ``steps``, with ``seconds`` of the next one spent before the interruption."""
        self.steps = list(steps)
        self._started -= seconds


@dataclass(slots=True, eq=False)
class Popspa:
    """Compacts one scene by POPSpa.

    On the device "cuda", sums have no fixed order, so that results vary slightly. Scores are computed on the CPU.
    """

    splats: Splats
    settings: CompactSettings  # their budget is ignored
    supervision: SupervisionViews
    context: Context = DEFAULT_CONTEXT
    targets: TrainingTargets | None = None  # of these views; loaded or rendered when first needed

    def __call__(self, count: int, *, evaluate: bool = False, checkpoint: Path | None = None) -> Compacted:
        """Return the scene with exactly ``count`` Gaussians; ``evaluate`` measures every step.

        Training continues from ``checkpoint`` if that exists and belongs to this work, on the CPU with the same result
        as without an interruption. It stays at the end.
        """
        if self.settings.trains:
            self.load_targets()
        key = "" if checkpoint is None else self._key(count, evaluate)
        log = StepLog(self.evaluate if evaluate else None)
        compacted = _Run(self, count, Checkpoint(checkpoint, key), log).run()
        return replace(compacted, checkpoint=checkpoint) if self.settings.trains else compacted

    def evaluate(self, scene: Splats) -> tuple[ImageMetrics, int]:
        """Return the mean image metrics of a scene with fewer Gaussians, and its bytes as a zip by the preset ``fast``.

        Evaluation views are used if they have photographs, else cameras drawn over the whole scene.
        """
        context, views = replace(self.context.stage("evaluate"), device="cpu"), self.supervision.eval_views
        if all(view.photo is None for view in views.test):
            views = evaluation_views(self.splats, context)
        evaluation = compare_images(self.splats, scene, views, context)
        encoded = encode(scene, Settings(preset=Preset.FAST).encode, context)
        return evaluation.mean.candidate, len(zip_bytes(encoded.files))

    def load_targets(self) -> TrainingTargets:
        """Return the target images, which are loaded or rendered once."""
        from kissgs.training.supervision import training_targets

        if self.targets is None:
            self.targets = training_targets(self.splats, self.supervision, self.context)
        return self.targets

    def _key(self, count: int, evaluate: bool) -> str:
        """Return the key of the work's checkpoint, equal only for equal results."""
        views, device, settings = self.supervision, self.context.device, self.settings.model_dump_json()
        text = f"{__version__} {count} {evaluate} {device} {settings} {views.background} "
        key = hashlib.sha256(f"{text}{views.synthetic} {views.synthetic_per_epoch}".encode())
        for view in (*views.train, *views.score, *views.test):
            camera = view.camera
            key.update(camera.viewmat.tobytes() + camera.K.tobytes() + f"{camera.width} {camera.height}".encode())
            key.update(f"{camera.dilation} {view.background} {view.undistortion} {view.sampling}".encode())
            if view.photo is not None:
                with open_file(view.photo) as (file, _):
                    key.update(file.read())
        for name in ATTRIBUTES:
            key.update(getattr(self.splats, name).tobytes())
        key.update(b"antialiased" * self.splats.antialiased)
        return key.hexdigest()


@dataclass(slots=True, eq=False)
class _Run:
    """One compaction and its state, which a checkpoint saves."""

    task: Popspa
    count: int
    checkpoint: Checkpoint
    log: StepLog
    training: SceneTraining = field(init=False)
    checkpoint_note: str = field(init=False, default="")

    def __post_init__(self) -> None:
        self.training = SceneTraining(self.task)

    def run(self) -> Compacted:
        """Do all steps, or those that remain after the checkpoint."""
        task = self.task
        load_kernels(task.context.progress)
        phases = training_phases(task.settings, len(task.splats), self.count)
        if not phases:
            self._first_pruning(self.count)
            return self._result("nothing")
        first, done, state = self._start()
        for number in range(first, len(phases)):
            self._train(phases, number, done, state)
            done, state = 0, {}
        self._save(len(phases), 0, {})
        return self._result(task.load_targets().target_source)

    def _start(self) -> tuple[int, int, State]:
        """Do the first pruning, or load the checkpoint; return the current phase, its steps done, and the state."""
        task = self.task
        state = self.checkpoint.load()
        if state is not None:
            status = Status.from_state(state)
            self.training.restore(state, state["index"])
            self.log.restore(status.steps, status.seconds)
            return status.phase, status.done, state
        self._first_pruning(first_pruning_count(task.settings, len(task.splats), self.count))
        self.training.begin()
        self._save(0, 0, {})  # a file that cannot be written must be reported before the training
        return 0, 0, {}

    def _first_pruning(self, count: int) -> None:
        """Prune the input to ``count`` Gaussians."""
        self.log.record("input", self.task.splats)
        self.training.prune(count, self.task.context)
        self.log.record("prune", self.training.splats())

    def _train(self, phases: Sequence[Phase], number: int, done: int, state: State) -> None:
        """Train phase ``number`` from step ``done`` on, then prune; ``state`` is that of the checkpoint, or empty."""
        phase, training = phases[number], self.training
        sparsifier = self._sparsifier(phase, state)

        def save_if_due(step: int) -> None:
            if self.checkpoint.due:
                self._save(number, step, {} if sparsifier is None else sparsifier.state())

        progress = stage_progress(self.task.context.progress, phases, number)
        context = replace(self.task.context, progress=progress, deadline=None)  # a given count takes all steps
        training.train(
            phase,
            number,
            context,
            regularizers=() if sparsifier is None else (sparsifier,),
            first=done,
            after=save_if_due,
        )
        self.log.record(phase.name, training.splats())
        if len(training) > phase.count:
            training.prune(phase.count, context)
            self.log.record("prune", training.splats())

    def _sparsifier(self, phase: Phase, state: State) -> AdmmSparsifier | None:
        from kissgs.compaction.regularizers import AdmmSparsifier

        settings = self.task.settings
        if phase.name != "sparsify" or not settings.admm_rho:
            return None
        opacities = self.training.trained.parameters["opacities"]
        sparsifier = AdmmSparsifier(opacities, phase.count, settings.admm_rho, settings.admm_interval)
        if "z" in state:  # a checkpoint from before the first step of a phase has none
            sparsifier.restore(state)
        return sparsifier

    def _save(self, number: int, done: int, sparsifier_state: State) -> None:
        """Save the state in phase ``number`` after ``done`` of its steps."""
        status = Status(number, done, self.log.seconds, self.log.steps)
        training = self.training
        state = {**training.trained.state(), **sparsifier_state, "index": training.index, **status.as_state()}
        try:
            self.checkpoint.save(state)
        except OutputError as error:
            if not (number or done):
                raise
            self.checkpoint_note = f"the work went on without a checkpoint: {error}"

    def _result(self, target_source: str) -> Compacted:
        supervision, scene = self.task.supervision, self.training.splats()
        report = CompactionReport(
            source_count=len(self.task.splats),
            count=len(scene),
            target_source=target_source,
            source=supervision.source,
            steps=tuple(self.log.steps),
            note="; ".join(filter(None, [supervision.note, self.checkpoint_note])),
        )
        return Compacted(scene, self.training.index, report)


# ``TrainingPath``: one training through falling numbers of Gaussians, which can be completed at any of them.

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

    def __post_init__(self) -> None:
        self.whole = PathPoint(0, self.task.splats, np.arange(len(self.task.splats)))
        self.points = [self.whole]

    def prune(self, count: int) -> PathPoint:
        """Prune to ``count`` Gaussians, and return the new point; reports the stages "kernels" and "score".

        If a progress receiver raises here or in :meth:`train`, the path stays as it was.
        """
        load_kernels(self.task.context.progress)
        training = self._at(self.points[-1])
        training.prune(count, self.task.context)
        return self._add(training, len(self.points))

    def train(self, deadline: Deadline | None = None) -> PathPoint:
        """Train the last point, and return it; reports "sparsify".

        :data:`POINT_STEPS` times ``sparsify_steps / prune_rounds`` steps are made, rounded down; with a deadline, as
        many of them as fit in.
        """
        task, point = self.task, self.points[-1]
        if task.settings.sparsify_steps == 0:
            return point
        per_point = POINT_STEPS[task.load_targets().target_source]
        steps = per_point * task.settings.sparsify_steps // task.settings.prune_rounds
        if steps == 0:
            return point
        training = self._at(point)
        if not point.trained:
            training.begin()
        context = replace(task.context, deadline=deadline)
        training.train(Phase("sparsify", steps, len(point)), point.number, context)
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
                training.begin()
            phase = Phase("refine", task.settings.refine_steps, len(point))
            training.train(phase, REFINEMENT + point.number, replace(task.context, deadline=deadline))
            splats = training.splats()
        report = CompactionReport(
            source_count=len(task.splats),
            count=len(splats),
            target_source=task.load_targets().target_source if point.trained or refine else "nothing",
            source=task.supervision.source,
            steps=(),
            note=task.supervision.note,
        )
        return Compacted(splats, point.index, report)

    def _at(self, point: PathPoint) -> SceneTraining:
        training = SceneTraining(self.task)
        training.index = point.index
        if point.state is not None:
            training.restore(point.state, point.index)
        return training

    def _add(self, training: SceneTraining, number: int) -> PathPoint:
        """Add the state of a training as the last point."""
        state = training.state() if training.begun else None
        if self.points and not self.keep_states:
            self.points[-1] = replace(self.points[-1], state=None)
        self.points.append(PathPoint(number, training.splats(), training.index, training.begun, state))
        return self.points[-1]
