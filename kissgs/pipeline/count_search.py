"""Search for the number of Gaussians and the lambda that serve a goal best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.compaction.result import CountTrial
from kissgs.core.errors import StopSearch
from kissgs.core.progress import SearchNote, ignore_stop_search
from kissgs.core.splats import Splats
from kissgs.evaluation.psnr_loss import drop_of
from kissgs.pipeline.candidates import Candidates
from kissgs.pipeline.goal import HALF_ERROR_DB, Goal
from kissgs.pipeline.path_points import OVERHEAD_BYTES, POINTS_PER_HALVING, count_at, last_number, number_for_size
from kissgs.pipeline.rate_control import RateControl
from kissgs.pipeline.search_time import SearchPlan, SearchTime
from kissgs.pipeline.trained_scenes import TrainedScenes
from kissgs.pipeline.trained_search import NEAR_HALVINGS, NEAR_IN_TIME, Position, search_positions
from kissgs.pipeline.training_choice import has_photographs
from kissgs.pipeline.trial import Trial

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.compaction.training_path import PathPoint, TrainingPath
    from kissgs.pipeline.encoding import Encoding

PRUNABLE_DROP = 1.0
"""Drop of PSNR, decibels, up to which pruning goes on without training."""

PRUNABLE_POINTS = 3
"""Number of the last point that is pruned without training where there are photographs: half of the Gaussians."""

BEYOND_PHOTOGRAPHS = (
    "trained for what the photographs show: beyond them it changes more (--evaluate measures how much; --compact 100% "
    "--finetune 0 keeps it)"
)


@dataclass(slots=True, eq=False)
class CountSearch:
    """Prune and train a scene along a path, and make containers at the points that promise most.

    Training on photographs starts where pruning alone begins to show. Renderings of the scene itself teach little: with
    them, training starts only for a size that pruning alone cannot reach. With fine-tuning, a point of the path is
    encoded as it is, and the training is completed through the decoder.

    Attributes:
        encoding: encoding of the whole scene.
        compactor: compactor of the same scene.
        time: the time of the search; None for no limit. It limits training on photographs only.
        aims: whether the goal is no more than an aim: if no container meets it in time, the closest one is kept.
        trials: all containers that were made, in order.
    """

    encoding: Encoding
    compactor: Compactor
    time: SearchTime | None = None
    aims: bool = False
    trials: list[Trial] = field(default_factory=list)
    _path: TrainingPath = field(init=False)
    _pruned: list[Trial] = field(init=False, default_factory=list)
    _tried: list[CountTrial] = field(init=False, default_factory=list)
    _candidates: Candidates = field(init=False)
    _scenes: TrainedScenes = field(init=False)
    _whole: RateControl | None = field(init=False, default=None)
    _stopped: bool = field(init=False, default=False)
    _plan: SearchPlan = field(init=False)

    def __post_init__(self) -> None:
        most = self.compactor.settings.max_compactions
        if not self._photographs:
            self.time = None
        plan = SearchPlan(most) if self.time is None else self.time.plan(aims=self.aims)
        self._plan = replace(plan, containers=min(plan.containers, most))
        if plan.brief:  # half of the views score nearly as well
            supervision = self.compactor.supervision
            score = supervision.score[::2]
            self.compactor = replace(self.compactor, supervision=replace(supervision, score=score))
        self._path = self.compactor.path(keep_states=not self._tunes)
        self._candidates = Candidates(self.goal, self.encoding.packed)
        self._scenes = TrainedScenes(
            encoding=self.encoding,
            compactor=self.compactor,
            path=self._path,
            photographs=self._photographs,
            offset_db=self._plan.offset_db if self._photographs else 0.0,
            time=self.time,
            containers=self._plan.containers,
        )

    def run(self) -> tuple[Compacted, RateControl | None, tuple[Trial, ...]]:
        """Return the scene that serves the goal best, the search that made its container, and all trials.

        If no smaller number of Gaussians serves the goal, the search is that for all of them, None if there was none.

        Raises:
            StopSearch: the search was stopped before any container met the goal.
        """
        from kissgs.compaction.budget import unchanged

        try:
            self._search()
        except StopSearch:
            self._stopped = True
            if self._candidates.best is None and not (self.aims and self._candidates.any_missed):
                progress = SearchNote(ignore_stop_search(self.encoding.progress))
                self.encoding = replace(self.encoding, progress=progress)
                self._encode(self._path.compacted(self._latest_point(), refine=False))
            if self._candidates.best is None and not self.aims:
                raise
        if self._candidates.best is None and self.aims:
            self._candidates.keep_closest()
        best, compacted = self._candidates.best, unchanged(self.compactor.splats, self._reason_to_keep_all())
        if best is not None:
            best.search.stopped |= self._stopped
            compacted = compacted if best.compacted.splats is self.compactor.splats else best.compacted
        trained = best is not None and compacted is best.compacted and self._photographs
        notes = filter(None, [compacted.report.note, self.compactor.note, BEYOND_PHOTOGRAPHS if trained else ""])
        report = replace(compacted.report, trials=tuple(self._tried), note="; ".join(notes))
        return replace(compacted, report=report), self._whole if best is None else best.search, tuple(self.trials)

    @property
    def goal(self) -> Goal:
        """The goal that the settings name."""
        return Goal.of(self.encoding.settings.encode)

    @property
    def _tunes(self) -> bool:
        return bool(self.encoding.settings.finetune.enabled)

    @property
    def _photographs(self) -> bool:
        """Whether to train on photographs; never for a PSNR to the scene's own renderings, which then falls."""
        trains = self.compactor.settings.trains and self.goal.limits[0].setting != "psnr"
        return trains and has_photographs(self.encoding.views)

    @property
    def _target_size(self) -> int:
        return self.encoding.settings.encode.target_size or 0

    @property
    def _number_for_size(self) -> int:
        return number_for_size(self.compactor.splats, self._target_size)

    @property
    def _first_number(self) -> int:
        """Number of the point that is tried first with photographs."""
        return self._number_for_size if self.goal.by_size else self._plan.number

    def _search(self) -> None:
        if not self._photographs:
            self._search_without_photographs()
        elif not self.goal.by_size or (self._target_size > OVERHEAD_BYTES and self._number_for_size > 0):
            if self.time is None:
                self._prune()
            else:  # what each point loses is not worth the time to measure it
                self._prune_to(min(self._first_number - 1, PRUNABLE_POINTS))
            self._search_along_path()

    def _search_without_photographs(self) -> None:
        """Encode all Gaussians, then those that leave half of the error to the encoder, or as many as fit the size."""
        search = self._whole = self._encode(self._path.compacted(self._path.points[0], refine=False))
        if search.stopped or (self.goal.by_size and search.trials[0].bytes <= self._target_size):
            return
        if not self.goal.by_size:
            if search.best is not None:
                self._prune()
                self._encode_last_pruned(lambda trial: self.goal.margin(trial) >= self.goal.decisive(trial).half)
        elif self._target_size > search.overhead:
            self._prune()
            if search.best is None or self._number_for_size > len(self._pruned):
                self._search_along_path() if self._tunes else self._encode_by_size()
            else:
                error = search.evaluate(search.best.encoded).mean.candidate_vs_reference.psnr
                self._encode_last_pruned(lambda trial: (trial.psnr or 0.0) >= error + HALF_ERROR_DB)

    def _prune(self) -> None:
        """Prune without training as far as that serves the goal, and record what each point loses."""
        while len(self._path.points[-1]) > 1:
            point = self._prune_to(len(self._path.points))
            trial = self._measure(point.splats)
            self._pruned.append(trial)
            useful = self._photographs or self.goal.by_size or self.goal.margin(trial) >= self.goal.decisive(trial).half
            enough = self._photographs and point.number == PRUNABLE_POINTS
            if enough or not useful or not (trial.drop or 0.0) <= PRUNABLE_DROP:  # a drop may be NaN
                break

    def _prune_to(self, number: int) -> PathPoint:
        """Prune without training up to a point of the path."""
        path = self._path
        while len(path.points) <= number:
            path.prune(count_at(len(path.points), len(self.compactor.splats)))
        return path.points[-1]

    def _encode_last_pruned(self, serves: Callable[[Trial], bool]) -> None:
        """Search for the lambda at the last point that ``serves`` the goal."""
        numbers = [number for number, trial in enumerate(self._pruned, 1) if serves(trial)]
        if numbers:
            self._encode(self._path.compacted(self._path.points[numbers[-1]], refine=False))

    def _encode_by_size(self) -> None:
        """Search for the lambda at the point that the size suggests, or at a later one if its containers are larger."""
        for attempt in range(self.compactor.settings.max_compactions):
            compacted = self._path.compacted(self._scenes.point(self._number_for_size + 2 * attempt), refine=True)
            self._measure(compacted.splats)
            if self._encode(compacted).best is not None:
                return

    def _search_along_path(self) -> None:
        """Make containers of points of the path; see :func:`search_positions`."""
        search_positions(
            self.goal,
            self._encode_position,
            self._first_number,
            (1, last_number(len(self.compactor.splats))),
            POINTS_PER_HALVING,
            self._plan.containers,
            NEAR_HALVINGS if self.time is None else NEAR_IN_TIME,
        )
        if self.goal.by_size and self._candidates.best is None:  # lambda alone makes this scene small enough
            self._encode(self._path.compacted(self._path.points[-1], refine=False))

    def _encode_position(self, position: Position) -> RateControl:
        """Make the container of a position of the path; return the search of that number of Gaussians."""
        number, progress = position.number, self.encoding.progress
        last = f"; last: {self.trials[-1].summary()}" if self.trials else ""
        progress.note = f"{count_at(number, len(self.compactor.splats)):,} Gaussians{last}"
        self._scenes.containers = max(self._plan.containers - len(self.trials), 1)
        trained = self._scenes.scene(number, self._candidates.best_bytes)
        before = len(trained.search.trials)
        try:
            trained.search.make(trained.encoder, None if position.log2_lambda is None else 2.0**position.log2_lambda)
        finally:
            self.trials += trained.search.trials[before:]
        trained.search.stopped |= self.time is not None and self.time.over
        self._candidates.keep(trained.search, trained.compacted)
        self._stopped |= trained.search.stopped
        return trained.search

    def _encode(self, compacted: Compacted) -> RateControl:
        """Search for the lambda of a scene without fine-tuning."""
        search = self._encoding_of(compacted).search(byte_limit=self._candidates.best_bytes)
        self.trials += search.trials
        self._candidates.keep(search, compacted)
        self._stopped |= search.stopped
        return search

    def _encoding_of(self, compacted: Compacted) -> Encoding:
        cache = self.encoding.cache if compacted.splats is self.encoding.splats else None
        return replace(self.encoding, splats=compacted.splats, cache=cache)

    def _measure(self, splats: Splats) -> Trial:
        """Return the figures of a scene that is not encoded, and record them for the report."""
        evaluation = self.compactor.evaluate(splats)
        trial = self.goal.measured(Trial(len(splats), None, 0), evaluation)
        ssim_decides = self.goal.decisive(trial).setting == "max_ssim_drop"
        self._tried.append(CountTrial(len(splats), drop_of(evaluation), trial.ssim_drop, ssim_decides))
        return trial

    def _latest_point(self) -> PathPoint:
        """Return the last point if it is trained, else the last one that loses less than the goal allows."""
        points = self._path.points
        if points[-1].trained or self.goal.by_size:
            return points[-1]
        met = [number for number, trial in enumerate(self._pruned, 1) if self.goal.margin(trial) >= 0]
        return points[max(met, default=0)]

    def _reason_to_keep_all(self) -> str:
        if self._tried or any(trial.count < len(self.compactor.splats) for trial in self.trials):
            return "and no smaller number of Gaussians that was tried serves the goal better"
        if self._stopped:
            return "and the search was stopped before a smaller number was tried"
        return "and all of them fit into the target size"
