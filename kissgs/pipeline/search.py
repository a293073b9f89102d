"""``Search``: makes containers with fewer Gaussians and other values of lambda, until one meets a goal closely."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from kissgs.compaction.budget import chosen_views, estimate_note, unchanged
from kissgs.compaction.popspa import PathPoint, Popspa, TrainingPath
from kissgs.compaction.result import Compacted, CountTrial
from kissgs.compaction.search_evaluation import SearchEvaluation
from kissgs.core.context import Context, JobProgress
from kissgs.core.errors import InvalidViewsError, StopSearch, UnsupportedError
from kissgs.core.splats import Splats
from kissgs.evaluation.results import ESTIMATED_DROP, Evaluation, drop_of
from kissgs.io.containers import stored_sizes
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline import curves
from kissgs.pipeline.curves import LambdaCurve, NoFurtherError, at_lambda, count_at, last_number
from kissgs.pipeline.encoding import Container, Measured, Work, encode, make_tuner, measure
from kissgs.pipeline.goal import Attempt, Goal
from kissgs.pipeline.limited_time import Expected, SearchPlan
from kissgs.pipeline.scene_files import read_scene
from kissgs.settings import EncodeSettings

if TYPE_CHECKING:
    from kissgs.finetuning.result import FinetuneReport
    from kissgs.finetuning.tune import Tuner

MAX_OFFSET_DB = 30.0  # largest value of the setting quality_offset_db
TUNED_CONTAINERS, ENCODES = 3, 6  # most containers fine-tuned, and of those before trained ones
# Factors on settings of fine-tuning that completes the training of the path too: a refinement would take more steps.
COMPLETING = {"steps": 1.2, "lr": 2.5, "codebook_lr": 2.0}
PRUNABLE_POINTS, PRUNABLE_DROP = 3, 1.0  # last one pruned without training; most decibels that others lose
RENDERED_POINTS = 5  # last point pruned without training on renderings, from which training departs
# Largest loss after a short training path, decibels beyond the allowed one, that fine-tuning is expected to recover
# (docs/method/research-log.md, "Large scenes in a limited time").
RECOVERABLE_DB = 1.5
# Expected of a trained container, before the first one is made: bytes per Gaussian, those of view-dependent colour in
# addition, and those that are no images.
BYTES_PER_GAUSSIAN, BYTES_OF_SH, OVERHEAD_BYTES = 8.6, 4.0, 3300
SIZE_BY_LAMBDA = 0.09  # exponent of 1 / lambda to which the size of a scene's container grows at least
SIZE_BY_COUNT = 0.6  # exponent of the number of Gaussians to which the size of a container grows at equal lambda
HALF_LEFT = 1.0  # margin of a point before any encoding that leaves half of the allowed loss to the encoder
# Margin that ends a search, as log2 of the number of Gaussians: 0.03 dB of PSNR; less in a time that is given.
NEAR_LOG2, NEAR_IN_TIME = 0.094, 0.06
UNKNOWN_DROP = 1e6  # larger than any finite drop of PSNR, decibels

NOT_FINETUNED = "no fine-tuned container meets the goal better: this one is not fine-tuned"
BEYOND_PHOTOGRAPHS = (
    "trained for what the photographs show: beyond them it changes more (--evaluate measures how much; --compact 100% "
    "--finetune 0 keeps it)"
)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """All Gaussians, or those at a point of the path, ready to be encoded with any lambda."""

    measured: Measured
    settings: EncodeSettings
    compacted: Compacted | None = None  # None for all Gaussians
    trained: bool = False  # by fine-tuning that completes its training


@dataclass(slots=True, eq=False)
class Search:
    """A search for the container that serves the goal of the settings best."""

    work: Work
    job: JobProgress
    evaluates: bool = False  # whether the result is evaluated after the search
    time_only: bool = False  # only the time is limited: if no container meets the usual loss, the closest one is kept
    compactor: Popspa | None = field(init=False, default=None)  # if fewer Gaussians may serve the goal
    goal: Goal = field(init=False)
    compare: SearchEvaluation = field(init=False)
    plan: SearchPlan = field(init=False)
    path: TrainingPath | None = field(init=False, default=None)  # of the compactor
    attempts: list[Attempt] = field(init=False, default_factory=list)  # in order, without their containers
    tried: list[CountTrial] = field(init=False, default_factory=list)  # scenes evaluated before any encoding
    best: Attempt | None = field(init=False, default=None)  # of those that meet the goal
    closest: Attempt | None = field(init=False, default=None)  # of those that miss it
    stopped: bool = field(init=False, default=False)  # from outside, by StopSearch
    _pruned: list[Attempt] = field(init=False, default_factory=list)  # losses at points 1, 2 and so on
    _whole: Scene | None = field(init=False, default=None)
    _whole_searched: bool = field(init=False, default=False)
    _margins: dict[int, float] = field(init=False, default_factory=dict)  # of trained points before any encoding
    _trained: dict[int, Scene] = field(init=False, default_factory=dict)
    _tuner: Tuner | None = field(init=False, default=None)
    _finetuning: FinetuneReport | None = field(init=False, default=None)  # of the latest attempt that has one
    _best_scene: Scene | None = field(init=False, default=None)
    _best_loss: float | None = field(init=False, default=None)
    _overhead: int = field(init=False, default=OVERHEAD_BYTES)  # of the latest container
    _longest: float = field(init=False, default=0.0)  # attempt without training, seconds
    _last: int = field(init=False, default=0)  # most attempts once the present curve is searched

    def __post_init__(self) -> None:
        work, compact = self.work, self.work.settings.compact
        self.goal = Goal.of(self.encode_settings)
        if not compact.auto_count or len(work.splats) < 2:
            self.plan = SearchPlan(TUNED_CONTAINERS)
            self.compare = SearchEvaluation(work.original, work.views)
            return
        supervision = chosen_views(work.splats, compact, work.views, work.context)
        self.compactor = Popspa(work.splats, compact, supervision, work.context)
        self.plan = SearchPlan(compact.max_compactions)
        if work.time is not None and self.trains:
            in_time = work.time.plan(photographs=self.photographs, time_only=self.time_only)
            self.plan = replace(in_time, containers=min(self.plan.containers, in_time.containers))
        if work.time is not None and self.photographs:
            most = work.time.scoring_views(max(self.first[0], 1))
            self.compactor = replace(self.compactor, supervision=supervision.with_scoring(most))
        self.compare = SearchEvaluation(work.splats, None if work.views is None else supervision.eval_views)
        self.path = TrainingPath(self.compactor, keep_states=not self.tunes)

    @property
    def encode_settings(self) -> EncodeSettings:
        """Settings of the encoder, with the goal."""
        return self.work.settings.encode

    @property
    def tunes(self) -> bool:
        """Whether the settings ask for fine-tuning."""
        return bool(self.work.settings.finetune.enabled)

    @property
    def photographs(self) -> bool:
        """Whether to train on photographs; never for a PSNR to the scene's own renderings, which then falls."""
        trains = self.compactor is not None and self.compactor.settings.trains
        views = self.work.views
        return trains and self.encode_settings.psnr is None and views is not None and views.has_photographs

    @property
    def trains(self) -> bool:
        """Whether fewer Gaussians are trained, on renderings only through the decoder."""
        bare = self.work.views is None and self.encode_settings.psnr is None
        return self.photographs or (bare and self.tunes)

    @property
    def target_size(self) -> int:
        """The size that is the goal, bytes; 0 if none is."""
        return int(self.goal.limits[0].value) if self.goal.by_size else 0

    @property
    def number_for_size(self) -> int:
        """Number of the point whose container is expected to have that size; 0: all Gaussians fit, or no size."""
        splats = self.work.splats
        if not self.target_size:
            return 0
        expected = (BYTES_PER_GAUSSIAN + BYTES_OF_SH * (splats.sh_degree > 0)) * len(splats)
        share = max((self.target_size - self._overhead) / expected, 1 / len(splats))
        return max(0, round(math.log(share) / math.log(curves.KEEP)))

    @property
    def first(self) -> tuple[int, float]:
        """Point of the first trained container, and decibels added to ``quality_offset_db`` there."""
        if self.goal.by_size:
            return self.number_for_size, self.plan.offset_db
        may_step = self.plan.containers > 1 and len(self.work.splats) >= curves.SMALL_SCENE
        number, offset_db = curves.first_point(self.goal, self.plan.number, self.plan.offset_db, may_step=may_step)
        return min(number, last_number(len(self.work.splats))), offset_db

    @property
    def whole(self) -> Scene:
        """The scene with all its Gaussians, whose sensitivity is measured once."""
        if self._whole is None:
            self._whole = Scene(measure(self.work, self.work.splats, self.encode_settings), self.encode_settings)
        return self._whole

    def run(self) -> Attempt:
        """Search, and return the best attempt; raise StopSearch or UnsupportedError if no container met the goal."""
        try:
            if self.path is None:
                self._search_all_gaussians()
            elif self.photographs:
                self._search_with_photographs(self.path)
            else:
                self._search_without_photographs(self.path)
        except StopSearch:
            self.stopped = True
            found = self.best or (self.closest if self.time_only else None)
            if found is None and self.path is not None:
                self._encode_latest(self.path)
                found = self.best or (self.closest if self.time_only else None)
            if found is None:
                raise
        finally:
            self.job.note = ""
        if self.best is None and self.time_only:
            self.best = self.closest
        if self.best is None or self.best.bytes > (self.goal.most_bytes or math.inf):
            raise UnsupportedError(self._failure())
        compares = self.goal.by_size and self.work.time is None and not self.stopped
        return self._compared(self.best) if compares else self.best

    # The searches: all Gaussians, fewer of them trained on photographs, and fewer without photographs.

    def _search_all_gaussians(self, *, tunes: bool = True) -> None:
        """Search for the lambda of all Gaussians, then for that of fine-tuned containers if the settings say so."""
        if not self._whole_searched:
            most = self.encode_settings.max_encodes
            self._along_lambda(self.whole, most=min(ENCODES, most) if self.tunes else most)
            self._whole_searched = True
        if tunes:
            self._fine_tune()

    def _fine_tune(self) -> None:
        """Fine-tune containers of the scene of the best one, or of all Gaussians."""
        whole = len(self.work.splats)
        start = self.best or next(attempt for attempt in reversed(self.attempts) if attempt.count == whole)
        if not self.tunes or start.trained or start.rd_lambda is None:
            return
        scene = self._best_scene or self.whole
        if self.best is not None:  # with its codebook
            scene = replace(scene, settings=self.best.made.settings)
        most = min(TUNED_CONTAINERS, self.encode_settings.max_encodes)
        self._along_lambda(scene, start.rd_lambda, tuner=make_tuner(self.work), most=most)

    def _search_with_photographs(self, path: TrainingPath) -> None:
        """Train along the path, and encode where a container should meet the goal."""
        limited, (first, _) = self.work.time, self.first
        if self.goal.by_size and (self.target_size <= OVERHEAD_BYTES or first == 0):
            self._search_all_gaussians()
            return
        if limited is None:
            # Not beyond a scene whose rendering failed.
            self._prune_while(path, lambda scene: (scene.drop or 0.0) <= PRUNABLE_DROP, PRUNABLE_POINTS)
        else:  # what each point loses is not worth the time to measure it
            self._prune_to(path, min(first - 1, PRUNABLE_POINTS))
        if limited is not None and not self._recovers(path):
            self._search_all_gaussians(tunes=False)
            left = limited.plan(photographs=True, time_only=self.time_only).containers
            self.plan = replace(self.plan, containers=min(self.plan.containers, left))
        last = last_number(len(path.whole))
        if limited is None and not self.goal.by_size:
            failing = self._first_that_fails(path, first)
            if failing > first:
                first = last = failing - 1
        if not self._whole_searched or self.plan.containers > 1:
            self._along_path(path, first, last)
        if self.best is None and not self.time_only:
            self._search_all_gaussians()

    def _first_that_fails(self, path: TrainingPath, number: int) -> int:
        """Train along the path from point ``number`` on, up to the first that misses the goal before any encoding.
        Photographs may show more than the scene does: training then makes it better than it was, and a container of
        point ``number`` would use up little of what may be lost."""
        last = last_number(len(path.whole))
        while number < last:
            for passed in (True, False):  # a few steps show whether the scene is far from the limit
                point = self._train_to(path, number, passed=passed)
                self._margins[number] = self.goal.margin(self._try_unencoded(point.splats))
                if self._margins[number] >= HALF_LEFT:
                    break
            if self._margins[number] < 0:
                break
            number += 1
        return number

    def _recovers(self, path: TrainingPath) -> bool:
        """Train up to the first point, and return whether fine-tuning can be expected to recover what is still lost.
        The larger and the more detailed a scene is, the less is recovered in a time."""
        allowed = self.goal.psnr_drop
        if allowed is None:  # PSNR does not tell what becomes of other goals
            return True
        point = self._train_to(path, self.first[0])
        return (self._try_unencoded(point.splats).drop or 0.0) <= RECOVERABLE_DB + allowed

    def _search_without_photographs(self, path: TrainingPath) -> None:
        """Encode all Gaussians, then as few of them as pruning alone serves the goal with, trained if settings say so.
        For a size, pruning without training loses more than it saves, unless all Gaussians miss it. A scene whose
        Gaussians are all needed keeps them."""
        trains = self.trains and self.plan.containers > 0
        self._search_all_gaussians(tunes=False)
        whole, fits = self.best, self.goal.by_size and self.attempts[0].bytes <= self.target_size
        if whole is None and self.target_size > self._overhead:
            self._along_path(path, self.number_for_size, last_number(len(path.whole)))
        elif whole is not None and not fits and (trains or not (self.trains or self.goal.by_size)):
            allowed = self._loss(whole.made) if self.goal.by_size else math.inf

            def serves(scene: Attempt) -> bool:
                return (scene.drop or 0.0) <= allowed if self.goal.by_size else self.goal.margin(scene) >= 0

            self._prune_while(path, serves, min(RENDERED_POINTS, self.number_for_size or RENDERED_POINTS))
            number = max((n for n, scene in enumerate(self._pruned, 1) if serves(scene)), default=0)
            if number:
                scene = self._scene_at(path, number) if trains else self._untrained(path, path.points[number])
                rd_lambda = self._lambda_for_size(number) if self.goal.by_size else whole.rd_lambda
                self._along_lambda(scene, rd_lambda, tuner=self._tuner, most=self.plan.containers)
        self._fine_tune()

    def _lambda_for_size(self, number: int) -> float:
        """Return the lambda at which a point should have the target size, by containers of all Gaussians."""
        wanted = self.target_size / curves.KEEP ** (SIZE_BY_COUNT * number)
        made = sorted((attempt.bytes, attempt.rd_lambda) for attempt in self.attempts if attempt.rd_lambda is not None)
        sizes, lambdas = np.log2([size for size, _ in made]), np.log2([rd_lambda for _, rd_lambda in made])
        return float(2.0 ** np.interp(math.log2(wanted), sizes, lambdas))

    def _encode_latest(self, path: TrainingPath) -> None:
        """Encode the latest point of the path without further training, or all Gaussians, where a search was stopped.
        For a quality it is the latest trained point that leaves at least half of the error to the encoder: most do not,
        as they are still to be fine-tuned."""
        latest, self.stopped = len(path.points) - 1, False
        self.job.stops_search = False
        if not self.goal.by_size and path.points[latest].trained and latest not in self._margins:
            evaluation = self.compare(path.points[latest].splats, self.work.context.stage("evaluate"))
            figures = Attempt(len(path.points[latest]), None, 0).with_evaluation(evaluation)
            self._margins[latest] = self.goal.margin(figures)
        serving = [number for number, margin in self._margins.items() if margin >= HALF_LEFT]
        number = latest if self.goal.by_size else max(serving, default=None)
        if number is not None:
            self._along_lambda(self._untrained(path, path.points[number]), most=self.encode_settings.max_encodes)
        if self.best is None and not self.goal.by_size:
            self._search_all_gaussians(tunes=False)
        self.stopped = True

    # Points of the path.

    def _prune_to(self, path: TrainingPath, number: int) -> None:
        while len(path.points) <= number:
            path.prune(count_at(len(path.points), len(path.whole)))

    def _prune_while(self, path: TrainingPath, useful: Callable[[Attempt], bool], most: int) -> None:
        """Prune and evaluate point after point up to number ``most``, or to the first that is not ``useful``."""
        while len(path.points) <= most and len(path.points[-1]) > 1:
            if self.stopped:
                raise StopSearch
            self._prune_to(path, len(path.points))
            self._pruned.append(self._try_unencoded(path.points[-1].splats))
            if not useful(self._pruned[-1]):
                break

    def _try_unencoded(self, splats: Splats) -> Attempt:
        """Return the figures of a scene that is not encoded, and record them for the report."""
        evaluation = self.compare(splats, self.work.context.stage("evaluate"))
        found = Attempt(len(splats), None, 0).with_evaluation(evaluation)
        trial = CountTrial(len(splats), drop_of(evaluation), found.ssim_drop, self.goal.decisive(found).loss(found))
        self.tried = [each for each in self.tried if each.count != trial.count] + [trial]
        return found

    def _train_to(self, path: TrainingPath, number: int, *, passed: bool = False) -> PathPoint:
        """Prune and train up to a point of the path, and return it; ``passed`` as in :meth:`TrainingPath.train`."""
        pruned_only = RENDERED_POINTS if self.trains and not self.photographs else 0
        while len(path.points) <= number:
            trains = len(path.points) > pruned_only
            if trains:
                self._train(path, number, passed=True)
            self._prune_to(path, len(path.points))
        if number > pruned_only and number == len(path.points) - 1:
            self._train(path, number, passed=passed)
        return path.points[number]

    def _train(self, path: TrainingPath, number: int, *, passed: bool) -> None:
        """Train the last point of the path, on the way to point ``number``."""
        # The last point takes three times as many steps.
        limited, points = self.work.time, number + 2 - len(path.points) + 2 * passed
        deadline = None if limited is None else limited.for_point(points, self._containers_left)
        path.train(passed=passed, deadline=deadline)

    def _untrained(self, path: TrainingPath, point: PathPoint) -> Scene:
        """Return a point as a scene whose levels are not trained."""
        if point is path.whole:
            return self.whole
        compacted, settings = path.compacted(point, refine=False), self.encode_settings
        return Scene(measure(self.work, compacted.splats, settings), settings, compacted)

    def _scene_at(self, path: TrainingPath, number: int) -> Scene:
        """Return the scene at a point of the path, trained, and with a tuner if the settings ask for fine-tuning."""
        if number not in self._trained:
            limited, deadline, point = self.work.time, None, self._train_to(path, number)
            if limited is not None:
                deadline = limited.for_container(self._containers_left)
                deadline = deadline.earlier(limited.encode_seconds + self._evaluation_seconds)
            compacted = path.compacted(point, refine=not self.tunes, deadline=deadline)
            changes: dict[str, float] = {"color_refit_iterations": 0} if self.tunes else {}  # training replaces it
            if self.photographs:
                offset_db = self.encode_settings.quality_offset_db + self.first[1]
                changes["quality_offset_db"] = min(offset_db, MAX_OFFSET_DB)
            settings = self.encode_settings.model_copy(update=changes)
            if self.tunes and self._tuner is None:
                self._tuner = self._completing_tuner(path)
            scene = Scene(measure(self.work, compacted.splats, settings), settings, compacted, trained=self.tunes)
            self._trained[number] = scene
        if self._tuner is not None and self.work.time is not None:
            share = self.work.time.for_container(self._containers_left)
            deadline = share.earlier(self._evaluation_seconds)
            self._tuner.context = replace(self._tuner.context, deadline=deadline)
        return self._trained[number]

    def _completing_tuner(self, path: TrainingPath) -> Tuner:
        """Return what fine-tunes containers of the path, and so completes its training."""
        finetune, compactor = self.work.settings.finetune, path.compactor
        changes = {name: factor * getattr(finetune, name) for name, factor in COMPLETING.items()}
        changes["steps"] = max(1, round(changes["steps"]))
        tuner = make_tuner(self.work, finetune.model_copy(update=changes), compactor)
        if self.work.time is not None:  # it evaluates in the same images of a capture
            seconds = self.compare.seconds if compactor.supervision.captured else 0.0
            tuner.ending_seconds = self.work.time.ending_seconds + seconds
        return tuner

    @property
    def _containers_left(self) -> int:
        """Trained containers that are still to be made, the next one included."""
        made = sum(attempt.count < len(self.work.splats) for attempt in self.attempts)
        return max(self.plan.containers - made, 1)

    @property
    def _evaluation_seconds(self) -> float:
        """Expected time to evaluate a container: that of the latest evaluation, none where sizes are searched."""
        return 0.0 if self.goal.by_size else self.compare.seconds

    # Attempts.

    def _along_lambda(
        self, scene: Scene, rd_lambda: float | None = None, *, tuner: Tuner | None = None, most: int
    ) -> None:
        """Make up to ``most`` containers of a scene, the first one at ``rd_lambda`` or as its settings say."""
        limit = math.inf if self.best is None or self._best_scene is scene or self.goal.by_size else self.best.bytes
        self._last = len(self.attempts) + most
        if self.attempts:
            self._expect(scene, tuner)

        def is_near(attempt: Attempt) -> bool:
            decisive = self.goal.decisive(attempt)
            return decisive.margin(attempt) <= decisive.near_enough(trained=tuner is not None)

        def encode_at(settings: EncodeSettings) -> Attempt:
            attempt = self._attempt(scene, settings, tuner, is_near)
            if self.goal.margin(attempt) < 0 and self._expected_bytes(attempt) >= limit:
                raise NoFurtherError
            return attempt

        with suppress(NoFurtherError):
            LambdaCurve(self.goal, encode_at, scene.settings, most, tuned=tuner is not None).search(rd_lambda)

    def _along_path(self, path: TrainingPath, first: int, last: int) -> None:
        """Make trained containers of points of the path up to ``last``, the first one at point ``first``."""

        def encode_at(number: int, log2_lambda: float | None) -> Attempt:
            if self.stopped:
                raise StopSearch
            self.job.note = "; last: ".join(
                [f"{count_at(number, len(path.whole)):,} Gaussians", *(each.summary() for each in self.attempts[-1:])]
            )
            scene = self._scene_at(path, number)
            settings = scene.settings if log2_lambda is None else at_lambda(scene.settings, log2_lambda)
            return self._attempt(scene, settings, self._tuner, lambda attempt: self.goal.log2_margin(attempt) <= near)

        self._last = len(self.attempts) + self.plan.containers
        near = NEAR_LOG2 if self.work.time is None and self.goal.most_bytes is None else NEAR_IN_TIME
        if self.plan.containers == 0:  # there is no time for training
            self._prune_to(path, max(first, 1))
        with suppress(NoFurtherError):
            curves.along_path(self.goal, encode_at, first, last, self.plan.containers, near)
        if self.goal.by_size and self.best is None and len(path.points) > 1:  # lambda alone makes it small enough
            self._along_lambda(self._untrained(path, path.points[-1]), most=self.encode_settings.max_encodes)

    def _attempt(
        self, scene: Scene, settings: EncodeSettings, tuner: Tuner | None, is_near: Callable[[Attempt], bool]
    ) -> Attempt:
        """Make a container, evaluate it, and keep it if it serves the goal best so far, unless there is no time. One
        that meets the goal and ``is_near`` it is the last of its curve."""
        if self.stopped:
            raise StopSearch
        self._check_time(trained=tuner is not None)
        began = time.perf_counter()
        made = encode(self.work, scene.measured, settings, tuner, completes=scene.trained)
        made = replace(made, compacted=scene.compacted)
        size = stored_sizes(made.encoded.files, packed=self.work.packed)[0]
        images = (len(data) for name, data in made.encoded.files.items() if name.endswith(".webp"))
        self._overhead = size - sum(images)
        attempt = Attempt(len(scene.measured.splats), made.encoded.rd_lambda, size, container=made)
        if not self.goal.by_size:
            attempt = attempt.with_evaluation(self._evaluate(made))
        if tuner is None:
            self._longest = max(self._longest, time.perf_counter() - began)
        self._finetuning = made.finetuning or self._finetuning
        self._keep(attempt, scene)
        if self.goal.margin(attempt) >= 0 and is_near(attempt):
            self._last = len(self.attempts)
        self._expect(scene, tuner)
        return attempt

    def _expect(self, scene: Scene, tuner: Tuner | None) -> None:
        expected = Expected.of(self.work.splats, self.work.settings, self.work.views, self.work.context.threads)
        count = None if tuner is None and scene is self._whole else len(scene.measured.splats)
        left = max(self._last - len(self.attempts), 0)
        steps = expected.further(left, count, tuned=tuner is not None)
        self.job.expect([*steps, *expected.stages("evaluate") * self.evaluates])

    def _expected_bytes(self, attempt: Attempt) -> float:
        """Return the size at which the scene of an attempt that misses the goal should meet it."""
        missed = self.goal.decisive(attempt)
        return attempt.bytes * 2 ** (SIZE_BY_LAMBDA * missed.margin(attempt) / missed.slope)

    def _check_time(self, *, trained: bool) -> None:
        """Refuse another attempt that would not be finished in time, if there is one that can be returned."""
        limited = self.work.time
        if limited is None:
            return
        met = self.best is not None and self.best.bytes <= (self.goal.most_bytes or math.inf)
        enough = met or (bool(self.attempts) and (trained or self.time_only))
        if enough and limited.deadline.seconds < limited.expected(self._longest, trained=trained):
            raise NoFurtherError

    def _keep(self, attempt: Attempt, scene: Scene) -> None:
        self.attempts.append(replace(attempt, container=None))
        self.job.note = f"try {len(self.attempts) + 1}, last: {attempt.summary()}"
        if self.goal.margin(attempt) < 0:
            if self.closest is None or self.goal.margin(attempt) > self.goal.margin(self.closest):
                self.closest = attempt
        elif self._is_better(attempt, scene):
            self.best, self._best_scene = attempt, scene

    def _is_better(self, attempt: Attempt, scene: Scene) -> bool:
        """Whether an attempt that meets the goal has fewer bytes than the best one, or loses less at a given size."""
        if self.best is None:
            return True
        if not self.goal.by_size:
            return attempt.bytes < self.best.bytes
        if scene is self._best_scene and not attempt.trained:
            return attempt.bytes > self.best.bytes
        if self._best_loss is None:
            self._best_loss = self._loss(self.best.made)
        loss = self._loss(attempt.made)
        if loss >= self._best_loss:
            return False
        self._best_loss = loss
        return True

    def _evaluate(self, made: Container) -> Evaluation:
        """Compare a container with the original, also where the search is stopped meanwhile: the container exists."""
        try:
            self.work.context.progress("evaluate", 0.0)
        except StopSearch:
            self.stopped = True
        return self.compare(self._decoded(made), Context(self.work.context.threads))

    def _decoded(self, made: Container) -> Splats:
        most = ReadOptions.allowing(len(self.work.original))
        return read_scene(made.encoded.files, most, threads=self.work.context.threads)

    def _compared(self, best: Attempt) -> Attempt:
        """Return the best container of a size, which need not have been compared, with what it loses. Where that cannot
        be found out, because the search is stopped or a photograph is damaged, the container stands without figures."""
        try:
            evaluation = self.compare(self._decoded(best.made), self.work.context.stage("evaluate"))
        except (StopSearch, InvalidViewsError):
            return best
        compared = best.with_evaluation(evaluation)
        last = max(n for n, attempt in enumerate(self.attempts) if attempt == best)  # equal but for the container
        self.attempts[last] = replace(compared, container=None)
        return compared

    def _loss(self, made: Container) -> float:
        """Return the drop of PSNR of a container, decibels; infinite if a rendering failed. If the photographs equal
        the scene's renderings, every drop is infinite. It is then a large number minus PSNR."""
        evaluation = self._evaluate(made)
        drop, psnr = drop_of(evaluation), evaluation.mean.candidate.psnr
        if math.isnan(drop) or math.isnan(psnr):
            return math.inf
        return drop if math.isfinite(drop) else UNKNOWN_DROP - min(psnr, 1e3)

    # The report.

    def compacted(self, best: Attempt) -> Compacted | None:
        """Return the scene of the best container with the report of its compaction; None without compaction."""
        if self.compactor is None:
            return None
        found = best.made.compacted or unchanged(self.work.splats, self._reason_to_keep_all())
        trained = found.report.target_source == "photos" or best.trained
        beyond = BEYOND_PHOTOGRAPHS if trained and best.made.compacted and self.photographs else ""
        estimates = bool(self.tried) and self.goal.psnr_drop is None
        estimated = estimate_note(self.compactor.supervision) if estimates else ""
        note = "; ".join(filter(None, [found.report.note, beyond, estimated]))
        return replace(found, report=replace(found.report, trials=tuple(self.tried), note=note))

    def finetuning(self, best: Attempt) -> FinetuneReport | None:
        """Return the report of the fine-tuning, which says so if it was in vain."""
        if self._finetuning is None or best.trained:
            return best.made.finetuning
        return replace(self._finetuning, kept=False, note=NOT_FINETUNED)

    def note(self, best: Attempt) -> str:
        """Return a note: losses are estimates, or the finest container of the scene is below the target size."""
        if self.goal.psnr_drop is not None and best.against == "renderings":
            return ESTIMATED_DROP
        margin, target = self.goal.margin(best), self.target_size
        finest = best.rd_lambda == 2.0 ** curves.LOG2_LAMBDA_RANGE[0]
        if not target or not finest or margin <= self.goal.limits[0].near:
            return ""
        return f"target_size {target:,} bytes is above the finest container of this scene: {best.bytes:,} bytes"

    def _failure(self) -> str:
        """Return why no container meets the goal."""
        if self.best is not None:
            wanted = dict.fromkeys(limit.wanted if limit.quality else limit.name for limit in self.goal.limits)
            names = " and ".join(["target_size", *wanted])
            verb = "were not met before the search was stopped" if self.stopped else "cannot be met together"
            return (
                f"{names} {verb}: the smallest container found with that quality has {self.best.bytes:,} bytes; allow "
                f"at least that{'' if self.work.time is None else ', or more time'}"
            )
        suggest = self.path is None and len(self.work.splats) > 1 and self.target_size > self._overhead
        message = self.goal.failure_message(self.attempts, suggest_compaction=suggest)
        coarse = "" if self.closest is None else self.closest.made.encoded.coarse
        return "; ".join(filter(None, [message, coarse]))

    def _reason_to_keep_all(self) -> str:
        if self.tried or any(attempt.count < len(self.work.splats) for attempt in self.attempts):
            return "and no smaller number of Gaussians that was tried serves the goal better"
        if self.goal.by_size and (not self.attempts or self.attempts[0].bytes <= self.target_size):
            return "and all of them fit into the target size"
        if self.stopped:
            return "and the search was stopped before a smaller number was tried"
        if self.plan.containers == 0:
            return "and there was too little time to train a smaller number"
        return "and a smaller number would serve the goal less"
