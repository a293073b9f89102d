"""``Popspa``: score and prune, train, refine (POPSpa, KISS-GS, section 3.2); ``TrainingPath``: falling counts."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from kissgs._version import __version__
from kissgs.cameras.captures.photos import open_file
from kissgs.cameras.virtual.select import scene_bounds
from kissgs.compaction.result import Compacted, CompactionReport, CompactionStep
from kissgs.compaction.scoring import prune_by_score
from kissgs.core.array_types import Float32, Int
from kissgs.core.context import DEFAULT_CONTEXT, Context, Deadline, Pace, Progress, load_kernels
from kissgs.core.errors import OutputError
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import ImageMetrics
from kissgs.io.containers import zip_bytes
from kissgs.settings import CompactSettings, Preset, Settings
from kissgs.sogxt.encode import encode
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.supervision import SupervisionViews, TrainingTargets, training_targets

if TYPE_CHECKING:
    from kissgs.compaction.regularizers import AdmmSparsifier
    from kissgs.training.loop import LrSchedule, Regularizer
    from kissgs.training.model import GaussianModel


# Schedule of POPSpa: phases of training, the prunings between them, and learning rates (KISS-GS, section 3.2).

# Learning rates before and at the end of refinement, in units of those of 3DGS; factor for renderings as targets.
MEANS_LR, OTHER_LR, RENDERINGS_LR = (1.0, 0.01), (2.0, 0.1), 0.5


@dataclass(frozen=True, slots=True)
class Phase:
    """Training steps, and the number of Gaussians that the pruning after them leaves."""

    name: Literal["sparsify", "refine"]
    steps: int
    count: int
    first: int = 0  # number of steps before it


def first_pruning_count(settings: CompactSettings, source_count: int, count: int) -> int:
    """Return the number of Gaussians that the first pruning leaves, before any training."""
    fraction = settings.initial_prune_fraction if settings.sparsify_steps else 1.0
    return round(source_count * (count / source_count) ** fraction)


def training_phases(settings: CompactSettings, source_count: int, count: int) -> list[Phase]:
    """Return all phases of training: one before each further pruning, then refinement; none if nothing is trained. The
    prunings are spread evenly over ``sparsify_steps``, and each keeps the same share of the Gaussians."""
    phases = []
    if settings.sparsify_steps:
        rounds = min(settings.prune_rounds, settings.sparsify_steps)
        first, fractions = first_pruning_count(settings, source_count, count), np.arange(1, rounds + 1) / rounds
        counts = np.rint(first * (count / first) ** fractions).astype(int)
        ends = np.rint(settings.sparsify_steps * np.concatenate([[0], fractions])).astype(int)
        for begin, end, left in zip(ends[:-1].tolist(), ends[1:].tolist(), counts.tolist(), strict=True):
            phases.append(Phase("sparsify", end - begin, left, begin))
    if settings.refine_steps:
        phases.append(Phase("refine", settings.refine_steps, count, settings.sparsify_steps))
    return phases


def stage_progress(progress: Progress, phases: Sequence[Phase], number: int) -> Progress:
    """Return a receiver that reports phase ``number`` and the pruning after it as a part of one stage. All phases of
    the same name, and the prunings after them, are one stage of that name."""
    name = phases[number].name
    before = sum(phase.steps for phase in phases[:number] if phase.name == name)
    total = sum(phase.steps for phase in phases if phase.name == name)

    def receive(stage: str, fraction: float, note: str = "") -> None:
        done = phases[number].steps * (fraction if stage == name else 1.0)
        progress(name, (before + done) / total, note)

    return receive


def lr_schedule(settings: CompactSettings, phase: Phase, target_source: str) -> LrSchedule:
    """Return learning rates: those of 3DGS continued, or constant ones while Gaussians are pruned that fall
    exponentially during refinement. ``target_source`` is that of the training targets: "photos" or "renderings"."""
    from kissgs.training.loop import BASE_LR, continued_lr, exponential_lr

    if settings.lr_offset is not None:
        return continued_lr(BASE_LR, settings.lr_offset + phase.first, phase.steps)
    scale = RENDERINGS_LR if target_source == "renderings" else 1.0
    base = {name: rate * scale for name, rate in BASE_LR.items()}
    begin = {name: MEANS_LR[0] if name == "means" else OTHER_LR[0] for name in base}
    end = {name: MEANS_LR[1] if name == "means" else OTHER_LR[1] for name in base}
    return exponential_lr(base, begin, end if phase.name == "refine" else begin)


# Checkpoint of a compaction: the status beside the state of the training.

State = Mapping[str, np.ndarray]  # arrays of a checkpoint by name
STATUS_ENTRY = "status"  # name of the array that holds the status as JSON; part of the file format


@dataclass(frozen=True, slots=True)
class Status:
    """Progress of a compaction."""

    phase: int  # the number of phases once all are done
    done: int  # steps of this phase
    seconds: float  # since the last recorded step
    steps: Sequence[CompactionStep]

    def as_state(self) -> State:
        """Return the status as an array for the checkpoint, see :meth:`from_state`."""
        return {STATUS_ENTRY: np.frombuffer(json.dumps(asdict(self)).encode(), np.uint8)}

    @classmethod
    def from_state(cls, state: State) -> Status:
        """Return the status in a checkpoint."""
        values = json.loads(state[STATUS_ENTRY].tobytes())
        return cls(**{**values, "steps": [CompactionStep(**step) for step in values["steps"]]})


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
    """Compacts one scene by POPSpa. On the device "cuda", sums have no fixed order, so that results vary slightly.
    Scores are computed on the CPU."""

    splats: Splats
    settings: CompactSettings  # their budget is ignored
    supervision: SupervisionViews
    context: Context = DEFAULT_CONTEXT
    targets: TrainingTargets | None = None  # of these views; loaded or rendered when first needed

    def __call__(self, count: int, *, evaluate: bool = False, checkpoint: Path | None = None) -> Compacted:
        """Return the scene with exactly ``count`` Gaussians; ``evaluate`` measures every step. Training continues from
        ``checkpoint`` if that exists and belongs to this work, on the CPU with the same result as without an
        interruption. It stays at the end."""
        if self.settings.trains:
            self.load_targets()
        key = "" if checkpoint is None else self._key(count, evaluate)
        log = StepLog(self.evaluate if evaluate else None)
        training = SceneTraining(self, np.arange(len(self.splats)))
        compacted = _Run(self, count, Checkpoint(checkpoint, key), log, training).run()
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


# ``SceneTraining``: a scene that is pruned and trained in turn, and its state.

MIN_RELATIVE_EXTENT = 1e-4  # of cameras, in radii of the scene, up to which they count as one rotating camera
MOST_STEP_PER_SIZE = 0.025  # largest rate of a position over the Gaussian's size, the middle of its scales

# Lowest score, in units of what an unobstructed camera nearby would find: True with a capture.
MIN_SCORE = {True: 0.05, False: 0.3}


@dataclass(slots=True, eq=False)
class SceneTraining:
    """Prunes and trains the scene of a compactor, step by step."""

    compactor: Popspa
    index: Int[np.ndarray, " M"]  # in that scene, of each Gaussian that is left, ascending
    _model: GaussianModel | None = field(init=False, default=None)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def trained(self) -> GaussianModel:
        """The trainable scene, after :meth:`begin`."""
        assert self._model is not None  # noqa: S101  callers begin first
        return self._model

    def splats(self) -> Splats:
        """Return the current scene."""
        if self._model is not None:
            return self._model.splats()
        source = self.compactor.splats
        return source if len(self) == len(source) else source.select(self.index)

    def prune(self, count: int, context: Context) -> None:
        """Keep the ``count`` Gaussians that images would miss most; reports the stage "score"."""
        views, settings = self.compactor.supervision, self.compactor.settings
        share, least = settings.min_keep_per_scoring, settings.score_floor * MIN_SCORE[views.captured]
        limits = {"min_keep_per_scoring": share, "min_score": least}
        kept = prune_by_score(self.splats(), views.score, views.background, count, context, **limits)
        self.index = self.index[kept]
        if self._model is not None:
            self._model.keep(kept)

    def begin(self) -> None:
        """Make the current scene trainable."""
        from kissgs.training.model import GaussianModel

        self._model = GaussianModel(self.splats(), self.compactor.context.device, self._position_extents())

    def restore(self, state: State, index: Int[np.ndarray, " M"]) -> None:
        """Continue from the :meth:`kissgs.training.model.GaussianModel.state` of the Gaussians at ``index``."""
        from kissgs.training.model import GaussianModel

        self.index, device = index, self.compactor.context.device
        self._model = GaussianModel.restored(state, self.compactor.splats, device, self._position_extents())

    def state(self) -> State | None:
        """Return a copy of the state of the training, see :meth:`restore`; None before it."""
        return None if self._model is None else {name: each.copy() for name, each in self._model.state().items()}

    def train(
        self,
        phase: Phase,
        number: int,
        context: Context,
        *,
        regularizers: tuple[Regularizer, ...] = (),
        first: int = 0,
        after: Callable[[int], None] = lambda done: None,
    ) -> None:
        """Train for a phase, in fewer steps where the deadline is near; each ``number`` has another order of images.
        The other arguments are those of :func:`kissgs.training.loop.train`."""
        from kissgs.compaction.regularizers import ShapeRegularizer
        from kissgs.training.loop import TrainingPlan, train

        settings, targets = self.compactor.settings, self.compactor.load_targets()
        if phase.name == "sparsify" and (settings.erank_weight or settings.min_scale_weight):
            regularizers = (ShapeRegularizer(settings.erank_weight, settings.min_scale_weight), *regularizers)
        plan = TrainingPlan(
            stage=phase.name,
            pace=Pace(phase.steps, context.deadline),
            rates=lr_schedule(settings, phase, targets.target_source),
            ssim_weight=settings.ssim_weight,
            mse_weight=settings.mse_weight,
            seed=(settings.seed, number),
            regularizers=regularizers,
        )
        train(self.trained, targets, plan, context, first=first, after=after)

    def _camera_extent(self) -> float:
        """Return the extent of the cameras, world units; the scene's radius if they are nearly at one position."""
        radius, extent = scene_bounds(self.compactor.splats).radius, self.compactor.load_targets().extent
        return extent if extent > MIN_RELATIVE_EXTENT * radius else radius

    def _position_extents(self) -> Float32[np.ndarray, " M"]:
        """Return the unit of the position learning rate of each Gaussian, from its position and size in the source. The
        rate of 3DGS is a share of the extent of the cameras. In a detailed scene that is much of a Gaussian's size, and
        positions become noise. So no rate of these settings is more than :data:`MOST_STEP_PER_SIZE` sizes, unless they
        continue those of 3DGS."""
        from kissgs.training.loop import BASE_LR

        settings, source = self.compactor.settings, self.compactor.splats
        if settings.lr_offset is not None:
            return np.full(len(self), self._camera_extent(), np.float32)
        extents = self.compactor.load_targets().local_extents(source.means[self.index], self._camera_extent())
        sizes = np.exp(np.median(source.scales[self.index].astype(np.float64), axis=1))
        return np.minimum(MOST_STEP_PER_SIZE / (BASE_LR["means"] * MEANS_LR[0]) * sizes, extents).astype(np.float32)


@dataclass(slots=True, eq=False)
class _Run:
    """One compaction and its state, which a checkpoint saves."""

    compactor: Popspa
    count: int
    checkpoint: Checkpoint
    log: StepLog
    training: SceneTraining
    checkpoint_note: str = field(init=False, default="")

    def run(self) -> Compacted:
        """Do all steps, or those that remain after the checkpoint."""
        compactor = self.compactor
        load_kernels(compactor.context.progress)
        phases = training_phases(compactor.settings, len(compactor.splats), self.count)
        if not phases:
            self._first_pruning(self.count)
            return self._result("nothing")
        first, done, state = self._start()
        for number in range(first, len(phases)):
            self._train(phases, number, done, state)
            done, state = 0, {}
        self._save(len(phases), 0, {})
        return self._result(compactor.load_targets().target_source)

    def _start(self) -> tuple[int, int, State]:
        """Do the first pruning, or load the checkpoint; return the current phase, its steps done, and the state."""
        compactor, state = self.compactor, self.checkpoint.load()
        if state is not None:
            status = Status.from_state(state)
            self.training.restore(state, state["index"])
            self.log.restore(status.steps, status.seconds)
            return status.phase, status.done, state
        self._first_pruning(first_pruning_count(compactor.settings, len(compactor.splats), self.count))
        self.training.begin()
        self._save(0, 0, {})  # a file that cannot be written must be reported before the training
        return 0, 0, {}

    def _first_pruning(self, count: int) -> None:
        self.log.record("input", self.compactor.splats)
        self.training.prune(count, self.compactor.context)
        self.log.record("prune", self.training.splats())

    def _train(self, phases: Sequence[Phase], number: int, done: int, state: State) -> None:
        """Train phase ``number`` from step ``done`` on, then prune; ``state`` is that of the checkpoint, or empty."""
        phase, training = phases[number], self.training
        sparsifier = self._sparsifier(phase, state)

        def save_if_due(step: int) -> None:
            if self.checkpoint.due:
                self._save(number, step, {} if sparsifier is None else sparsifier.state())

        progress = stage_progress(self.compactor.context.progress, phases, number)
        context = replace(self.compactor.context, progress=progress, deadline=None)  # a given count takes all steps
        regularizers = () if sparsifier is None else (sparsifier,)
        training.train(phase, number, context, regularizers=regularizers, first=done, after=save_if_due)
        self.log.record(phase.name, training.splats())
        if len(training) > phase.count:
            training.prune(phase.count, context)
            self.log.record("prune", training.splats())

    def _sparsifier(self, phase: Phase, state: State) -> AdmmSparsifier | None:
        from kissgs.compaction.regularizers import AdmmSparsifier

        settings = self.compactor.settings
        if phase.name != "sparsify" or not settings.admm_rho:
            return None
        opacities = self.training.trained.parameters["opacities"]
        sparsifier = AdmmSparsifier(opacities, phase.count, settings.admm_rho, settings.admm_interval)
        if "z" in state:  # a checkpoint from before the first step of a phase has none
            sparsifier.restore(state)
        return sparsifier

    def _save(self, number: int, done: int, sparsifier_state: State) -> None:
        """Save the state in phase ``number`` after ``done`` of its steps."""
        status, training = Status(number, done, self.log.seconds, self.log.steps), self.training
        state = {**training.trained.state(), **sparsifier_state, "index": training.index, **status.as_state()}
        try:
            self.checkpoint.save(state)
        except OutputError as error:
            if not (number or done):
                raise
            self.checkpoint_note = f"the work went on without a checkpoint: {error}"

    def _result(self, target_source: str) -> Compacted:
        supervision, scene = self.compactor.supervision, self.training.splats()
        report = CompactionReport(
            source_count=len(self.compactor.splats),
            count=len(scene),
            target_source=target_source,
            source=supervision.source,
            steps=tuple(self.log.steps),
            note="; ".join(filter(None, [supervision.note, self.checkpoint_note])),
        )
        return Compacted(scene, self.training.index, report)


# ``TrainingPath``: one training through falling numbers of Gaussians, which can be completed at any of them.

REFINEMENT = 1_000_000  # number of the refinement in seeds: no path has as many points

# Training steps at a point by the targets, in units of those between two prunings of a compaction to one number. At
# points that are passed on the way to another, one unit serves (docs/method/research-log.md, "More training").
POINT_STEPS = {"photos": 3, "renderings": 1}


@dataclass(frozen=True, slots=True, eq=False)
class PathPoint:
    """The scene at one number of Gaussians."""

    number: int  # on its path, 0 for the whole scene
    splats: Splats
    index: Int[np.ndarray, " M"]  # in the whole scene, ascending
    trained: bool = False
    steps: int = 0  # of training that were made at this point
    state: Mapping[str, np.ndarray] | None = None  # from which training continues; None if it is forgotten

    def __len__(self) -> int:
        return len(self.splats)


@dataclass(slots=True, eq=False)
class TrainingPath:
    """Prunes and trains a scene in turn, and keeps the scene at every number of Gaussians. Learning rates stay high
    along the path. :meth:`compacted` lets them fall from any of its points, which a compaction to that number alone
    would do at its end. So several numbers of Gaussians share one training."""

    compactor: Popspa
    keep_states: bool = True  # every point, not just the last one, can be refined: that takes three times the memory
    points: list[PathPoint] = field(init=False)  # the whole scene first
    whole: PathPoint = field(init=False)  # without training, also after the first point was trained

    def __post_init__(self) -> None:
        self.whole = PathPoint(0, self.compactor.splats, np.arange(len(self.compactor.splats)))
        self.points = [self.whole]

    def prune(self, count: int) -> PathPoint:
        """Prune to ``count`` Gaussians, and return the new point; reports the stages "kernels" and "score". If a
        progress receiver raises here or in :meth:`train`, the path stays as it was."""
        load_kernels(self.compactor.context.progress)
        training = self._at(self.points[-1])
        training.prune(count, self.compactor.context)
        return self._add(training, len(self.points), 0)

    def train(self, *, passed: bool = False, deadline: Deadline | None = None) -> PathPoint:
        """Train the last point, and return it; reports "sparsify". :data:`POINT_STEPS` times ``sparsify_steps /
        prune_rounds`` steps are made in all, rounded down, or a single time as many if it is ``passed`` on the way to
        another; with a deadline, as many of them as fit in."""
        compactor, point = self.compactor, self.points[-1]
        if compactor.settings.sparsify_steps == 0:
            return point
        units = 1 if passed else POINT_STEPS[compactor.load_targets().target_source]
        steps = units * compactor.settings.sparsify_steps // compactor.settings.prune_rounds
        if steps <= point.steps:
            return point
        training = self._at(point)
        if not point.trained:
            training.begin()
        context = replace(compactor.context, deadline=deadline)
        made = [point.steps]
        phase = Phase("sparsify", steps, len(point))
        training.train(phase, point.number, context, first=point.steps, after=made.append)
        self.points.pop()
        return self._add(training, point.number, made[-1])

    def compacted(self, point: PathPoint, *, refine: bool, deadline: Deadline | None = None) -> Compacted:
        """Return a point as a compacted scene; ``refine`` completes its training with falling learning rates. With a
        ``deadline``, as many of its steps are made as fit in; reports the stage "refine"."""
        compactor, splats = self.compactor, point.splats
        if refine and compactor.settings.refine_steps:
            training = self._at(point)
            if not point.trained:
                training.begin()
            phase = Phase("refine", compactor.settings.refine_steps, len(point))
            training.train(phase, REFINEMENT + point.number, replace(compactor.context, deadline=deadline))
            splats = training.splats()
        report = CompactionReport(
            source_count=len(compactor.splats),
            count=len(splats),
            target_source=compactor.load_targets().target_source if point.trained or refine else "nothing",
            source=compactor.supervision.source,
            note=compactor.supervision.note,
        )
        return Compacted(splats, point.index, report)

    def _at(self, point: PathPoint) -> SceneTraining:
        training = SceneTraining(self.compactor, point.index)
        if point.state is not None:
            training.restore(point.state, point.index)
        return training

    def _add(self, training: SceneTraining, number: int, steps: int) -> PathPoint:
        """Add the state of a training as the last point."""
        state = training.state()
        if self.points and not self.keep_states:
            self.points[-1] = replace(self.points[-1], state=None)
        trained = state is not None
        self.points.append(PathPoint(number, training.splats(), training.index, trained, steps, state))
        return self.points[-1]
