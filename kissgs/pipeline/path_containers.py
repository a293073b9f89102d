"""``PathContainers``: makes containers of the points of a training path, pruned or trained, and keeps the best."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.compaction.result import CountTrial
from kissgs.core.errors import StopSearch
from kissgs.core.splats import Splats
from kissgs.evaluation.results import drop_of
from kissgs.pipeline.goal import Goal, Trial
from kissgs.pipeline.rate_control import Container, RateControl
from kissgs.pipeline.search_time import SearchPlan, SearchTime
from kissgs.pipeline.trained_search import (
    NEAR_HALVINGS,
    NEAR_IN_TIME,
    POINTS_PER_HALVING,
    Position,
    TrainedScene,
    TrainedScenes,
    count_at,
    first_position,
    last_number,
    number_for_size,
    search_positions,
)
from kissgs.pipeline.training_choice import has_photographs
from kissgs.settings import EncodeSettings
from kissgs.sogxt.container import stored_sizes

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.popspa import PathPoint, TrainingPath
    from kissgs.compaction.result import Compacted
    from kissgs.pipeline.encoding import Encoding


# ``Candidates``: the best container of searches at several numbers of Gaussians.

UNKNOWN_DROP = 1e6
"""Larger than any finite drop of PSNR, decibels."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A number of Gaussians with containers that meet the goal.

    Attributes:
        cost: of the best container, to be minimised: its loss where the goal is a size, else bytes.
        search: the search that made the containers.
        compacted: the scene that they hold.
    """

    cost: float
    search: RateControl
    compacted: Compacted


@dataclass(slots=True, eq=False)
class Candidates:
    """Keeps the best container of several searches.

    Attributes:
        goal: the goal of all searches.
        packed: whether the files become a zip, whose size then counts; False for a folder.
        best: the best so far; None if no container meets the goal.
    """

    goal: Goal
    packed: bool
    best: Candidate | None = None
    _missed: list[tuple[RateControl, Compacted]] = field(init=False, default_factory=list)

    @property
    def best_bytes(self) -> float:
        """Bytes of the best container so far; infinite where bytes are not the cost."""
        return math.inf if self.best is None or self.goal.by_size else self.best.cost

    @property
    def any_missed(self) -> bool:
        """Whether there is a container that misses the goal."""
        return any(search.closest is not None for search, _ in self._missed)

    def keep(self, search: RateControl, compacted: Compacted) -> None:
        """Keep the best container of a search if it is better than that of all others."""
        if search.best is None:
            self._missed.append((search, compacted))
            return
        cost = float(stored_sizes(search.best.encoded.files, packed=self.packed)[0])
        if self.goal.by_size:
            cost = self._loss(search, search.best)
        if self.best is None or cost < self.best.cost:
            self.best = Candidate(cost, search, compacted)

    def keep_closest(self) -> None:
        """Keep the container that misses the goal least."""
        made = [(search, compacted) for search, compacted in self._missed if search.closest is not None]
        if made:
            search, compacted = max(made, key=lambda each: max(map(self.goal.margin, each[0].trials)))
            search.best, search.stopped = search.closest, True  # a fine-tuned one would not replace it
            self.keep(search, compacted)

    def _loss(self, search: RateControl, container: Container) -> float:
        """Return the drop of PSNR of a container, decibels; infinite if a rendering failed.

        If the photographs equal the scene's renderings, every drop is infinite. It is then a large number minus PSNR.
        """
        try:
            evaluation = search.evaluate(container.encoded)
        except StopSearch:  # the container exists, so it is evaluated before the search ends
            search.stopped = True
            evaluation = search.evaluate(container.encoded)
        drop, psnr = drop_of(evaluation), evaluation.mean.candidate.psnr
        if math.isnan(drop) or math.isnan(psnr):
            return math.inf
        return drop if math.isfinite(drop) else UNKNOWN_DROP - min(psnr, 1e3)


# ``Pruning``: points of a training path that are pruned without training, and what each of them loses.

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


# ``PathContainers``: makes containers of the points of a training path, and keeps the best.

ENCODES = 6
"""Largest number of containers of the encoder alone where others are trained."""

RENDERED_POINTS = 5
"""Number of the last point that is pruned without training where renderings of the scene are the targets, from which
training along the path departs."""


@dataclass(slots=True, eq=False)
class PathContainers:
    """Makes containers of the points of a training path, trained or not, and keeps the one that serves the goal best.

    Attributes:
        encoding: encoding of the whole scene.
        compactor: compactor of the same scene.
        time: the time of the search; None for no limit. It limits training, and everything where the goal is an aim.
        aims: whether the goal is no more than an aim: if no container meets it in time, the closest one is kept.
        trials: all containers that were made, in order.
        stopped: whether a search has ended before its end.
        plan: number of containers, and the first of them.
        first: number of the point of the first trained container.
        path: the training path.
        pruning: its points that are pruned without training.
        candidates: the best container so far.
    """

    encoding: Encoding
    compactor: Compactor
    time: SearchTime | None
    aims: bool
    trials: list[Trial] = field(init=False, default_factory=list)
    stopped: bool = field(init=False, default=False)
    plan: SearchPlan = field(init=False)
    first: int = field(init=False)
    path: TrainingPath = field(init=False)
    pruning: Pruning = field(init=False)
    candidates: Candidates = field(init=False)
    _scenes: TrainedScenes = field(init=False)

    def __post_init__(self) -> None:
        most, photographs = self.compactor.settings.max_compactions, self.photographs
        if not self.trains:
            self.time = None
        self.encoding = replace(self.encoding, compare=self.compactor.compare)
        plan = SearchPlan(most) if self.time is None else self.time.plan(photographs=photographs, aims=self.aims)
        self.plan = replace(plan, containers=min(plan.containers, most))
        first, offset_db = first_position(self.goal, self.plan, self.count, self.number_for_size, POINTS_PER_HALVING)
        self.first = min(first, last_number(self.count))
        if self.time is not None and photographs:
            most_views = self.time.scoring_views(max(self.first, 1))
            self.compactor = replace(self.compactor, supervision=self.compactor.supervision.with_scoring(most_views))
        self.path = self.compactor.path(keep_states=not self.tunes)
        self.pruning = Pruning(self.goal, self.compactor, self.path)
        self.candidates = Candidates(self.goal, self.encoding.packed)
        self._scenes = TrainedScenes(
            encoding=self.encoding,
            compactor=self.compactor,
            path=self.path,
            pruned_only=RENDERED_POINTS if self.trains and not photographs else 0,
            offset_db=offset_db if photographs else 0.0,
            time=self.time,
            containers=self.plan.containers,
        )

    @property
    def count(self) -> int:
        """Number of Gaussians of the whole scene."""
        return len(self.compactor.splats)

    @property
    def goal(self) -> Goal:
        """The goal that the settings name."""
        return Goal.of(self.encoding.settings.encode)

    @property
    def tunes(self) -> bool:
        """Whether the settings ask for fine-tuning."""
        return bool(self.encoding.settings.finetune.enabled)

    @property
    def photographs(self) -> bool:
        """Whether to train on photographs; never for a PSNR to the scene's own renderings, which then falls."""
        trains = self.compactor.settings.trains and self.goal.limits[0].setting != "psnr"
        return trains and has_photographs(self.encoding.views)

    @property
    def trains(self) -> bool:
        """Whether containers are trained, on renderings only through the decoder."""
        bare = self.encoding.views is None and self.goal.limits[0].setting != "psnr"
        return self.photographs or (bare and self.tunes)

    @property
    def target_size(self) -> int:
        """The size that is the goal, bytes; 0 if none is."""
        return self.encoding.settings.encode.target_size or 0

    @property
    def number_for_size(self) -> int:
        """Number of the point whose container is expected to have that size."""
        return number_for_size(self.compactor.splats, self.target_size)

    @property
    def late(self) -> bool:
        """Whether no time is left for another container."""
        return self.time is not None and self.time.over

    def train_to_first(self) -> Trial:
        """Train up to the first point, and return what it loses before it is fine-tuned and encoded."""
        self._scenes.containers = self.plan.containers
        return self.pruning.measure(self._scenes.point(self.first).splats)

    def encode(self, compacted: Compacted) -> RateControl:
        """Search for the lambda of a scene without fine-tuning."""
        search = self._encoding_of(compacted).search(byte_limit=self.candidates.best_bytes)
        self._keep(search, compacted)
        return search

    def encode_all(self) -> RateControl:
        """Search for the lambda of all Gaussians without fine-tuning."""
        return self.encode(self.path.compacted(self.path.whole, refine=False))

    def encode_all_in_time(self, time: SearchTime) -> RateControl:
        """Search for the lambda of all Gaussians without fine-tuning; for an aim, only as long as there is time."""
        compacted = self.path.compacted(self.path.whole, refine=False)
        encoding = self._encoding_of(compacted)
        search, encoder = encoding.rate_control(), encoding.encoder(None)

        def encoder_in_time(settings: EncodeSettings) -> Container:
            if self.aims and search.trials and time.over_for_encoding:
                raise StopSearch
            return encoder(settings)

        try:
            search.search_all(encoder_in_time)
        finally:
            self._keep(search, compacted)
        return search

    def encode_by_size(self) -> None:
        """Search for the lambda at the point that the size suggests, or at a later one if its containers are larger."""
        for attempt in range(self.compactor.settings.max_compactions):
            compacted = self.path.compacted(self._scenes.point(self.number_for_size + 2 * attempt), refine=True)
            self.pruning.measure(compacted.splats)
            if self.encode(compacted).best is not None:
                return

    def search_lambda(self, number: int, rd_lambda: float) -> None:
        """Make trained containers of one point of the path, the first one at ``rd_lambda``."""
        trained = self._trained_scene(number, 0)
        search = trained.search

        def encoder(settings: EncodeSettings) -> Container:
            if self.late:
                raise StopSearch
            return self._trained_scene(number, len(search.trials)).encoder(settings)

        try:
            search.run(encoder, rd_lambda, self.plan.containers)
        finally:
            self.trials += search.trials
        self.candidates.keep(search, trained.compacted)
        self.stopped |= search.stopped

    def search_along_path(self, first: int) -> None:
        """Make containers of points of the path, the first one at point ``first``; see :func:`search_positions`."""
        search_positions(
            self.goal,
            self._encode_position,
            first,
            (1, last_number(self.count)),
            POINTS_PER_HALVING,
            self.plan.containers,
            NEAR_HALVINGS if self.time is None else NEAR_IN_TIME,
        )
        points = self.path.points
        if (
            self.goal.by_size and self.candidates.best is None and len(points) > 1
        ):  # lambda alone makes this scene small enough
            self.encode(self.path.compacted(points[-1], refine=False))

    def _encode_position(self, position: Position) -> RateControl:
        """Make the container of a position of the path; return the search of that number of Gaussians."""
        number, progress = position.number, self.encoding.progress
        last = f"; last: {self.trials[-1].summary()}" if self.trials else ""
        progress.note = f"{count_at(number, self.count):,} Gaussians{last}"
        trained = self._trained_scene(number, sum(trial.count < self.count for trial in self.trials))
        before = len(trained.search.trials)
        try:
            trained.search.make(trained.encoder, None if position.log2_lambda is None else 2.0**position.log2_lambda)
        finally:
            self.trials += trained.search.trials[before:]
        trained.search.stopped |= self.late
        self.candidates.keep(trained.search, trained.compacted)
        self.stopped |= trained.search.stopped
        return trained.search

    def _trained_scene(self, number: int, made: int) -> TrainedScene:
        """Return the scene at a point of the path, ready for the next container after so many trained ones."""
        self._scenes.containers = max(self.plan.containers - made, 1)
        return self._scenes.scene(number, self.candidates.best_bytes)

    def _keep(self, search: RateControl, compacted: Compacted) -> None:
        """Record the trials of a search, and its best container."""
        self.trials += search.trials
        self.candidates.keep(search, compacted)
        self.stopped |= search.stopped

    def _encoding_of(self, compacted: Compacted) -> Encoding:
        cache = self.encoding.cache if compacted.splats is self.encoding.splats else None
        encoding = replace(self.encoding, splats=compacted.splats, cache=cache)
        if self.photographs or not self.trains or self.plan.containers == 0:
            return encoding
        return encoding.with_encode_settings(max_encodes=min(ENCODES, encoding.settings.encode.max_encodes))
