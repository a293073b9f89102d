"""``SceneTraining``: a scene that is pruned by scores and trained in turn (KISS-GS, section 3.1)."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from kissgs.cameras.views import View
from kissgs.cameras.virtual.candidates import scene_bounds
from kissgs.compaction.result import CompactionStep
from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.progress import DEFAULT_CONTEXT, Context, Pace, Progress
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import removal_scores
from kissgs.rendering.sensitivity import Coverage
from kissgs.settings import CompactSettings

if TYPE_CHECKING:
    from kissgs.compaction.popspa import Popspa
    from kissgs.training.loop import LrSchedule, Regularizer
    from kissgs.training.model import GaussianModel


# Pruning by the scores of GaussianPOP: the squared image error that the removal of one Gaussian would cause.


def highest_indices(scores: Float[np.ndarray, " N"], count: int) -> Int[np.ndarray, " M"]:
    """Return the indices of the ``count`` highest scores, ascending; of equal scores the first are selected."""
    selected = np.argsort(-scores, kind="stable")[:count]
    return np.sort(selected)


def prune_by_score(
    splats: Splats,
    views: Sequence[View],
    background: Float32[np.ndarray, "3"],
    count: int,
    context: Context = DEFAULT_CONTEXT,
    *,
    min_keep_per_scoring: float = 0.0,
    min_score: float = 0.0,
) -> Int[np.ndarray, " M"]:
    """Return the indices of the ``count`` Gaussians to keep: those whose removal would change the images most.

    GaussianPOP, section 3, with mean squared errors, so that every image has the same weight whatever its size. A score
    is the error of a single removal: of two Gaussians, one behind the other, each may be superfluous only while the
    other is there. So deep pruning is done in rounds that remove the same share each, and the remaining Gaussians are
    scored anew after each. No round leaves less than ``min_keep_per_scoring`` of them (0: a single round), and no score
    is below ``min_score`` of what an unobstructed camera nearby would find.
    """
    kept = np.arange(len(splats))
    close_up = Coverage(splats).close_up
    share = min_keep_per_scoring
    rounds = max(1, math.ceil(math.log(count / max(len(splats), count)) / math.log(share) - 1e-9)) if share > 0 else 1
    shrink = (count / max(len(splats), 1)) ** (1 / rounds)
    for round_ in range(rounds):
        if len(kept) <= count:
            break

        def report(stage: str, fraction: float, note: str = "", done: int = round_) -> None:
            context.progress(stage, (done + fraction) / rounds, note)

        scene = splats.select(kept)
        scores = _mean_scores(scene, views, background, replace(context, progress=report))
        scores = np.maximum(scores, min_score * _nearby_scores(scores, close_up[kept]))
        left = count if round_ == rounds - 1 else max(count, round(len(splats) * shrink ** (round_ + 1)))
        kept = kept[highest_indices(scores, left)]
    context.progress("score", 1.0)
    return kept


def _mean_scores(
    scene: Splats, views: Sequence[View], background: Float32[np.ndarray, "3"], context: Context
) -> Float64[np.ndarray, " N"]:
    """Return the sum over views of the mean squared error that each removal causes, each view on its background."""
    groups = defaultdict[tuple[int, tuple[float, ...]], list[Camera]](list)
    for view in views:
        view_background = background if view.background is None else view.background
        groups[view.camera.width * view.camera.height, tuple(view_background.tolist())].append(view.camera)
    scores, done = np.zeros(len(scene)), 0
    for (pixels, colour), cameras in groups.items():

        def report(stage: str, fraction: float, note: str = "", done: int = done, count: int = len(cameras)) -> None:
            context.progress(stage, (done + fraction * count) / len(views), note)

        found = removal_scores(scene, cameras, replace(context, progress=report), background=colour)
        scores += found / (3 * pixels)
        done += len(cameras)
    return scores


def _nearby_scores(scores: Float[np.ndarray, " N"], close_up: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Estimate the score that an unobstructed camera near each Gaussian would find.

    It is taken as proportional to ``close_up``, see :attr:`kissgs.rendering.sensitivity.Coverage.close_up`; the factor
    is the median over the Gaussians that were seen, or 1 if none was.
    """
    seen = (scores > 0) & (close_up > 0)
    if not seen.any():
        return close_up
    return np.asarray(np.median(scores[seen] / close_up[seen]) * close_up)


# Schedule of POPSpa: phases of training, the prunings between them, and learning rates (KISS-GS, section 3.1).

BASE_LR = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}
"""Learning rates of 3DGS by parameter; that of positions is in units of the extent of the cameras around each."""


@dataclass(frozen=True, slots=True)
class Phase:
    """Training steps, and the number of Gaussians that the pruning after them leaves."""

    name: Literal["sparsify", "refine"]
    steps: int
    count: int


def first_pruning_count(settings: CompactSettings, source_count: int, count: int) -> int:
    """Return the number of Gaussians that the first pruning leaves, before any training."""
    fraction = settings.initial_prune_fraction if settings.sparsify_steps else 1.0
    return round(source_count * (count / source_count) ** fraction)


def training_phases(settings: CompactSettings, source_count: int, count: int) -> list[Phase]:
    """Return all phases of training: one before each further pruning, then refinement; none if nothing is trained.

    The prunings are spread evenly over ``sparsify_steps``, and each keeps the same share of the Gaussians.
    """
    phases = []
    if settings.sparsify_steps:
        rounds = min(settings.prune_rounds, settings.sparsify_steps)
        first, fractions = first_pruning_count(settings, source_count, count), np.arange(1, rounds + 1) / rounds
        counts = np.rint(first * (count / first) ** fractions).astype(int)
        ends = np.rint(settings.sparsify_steps * np.concatenate([[0], fractions])).astype(int)
        phases = [Phase("sparsify", int(steps), int(left)) for steps, left in zip(np.diff(ends), counts, strict=True)]
    if settings.refine_steps:
        phases.append(Phase("refine", settings.refine_steps, count))
    return phases


def stage_progress(progress: Progress, phases: Sequence[Phase], number: int) -> Progress:
    """Return a receiver that reports phase ``number`` and the pruning after it as a part of one stage.

    All phases of the same name, and the prunings after them, are one stage of that name.
    """
    name = phases[number].name
    before = sum(phase.steps for phase in phases[:number] if phase.name == name)
    total = sum(phase.steps for phase in phases if phase.name == name)

    def receive(stage: str, fraction: float, note: str = "") -> None:
        done = phases[number].steps * (fraction if stage == name else 1.0)
        progress(name, (before + done) / total, note)

    return receive


def lr_schedule(settings: CompactSettings, phase: Phase, target_source: str) -> LrSchedule:
    """Return learning rates: constant while Gaussians are pruned, falling exponentially during refinement.

    3DGS does the latter for positions only. ``target_source`` is that of the training targets: "photos" or
    "renderings".
    """
    from kissgs.training.loop import exponential_lr

    base = dict(BASE_LR)
    if target_source == "renderings":
        base = {name: rate * settings.synthetic_lr_scale for name, rate in base.items()}
    begin = {name: settings.means_lr_scale if name == "means" else settings.lr_scale for name in base}
    end = {name: settings.final_means_lr_scale if name == "means" else settings.final_lr_scale for name in base}
    return exponential_lr(base, begin, end if phase.name == "refine" else begin)


# Checkpoint of a compaction: the status beside the state of the training.

State = Mapping[str, np.ndarray]
"""Arrays of a checkpoint by name."""

STATUS_ENTRY = "status"
"""Name of the array that holds the status as JSON; part of the file format."""


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


# ``SceneTraining``: a scene that is pruned and trained in turn, and its state.

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
    """Prunes and trains the scene of a task, step by step."""

    task: Popspa
    index: Int[np.ndarray, " M"] = field(init=False)  # in that scene, of each Gaussian that is left, ascending
    _model: GaussianModel | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        self.index = np.arange(len(self.task.splats))

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
        source = self.task.splats
        return source if len(self) == len(source) else source.select(self.index)

    def prune(self, count: int, context: Context) -> None:
        """Keep the ``count`` Gaussians that images would miss most; reports the stage "score"."""
        views = self.task.supervision
        kept = prune_by_score(
            self.splats(),
            views.score,
            views.background,
            count,
            context,
            min_keep_per_scoring=self.task.settings.min_keep_per_scoring,
            min_score=MIN_SCORE[views.captured],
        )
        self.index = self.index[kept]
        if self._model is not None:
            self._model.keep(kept)

    def begin(self) -> None:
        """Make the current scene trainable."""
        from kissgs.training.model import GaussianModel

        self._model = GaussianModel(self.splats(), self.task.context.device, self._position_extents())

    def restore(self, state: State, index: Int[np.ndarray, " M"]) -> None:
        """Continue from the :meth:`kissgs.training.model.GaussianModel.state` of the Gaussians at ``index``."""
        from kissgs.training.model import GaussianModel

        self.index, device = index, self.task.context.device
        self._model = GaussianModel.restored(state, self.task.splats, device, self._position_extents())

    def state(self) -> State:
        """Return a copy of the state of the training, see :meth:`restore`."""
        return {name: array.copy() for name, array in self.trained.state().items()}

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

        The other arguments are those of :func:`kissgs.training.loop.train`.
        """
        from kissgs.training.loop import TrainingPlan, train

        settings, targets = self.task.settings, self.task.load_targets()
        plan = TrainingPlan(
            stage=phase.name,
            pace=Pace(phase.steps, context.deadline),
            rates=lr_schedule(settings, phase, targets.target_source),
            ssim_weight=settings.ssim_weight,
            mse_weight=settings.mse_weight,
            seed=(settings.seed, number),
            regularizers=(*self._shape_regularizers(), *regularizers),
        )
        train(self.trained, targets, plan, context, first=first, after=after)

    def _shape_regularizers(self) -> tuple[Regularizer, ...]:
        settings = self.task.settings
        if not (settings.erank_weight or settings.min_scale_weight):
            return ()
        from kissgs.compaction.regularizers import ShapeRegularizer

        return (ShapeRegularizer(settings.erank_weight, settings.min_scale_weight, self._camera_extent()),)

    def _camera_extent(self) -> float:
        """Return the extent of the cameras, world units; the scene's radius if they are nearly at one position."""
        radius, extent = scene_bounds(self.task.splats).radius, self.task.load_targets().extent
        return extent if extent > MIN_RELATIVE_EXTENT * radius else radius

    def _position_extents(self) -> Float32[np.ndarray, " M"]:
        """Return the unit of the position learning rate of each Gaussian, from its position and size in the source.

        The rate of 3DGS is a share of the extent of the cameras. In a detailed scene that is much of a Gaussian's size,
        and positions become noise. So no rate of these settings is more than :data:`MOST_STEP_PER_SIZE` sizes.
        """
        settings, source = self.task.settings, self.task.splats
        extents = self.task.load_targets().local_extents(source.means[self.index], self._camera_extent())
        sizes = np.exp(np.median(source.scales[self.index].astype(np.float64), axis=1))
        most = BASE_LR["means"] * max(settings.means_lr_scale, settings.final_means_lr_scale)
        return np.minimum(MOST_STEP_PER_SIZE / most * sizes, extents).astype(np.float32)
