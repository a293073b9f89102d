"""``PathContainers``: makes containers of the points of a training path, and keeps the best."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.core.errors import StopSearch
from kissgs.pipeline.candidates import Candidates
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.path_points import POINTS_PER_HALVING, count_at, last_number, number_for_size
from kissgs.pipeline.pruning import Pruning
from kissgs.pipeline.rate_control import Container, RateControl
from kissgs.pipeline.search_time import SearchPlan, SearchTime
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
    from kissgs.compaction.training_path import TrainingPath
    from kissgs.pipeline.encoding import Encoding

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
