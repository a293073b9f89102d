"""Search for the number of Gaussians and the lambda that serve a goal best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.errors import StopSearch
from kissgs.core.progress import SearchNote, ignore_stop_search
from kissgs.evaluation.psnr_loss import psnr_of
from kissgs.pipeline.candidates import Candidates
from kissgs.pipeline.goal import HALF_ERROR_DB, Goal
from kissgs.pipeline.path_points import KEEP, OVERHEAD_BYTES, POINTS_PER_HALVING, count_at, last_number, number_for_size
from kissgs.pipeline.pruning import Pruning
from kissgs.pipeline.rate_control import Container, RateControl
from kissgs.pipeline.search_time import RECOVERABLE_DB, SearchPlan, SearchTime
from kissgs.pipeline.trained_scenes import TrainedScene, TrainedScenes
from kissgs.pipeline.trained_search import (
    NEAR_HALVINGS,
    NEAR_IN_TIME,
    Position,
    first_position,
    search_positions,
)
from kissgs.pipeline.training_choice import has_photographs
from kissgs.pipeline.trial import Trial
from kissgs.settings import EncodeSettings

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.compaction.training_path import PathPoint, TrainingPath
    from kissgs.pipeline.encoding import Encoding

ENCODES = 6
"""Largest number of containers of the encoder alone where others are trained."""

SIZE_BY_COUNT = 0.6
"""Exponent of the number of Gaussians to which the size of a container grows at equal lambda, with fewer by pruning."""

PRUNABLE_DROP = 1.0
"""Drop of PSNR, decibels, up to which pruning goes on without training."""

PRUNABLE_POINTS = 3
"""Number of the last point that is pruned without training where there are photographs: half of the Gaussians."""

RENDERED_POINTS = 5
"""Number of that point where renderings of the scene are the targets, from which training along the path departs."""

BEYOND_PHOTOGRAPHS = (
    "trained for what the photographs show: beyond them it changes more (--evaluate measures how much; --compact 100% "
    "--finetune 0 keeps it)"
)


@dataclass(slots=True, eq=False)
class CountSearch:
    """Prune and train a scene along a path, and make containers at the points that promise most.

    Training on photographs starts where pruning alone begins to show, on renderings of the scene itself much later.
    With fine-tuning, a point of the path is encoded as it is, and the training is completed through the decoder.

    Attributes:
        encoding: encoding of the whole scene.
        compactor: compactor of the same scene.
        time: the time of the search; None for no limit. It limits training only.
        aims: whether the goal is no more than an aim: if no container meets it in time, the closest one is kept.
        trials: all containers that were made, in order.
    """

    encoding: Encoding
    compactor: Compactor
    time: SearchTime | None = None
    aims: bool = False
    trials: list[Trial] = field(default_factory=list)
    _path: TrainingPath = field(init=False)
    _pruning: Pruning = field(init=False)
    _candidates: Candidates = field(init=False)
    _scenes: TrainedScenes = field(init=False)
    _whole: RateControl | None = field(init=False, default=None)
    _stopped: bool = field(init=False, default=False)
    _too_short: bool = field(init=False, default=False)
    _plan: SearchPlan = field(init=False)
    _first: int = field(init=False)

    def __post_init__(self) -> None:
        most, photographs = self.compactor.settings.max_compactions, self._photographs
        if not self._trains:
            self.time = None
        if self.encoding.views is None:
            self.encoding = replace(self.encoding, compare=self.compactor.compare)
        plan = SearchPlan(most) if self.time is None else self.time.plan(photographs=photographs, aims=self.aims)
        self._plan = replace(plan, containers=min(plan.containers, most))
        self._first, offset_db = first_position(
            self.goal, self._plan, len(self.compactor.splats), self._number_for_size, POINTS_PER_HALVING
        )
        if self.time is not None and photographs:
            most_views = self.time.scoring_views(max(self._first, 1))
            self.compactor = replace(self.compactor, supervision=self.compactor.supervision.with_scoring(most_views))
        self._path = self.compactor.path(keep_states=not self._tunes)
        self._pruning = Pruning(self.goal, self.compactor, self._path)
        self._candidates = Candidates(self.goal, self.encoding.packed)
        self._scenes = TrainedScenes(
            encoding=self.encoding,
            compactor=self.compactor,
            path=self._path,
            pruned_only=RENDERED_POINTS if self._trains and not photographs else 0,
            offset_db=offset_db if photographs else 0.0,
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
                point = self._latest_point()
                if point.number or self._whole is None:  # else all Gaussians have missed the goal already
                    progress = SearchNote(ignore_stop_search(self.encoding.progress))
                    self.encoding = replace(self.encoding, progress=progress)
                    self._encode(self._path.compacted(point, refine=False))
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
        report = replace(compacted.report, trials=tuple(self._pruning.tried), note="; ".join(notes))
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
    def _trains(self) -> bool:
        """Whether containers are trained, on renderings only through the decoder."""
        bare = self.encoding.views is None and self.goal.limits[0].setting != "psnr"
        return self._photographs or (bare and self._tunes)

    @property
    def _target_size(self) -> int:
        return self.encoding.settings.encode.target_size or 0

    @property
    def _number_for_size(self) -> int:
        return number_for_size(self.compactor.splats, self._target_size)

    def _search(self) -> None:
        if not self._photographs:
            self._search_without_photographs()
        elif not self.goal.by_size or (self._target_size > OVERHEAD_BYTES and self._number_for_size > 0):
            if self.time is None:
                self._pruning.prune_while(_is_prunable, PRUNABLE_POINTS)
            else:  # what each point loses is not worth the time to measure it
                self._pruning.prune_to(min(self._first - 1, PRUNABLE_POINTS))
                self._too_short = not self.goal.by_size and not self._recovers()
            if self._too_short:
                self._encode_all_in_time()
            if not self._too_short or self._time_for_several:
                self._search_along_path(self._first)

    def _recovers(self) -> bool:
        """Train up to the first point, and return whether fine-tuning can be expected to recover what is still lost.

        The larger and the more detailed a scene is, the less is recovered in a time.
        """
        self._scenes.containers = self._plan.containers
        drop = self._pruning.measure(self._scenes.point(self._first).splats).drop or 0.0
        return drop <= RECOVERABLE_DB + (self.encoding.settings.encode.max_psnr_drop or 0.0)

    def _encode_all_in_time(self) -> None:
        """Search for the lambda of all Gaussians without training; for an aim, as long as there is time."""
        compacted = self._path.compacted(self._path.points[0], refine=False)
        encoding = self._encoding_of(compacted)
        search, encoder = encoding.rate_control(), encoding.encoder(None)

        def encoder_in_time(settings: EncodeSettings) -> Container:
            if self.aims and search.trials and self.time is not None and self.time.over_for_encoding:
                raise StopSearch
            return encoder(settings)

        try:
            search.run(encoder_in_time)
        finally:
            self.trials += search.trials
            search.stopped |= self.aims and self.time is not None and self.time.over_for_encoding
            self._candidates.keep(search, compacted)

    def _search_without_photographs(self) -> None:
        """Encode all Gaussians, then fewer, trained or not, which may serve the goal better."""
        search = self._whole = self._encode(self._path.compacted(self._path.points[0], refine=False))
        if search.stopped or (self.goal.by_size and search.trials[0].bytes <= self._target_size):
            return
        if self._trains:
            self._search_on_renderings(search)
        else:
            self._search_without_training(search)

    def _search_on_renderings(self, whole: RateControl) -> None:
        """Train as many Gaussians as pruning alone nearly serves, or for a size that all of them miss, as many as fit.

        A scene whose Gaussians are all needed keeps them.
        """
        by_size, best = self.goal.by_size, self._candidates.best
        if best is None and by_size and self._target_size > whole.overhead:
            if self._plan.containers and not self._late:
                self._search_along_path(self._number_for_size)
            else:
                point = self._pruning.prune_to(max(self._number_for_size, 1))
                self._encode(self._path.compacted(point, refine=False))
        if best is None or whole.best is None or not self._plan.containers or self._late:
            return
        most = min(RENDERED_POINTS, self._number_for_size if by_size else RENDERED_POINTS)

        def serves(trial: Trial) -> bool:
            return (trial.drop or 0.0) <= best.cost if by_size else self.goal.margin(trial) >= 0

        self._pruning.prune_while(lambda trial: serves(trial) and not self._late, most)
        number, rd_lambda = self._pruning.last(serves), whole.best.encoded.rd_lambda
        if number and rd_lambda is not None and not self._late:
            self._search_lambda(number, self._lambda_for_size(whole.trials, number) if by_size else rd_lambda)

    def _lambda_for_size(self, trials: Sequence[Trial], number: int) -> float:
        """Return the lambda at which a point should have the target size, by containers of all Gaussians."""
        wanted = self._target_size / KEEP ** (SIZE_BY_COUNT * number)
        made = sorted((trial.bytes, trial.rd_lambda) for trial in trials if trial.rd_lambda is not None)
        sizes, lambdas = np.log2([size for size, _ in made]), np.log2([rd_lambda for _, rd_lambda in made])
        return float(2.0 ** np.interp(math.log2(wanted), sizes, lambdas))

    def _search_without_training(self, whole: RateControl) -> None:
        """Encode those that leave half of the error to the encoder, or as many as fit the size."""
        pruning, number = self._pruning, 0
        if self.goal.by_size and self._target_size > whole.overhead:
            pruning.prune_while(_is_prunable, len(self.compactor.splats))
            if whole.best is None or self._number_for_size > len(pruning.losses):
                self._encode_by_size()
            else:
                psnr = psnr_of(whole.evaluate(whole.best.encoded)) + HALF_ERROR_DB
                number = pruning.last(lambda trial: (trial.psnr or 0.0) >= psnr)
        elif not self.goal.by_size and whole.best is not None:

            def leaves_half(trial: Trial) -> bool:
                return self.goal.margin(trial) >= self.goal.decisive(trial).half

            pruning.prune_while(lambda trial: leaves_half(trial) and _is_prunable(trial), len(self.compactor.splats))
            number = pruning.last(leaves_half)
        if number:
            self._encode(self._path.compacted(self._path.points[number], refine=False))

    def _search_lambda(self, number: int, rd_lambda: float) -> None:
        """Make trained containers of one point of the path, the first one at ``rd_lambda``."""
        trained = self._trained_scene(number, 0)
        search = trained.search

        def encoder(settings: EncodeSettings) -> Container:
            if self._late:
                raise StopSearch
            return self._trained_scene(number, len(search.trials)).encoder(settings)

        try:
            search.run(encoder, rd_lambda, self._plan.containers)
        finally:
            self.trials += search.trials
        self._candidates.keep(search, trained.compacted)
        self._stopped |= search.stopped

    @property
    def _time_for_several(self) -> bool:
        """Whether time is left for more than one trained container."""
        return self.time is not None and self.time.plan(photographs=True, aims=self.aims).containers > 1

    @property
    def _late(self) -> bool:
        """Whether no time is left for another container."""
        return self.time is not None and self.time.over

    def _encode_by_size(self) -> None:
        """Search for the lambda at the point that the size suggests, or at a later one if its containers are larger."""
        for attempt in range(self.compactor.settings.max_compactions):
            compacted = self._path.compacted(self._scenes.point(self._number_for_size + 2 * attempt), refine=True)
            self._pruning.measure(compacted.splats)
            if self._encode(compacted).best is not None:
                return

    def _search_along_path(self, first: int) -> None:
        """Make containers of points of the path, the first one at point ``first``; see :func:`search_positions`."""
        search_positions(
            self.goal,
            self._encode_position,
            first,
            (1, last_number(len(self.compactor.splats))),
            POINTS_PER_HALVING,
            self._plan.containers,
            NEAR_HALVINGS if self.time is None else NEAR_IN_TIME,
        )
        points = self._path.points
        if (
            self.goal.by_size and self._candidates.best is None and len(points) > 1
        ):  # lambda alone makes this scene small enough
            self._encode(self._path.compacted(points[-1], refine=False))

    def _encode_position(self, position: Position) -> RateControl:
        """Make the container of a position of the path; return the search of that number of Gaussians."""
        number, progress = position.number, self.encoding.progress
        last = f"; last: {self.trials[-1].summary()}" if self.trials else ""
        progress.note = f"{count_at(number, len(self.compactor.splats)):,} Gaussians{last}"
        trained = self._trained_scene(number, sum(trial.count < len(self.compactor.splats) for trial in self.trials))
        before = len(trained.search.trials)
        try:
            trained.search.make(trained.encoder, None if position.log2_lambda is None else 2.0**position.log2_lambda)
        finally:
            self.trials += trained.search.trials[before:]
        trained.search.stopped |= self._late
        self._candidates.keep(trained.search, trained.compacted)
        self._stopped |= trained.search.stopped
        return trained.search

    def _trained_scene(self, number: int, made: int) -> TrainedScene:
        """Return the scene at a point of the path, ready for the next container after so many trained ones."""
        self._scenes.containers = max(self._plan.containers - made, 1)
        return self._scenes.scene(number, self._candidates.best_bytes)

    def _encode(self, compacted: Compacted) -> RateControl:
        """Search for the lambda of a scene without fine-tuning."""
        search = self._encoding_of(compacted).search(byte_limit=self._candidates.best_bytes)
        self.trials += search.trials
        self._candidates.keep(search, compacted)
        self._stopped |= search.stopped
        return search

    def _encoding_of(self, compacted: Compacted) -> Encoding:
        cache = self.encoding.cache if compacted.splats is self.encoding.splats else None
        encoding = replace(self.encoding, splats=compacted.splats, cache=cache)
        if self._photographs or not self._trains or self._plan.containers == 0:
            return encoding
        return encoding.with_encode_settings(max_encodes=min(ENCODES, encoding.settings.encode.max_encodes))

    def _latest_point(self) -> PathPoint:
        """Return the last point if it is trained, else the last one that loses less than the goal allows."""
        points = self._path.points
        if points[-1].trained or self.goal.by_size:
            return points[-1]
        return points[self._pruning.last(lambda trial: self.goal.margin(trial) >= 0)]

    def _reason_to_keep_all(self) -> str:
        first = self._whole.trials[0] if self._whole is not None else None
        fewer = any(trial.count < len(self.compactor.splats) for trial in self.trials)
        if self._too_short and not fewer:
            return "and there was too little time to train a smaller number"
        if self._pruning.tried or fewer:
            return "and no smaller number of Gaussians that was tried serves the goal better"
        if self.goal.by_size and (first is None or first.bytes <= self._target_size):
            return "and all of them fit into the target size"
        if self._late or not self._plan.containers:
            return "and there was too little time to train a smaller number"
        if self._stopped:
            return "and the search was stopped before a smaller number was tried"
        return "and a smaller number would serve the goal less"


def _is_prunable(trial: Trial) -> bool:
    """Whether a point may be pruned further without training."""
    return (trial.drop or 0.0) <= PRUNABLE_DROP  # false where a rendering failed
