"""``TrainedScenes``: points of a training path, ready to be encoded."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.pipeline.encoding import FinetuneFactors
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.path_points import count_at
from kissgs.pipeline.rate_control import Encoder, RateControl
from kissgs.pipeline.search_time import SearchTime

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.compaction.training_path import PathPoint, TrainingPath
    from kissgs.finetuning.tune import Tuner
    from kissgs.pipeline.encoding import Encoding

COMPLETING = FinetuneFactors(steps=1.2, lr=2.5, codebook_lr=2.0)
"""Fine-tuning that completes the training of the path too.

A refinement of the scene before its encoding would take more steps for the same quality.
"""


@dataclass(frozen=True, slots=True)
class TrainedScene:
    """A scene of the path, and what makes containers of it.

    Attributes:
        compacted: the scene.
        search: the search for its lambda.
        encoder: encodes it, with fine-tuning if that is wanted.
    """

    compacted: Compacted
    search: RateControl
    encoder: Encoder


@dataclass(slots=True, eq=False)
class TrainedScenes:
    """Trains a scene along its path, and prepares the encoding of the points that are asked for.

    Attributes:
        encoding: encoding of the whole scene.
        compactor: compactor of the same scene.
        path: training path of the compactor.
        pruned_only: number of the last point that is pruned without training along the path.
        offset_db: added to ``quality_offset_db`` for the first container of a scene, decibels.
        time: the time that training shares with encoding; None for no limit.
        containers: number of containers that are still to be made in that time, this one included.
    """

    encoding: Encoding
    compactor: Compactor
    path: TrainingPath
    pruned_only: int
    offset_db: float
    time: SearchTime | None
    containers: int
    _tuner: Tuner | None = field(init=False, default=None)
    _scenes: dict[int, TrainedScene] = field(init=False, default_factory=dict)

    def scene(self, number: int, byte_limit: float) -> TrainedScene:
        """Return the scene at a point of the path, trained and ready for the next container.

        ``byte_limit`` is that of :class:`RateControl`.
        """
        if number not in self._scenes:
            self._scenes[number] = self._prepare(number, byte_limit)
        if self.time is not None and self._tuner is not None:
            self._tuner.deadline = self.time.for_container(self.containers).earlier(self._evaluation_seconds)
        return self._scenes[number]

    def point(self, number: int) -> PathPoint:
        """Prune and train up to a point of the path, and return it."""
        path = self.path
        while len(path.points) <= number:
            trains = len(path.points) > self.pruned_only
            if trains and not path.points[-1].trained:
                self._train(number)
            path.prune(count_at(len(path.points), len(self.compactor.splats)))
            if trains:
                self._train(number)
        return path.points[number]

    def _train(self, number: int) -> None:
        """Train the last point of the path, on the way to point ``number``."""
        deadline = None
        if self.time is not None:
            deadline = self.time.for_point(number + 2 - len(self.path.points), self.containers)
        self.path.train(deadline)

    def _prepare(self, number: int, byte_limit: float) -> TrainedScene:
        tunes = bool(self.encoding.settings.finetune.enabled)
        point, deadline = self.point(number), None
        if self.time is not None:
            deadline = self.time.for_container(self.containers)
            deadline = deadline.earlier(self.time.encode_seconds + self._evaluation_seconds)
        compacted = self.path.compacted(point, refine=not tunes, deadline=deadline)
        encoding = replace(self.encoding, splats=compacted.splats, cache=None)
        if tunes:  # training replaces the refit of colours
            encoding = encoding.with_encode_settings(color_refit_iterations=0)
            self._tuner = self._tuner or self._first_tuner(encoding)
        search = encoding.rate_control(offset_db=self.offset_db, byte_limit=byte_limit, trained=tunes)
        return TrainedScene(compacted, search, encoding.encoder(self._tuner))

    @property
    def _evaluation_seconds(self) -> float:
        """Expected time to evaluate a container, seconds: that of the latest evaluation; 0 where sizes are searched."""
        return 0.0 if Goal.of(self.encoding.settings.encode).by_size else self.compactor.compare.seconds

    def _first_tuner(self, encoding: Encoding) -> Tuner | None:
        prepared = (self.compactor.supervision, self.path.targets) if self.compactor.settings.trains else None
        tuner = encoding.tuner(COMPLETING, prepared)
        if tuner is not None and self.time is not None:
            seconds = self.compactor.compare.seconds if self.compactor.supervision.captured else 0.0
            tuner.ending_seconds = self.time.ending_seconds + seconds  # it evaluates in the same images of a capture
        elif tuner is not None:
            tuner.deadline = None  # several containers cannot share the one of the whole work
        return tuner
