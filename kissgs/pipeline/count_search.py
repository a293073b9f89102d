"""Search for the number of Gaussians and the lambda that serve a goal best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.errors import StopSearch
from kissgs.core.progress import Progress, SearchNote, as_stage, ignore_stop_search
from kissgs.evaluation.results import psnr_of
from kissgs.pipeline.goal import HALF_ERROR_DB, Trial
from kissgs.pipeline.path_containers import RENDERED_POINTS, PathContainers, is_prunable
from kissgs.pipeline.rate_control import RateControl
from kissgs.pipeline.search_time import RECOVERABLE_DB, SearchTime
from kissgs.pipeline.trained_search import KEEP, OVERHEAD_BYTES

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.popspa import PathPoint
    from kissgs.compaction.result import Compacted
    from kissgs.pipeline.encoding import Encoding


# ``search_without_photographs``: fewer Gaussians where no photographs can train them.

SIZE_BY_COUNT = 0.6
"""Exponent of the number of Gaussians to which the size of a container grows at equal lambda, with fewer by pruning."""


def search_without_photographs(containers: PathContainers, whole: RateControl) -> None:
    """Encode fewer Gaussians, trained or not, after ``whole``, the search for all of them, if they may serve better.

    Raises:
        StopSearch: the search was stopped.
    """
    goal = containers.goal
    if whole.stopped or (goal.by_size and whole.trials[0].bytes <= containers.target_size):
        return
    if containers.trains:
        _search_on_renderings(containers, whole)
    else:
        _search_without_training(containers, whole)


def _search_on_renderings(containers: PathContainers, whole: RateControl) -> None:
    """Train as many Gaussians as pruning alone nearly serves, or for a size that all of them miss, as many as fit.

    A scene whose Gaussians are all needed keeps them.
    """
    goal, pruning = containers.goal, containers.pruning
    best, trains = containers.candidates.best, bool(containers.plan.containers)
    if best is None and goal.by_size and containers.target_size > whole.overhead:
        if trains and not containers.late:
            containers.search_along_path(containers.number_for_size)
        else:
            point = pruning.prune_to(max(containers.number_for_size, 1))
            containers.encode(containers.path.compacted(point, refine=False))
    if best is None or whole.best is None or not trains or containers.late:
        return
    most = min(RENDERED_POINTS, containers.number_for_size if goal.by_size else RENDERED_POINTS)

    def serves(trial: Trial) -> bool:
        return (trial.drop or 0.0) <= best.cost if goal.by_size else goal.margin(trial) >= 0

    pruning.prune_while(lambda trial: serves(trial) and not containers.late, most)
    number, rd_lambda = pruning.last(serves), whole.best.encoded.rd_lambda
    if number and rd_lambda is not None and not containers.late:
        if goal.by_size:
            rd_lambda = _lambda_for_size(whole.trials, containers.target_size, number)
        containers.search_lambda(number, rd_lambda)


def _lambda_for_size(trials: Sequence[Trial], target_size: int, number: int) -> float:
    """Return the lambda at which a point should have the target size, by containers of all Gaussians."""
    wanted = target_size / KEEP ** (SIZE_BY_COUNT * number)
    made = sorted((trial.bytes, trial.rd_lambda) for trial in trials if trial.rd_lambda is not None)
    sizes, lambdas = np.log2([size for size, _ in made]), np.log2([rd_lambda for _, rd_lambda in made])
    return float(2.0 ** np.interp(math.log2(wanted), sizes, lambdas))


def _search_without_training(containers: PathContainers, whole: RateControl) -> None:
    """Encode those that leave half of the error to the encoder, or as many as fit the size."""
    goal, pruning, number = containers.goal, containers.pruning, 0
    if goal.by_size and containers.target_size > whole.overhead:
        pruning.prune_while(is_prunable, containers.count)
        if whole.best is None or containers.number_for_size > len(pruning.losses):
            containers.encode_by_size()
        else:
            psnr = psnr_of(whole.evaluate(whole.best.encoded)) + HALF_ERROR_DB
            number = pruning.last(lambda trial: (trial.psnr or 0.0) >= psnr)
    elif not goal.by_size and whole.best is not None:
        pruning.prune_while(lambda trial: goal.leaves_half(trial) and is_prunable(trial), containers.count)
        number = pruning.last(goal.leaves_half)
    if number:
        containers.encode(containers.path.compacted(containers.path.points[number], refine=False))


PRUNABLE_POINTS = 3
"""Number of the last point that is pruned without training where there are photographs: half of the Gaussians."""

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
        time: the time of the search; None for no limit. It limits training, and everything where the goal is an aim.
        aims: whether the goal is no more than an aim: if no container meets it in time, the closest one is kept.
    """

    encoding: Encoding
    compactor: Compactor
    time: SearchTime | None = None
    aims: bool = False
    _containers: PathContainers = field(init=False)
    _whole: RateControl | None = field(init=False, default=None)
    _unrecovered: bool = field(init=False, default=False)

    def __post_init__(self) -> None:
        self._containers = PathContainers(self.encoding, self.compactor, self.time, self.aims)

    def run(self) -> tuple[Compacted, RateControl | None, tuple[Trial, ...]]:
        """Return the scene that serves the goal best, the search that made its container, and all trials.

        If no smaller number of Gaussians serves the goal, the search is that for all of them, None if there was none.

        Raises:
            StopSearch: the search was stopped before any container met the goal.
        """
        from kissgs.compaction.budget import unchanged

        containers, candidates = self._containers, self._containers.candidates
        try:
            self._search()
        except StopSearch:
            containers.stopped = True
            if candidates.best is None and not (self.aims and candidates.any_missed):
                with suppress(StopSearch):  # raised where the time of an aim is over
                    self._encode_latest()
            if candidates.best is None and not self.aims:
                raise
        if candidates.best is None and self.aims:
            candidates.keep_closest()
        best, compacted = candidates.best, unchanged(self.compactor.splats, self._reason_to_keep_all())
        trained = False
        if best is not None:
            best.search.stopped |= containers.stopped
            compacted = compacted if best.compacted.splats is self.compactor.splats else best.compacted
            trained = compacted.report.target_source == "photos" or best.search.finetuned
            trained &= compacted is best.compacted and containers.photographs
        notes = filter(None, [compacted.report.note, BEYOND_PHOTOGRAPHS if trained else "", self._note_of_estimates()])
        report = replace(compacted.report, trials=tuple(containers.pruning.tried), note="; ".join(notes))
        return replace(compacted, report=report), self._whole if best is None else best.search, tuple(containers.trials)

    def _search(self) -> None:
        if self._containers.photographs:
            self._search_with_photographs()
        else:
            self._whole = self._containers.encode_all()
            search_without_photographs(self._containers, self._whole)

    def _search_with_photographs(self) -> None:
        containers, goal = self._containers, self._containers.goal
        if goal.by_size and (containers.target_size <= OVERHEAD_BYTES or containers.number_for_size == 0):
            return
        if containers.time is None:
            containers.pruning.prune_while(is_prunable, PRUNABLE_POINTS)
        else:  # what each point loses is not worth the time to measure it
            containers.pruning.prune_to(min(containers.first - 1, PRUNABLE_POINTS))
        if containers.time is None or self._recovers() or self._encode_all_before_training(containers.time):
            containers.search_along_path(containers.first)

    def _encode_all_before_training(self, time: SearchTime) -> bool:
        """Encode all Gaussians, and return whether there is time for several trained containers after that."""
        self._unrecovered = True
        whole = self._whole = self._containers.encode_all_in_time(time)
        plan, left = self._containers.plan, time.plan(photographs=True, aims=self.aims).containers
        self._containers.plan = replace(plan, containers=min(plan.containers, left))
        several = self._containers.plan.containers > 1 and not whole.stopped
        whole.stopped |= whole.best is not None or self.aims  # to fine-tune all Gaussians takes longer still
        return several

    def _recovers(self) -> bool:
        """Train up to the first point, and return whether fine-tuning can be expected to recover what is still lost.

        The larger and the more detailed a scene is, the less is recovered in a time.
        """
        allowed = self.encoding.settings.encode.max_psnr_drop
        if allowed is None:  # PSNR does not tell what becomes of other goals
            return True
        return (self._containers.train_to_first().drop or 0.0) <= RECOVERABLE_DB + allowed

    def _encode_latest(self) -> None:
        """Encode the latest point of the path that can meet the goal, where the search was stopped before that."""
        self.encoding.progress.note = ""
        containers, progress = self._containers, ignore_stop_search(self.encoding.progress)
        containers.encoding = replace(containers.encoding, progress=SearchNote(progress))
        for point in self._latest_points(progress):
            all_missed = self._whole is not None or (self._unrecovered and containers.trials)
            if containers.candidates.best is not None or (point.number == 0 and all_missed):
                return
            if point is containers.path.whole and containers.time is not None:
                containers.encode_all_in_time(containers.time)
            else:
                containers.encode(containers.path.compacted(point, refine=False))

    def _latest_points(self, progress: Progress) -> list[PathPoint]:
        """Return points that can meet the goal without further training, the most promising first.

        The last point serves a size. For a quality, it is left out if it is trained and leaves less than half of the
        error to the encoder, as most do that are still to be fine-tuned; then comes the last of those that are only
        pruned and leave half.
        """
        path, goal = self._containers.path, self._containers.goal
        points = path.points
        if self._unrecovered:
            return [path.whole]
        if goal.by_size:
            return [points[-1]]
        lost = dict(enumerate(self._containers.pruning.losses, 1))
        pruned = [points[n] for n, trial in lost.items() if goal.leaves_half(trial) and not points[n].trained]
        found = [pruned[-1] if pruned else path.whole]
        if points[-1].trained:
            evaluation = self.compactor.compare(points[-1].splats, as_stage("evaluate", progress))
            trial = goal.measured(Trial(len(points[-1]), None, 0), evaluation)
            found = [points[-1], *found] if goal.leaves_half(trial) else found
        return found

    def _note_of_estimates(self) -> str:
        """Return the note that losses are estimates, unless the search for lambda gives it."""
        noted = self.encoding.settings.encode.max_psnr_drop is not None or not self._containers.pruning.tried
        return "" if noted else self.compactor.note

    def _reason_to_keep_all(self) -> str:
        containers = self._containers
        first = self._whole.trials[0] if self._whole is not None else None
        fewer = any(trial.count < containers.count for trial in containers.trials)
        if self._unrecovered and not fewer:
            return "and training a smaller number did not recover in this time what it loses"
        if containers.pruning.tried or fewer:
            return "and no smaller number of Gaussians that was tried serves the goal better"
        if containers.goal.by_size and (first is None or first.bytes <= containers.target_size):
            return "and all of them fit into the target size"
        if containers.late or not containers.plan.containers:
            return "and there was too little time to train a smaller number"
        if containers.stopped:
            return "and the search was stopped before a smaller number was tried"
        return "and a smaller number would serve the goal less"
