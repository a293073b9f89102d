"""How long compressions take: the steps to expect, what to do in a limited time, and how it is divided among them."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from kissgs.core.context import TORCH_MISSING, Context, Deadline, Step, has_torch, processors
from kissgs.core.errors import OutputError
from kissgs.io.files import atomic_file, reason_of
from kissgs.settings import Preset, Settings, TrainingViewSettings

if TYPE_CHECKING:
    from kissgs.cameras.views import Views
    from kissgs.core.splats import Splats

# Expected time of an encoding on this machine, from its speed as ``kissgs warmup`` has measured it.

ENCODE_SECONDS = {
    Preset.FAST: (0.5, 0.0, 6e-6),
    Preset.BALANCED: (1.5, 5.0, 40e-6),
    Preset.PAPER: (1.0, 0.0, 140e-6),
}
"""Seconds of an encoding by preset, measured on two processors: a fixed part; one that all scenes of more than
:data:`FULL_RENDERINGS` Gaussians have, for renderings; one per Gaussian."""

FULL_RENDERINGS = 20_000  # Gaussians from which renderings take about the same time; fewer take less
SPEEDS = (1e-3, 1e3)  # slowest and fastest speed of a processor that is believed, in units of save_speed
REFERENCE_PROCESSORS, MOST_PROCESSORS = 2, 8  # of that machine, and beyond which nothing becomes faster


def encode_seconds(preset: Preset, count: int, threads: int = 0) -> float:
    """Return the expected wall time of an encoding of ``count`` Gaussians without training, seconds. ``threads`` is the
    number of threads; 0 means one per processor."""
    return _reference_seconds(ENCODE_SECONDS[preset], count) / speed(threads)


def speed(threads: int) -> float:
    """Return the speed of this machine with so many threads, in units of two processors of the reference."""
    return _speed_per_processor() * min(threads or processors(), processors(), MOST_PROCESSORS)


def _reference_seconds(parts: tuple[float, float, float], count: float) -> float:
    fixed, renderings, each = parts
    return fixed + renderings * min(count / FULL_RENDERINGS, 1.0) + each * count


def save_speed(seconds: float, preset: Preset, count: int) -> None:
    """Save the speed of this machine, which encoded ``count`` Gaussians in ``seconds`` with all its processors."""
    speed = _reference_seconds(ENCODE_SECONDS[preset], count) / seconds
    try:
        path = _speed_file()
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    except RuntimeError as error:  # this user has no home
        raise OutputError("there is no folder for caches; name one by XDG_CACHE_HOME") from error
    with atomic_file(path, overwrite=True) as file:
        file.write(json.dumps({"speed_per_processor": speed / min(processors(), MOST_PROCESSORS)}).encode())


def _speed_per_processor() -> float:
    """Return the speed that was saved, of the reference machine if none was or the file is damaged."""
    try:
        speed = float(json.loads(_speed_file().read_bytes())["speed_per_processor"])
    except (OSError, RuntimeError, ValueError, TypeError, KeyError, OverflowError):
        return 1 / REFERENCE_PROCESSORS
    return speed if SPEEDS[0] <= speed <= SPEEDS[1] else 1 / REFERENCE_PROCESSORS


def _speed_file() -> Path:
    """Return the file of the speed, in the user's folder for caches."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kissgs" / "speed.json"


# ``Expected``: the stages of a compression and the seconds of each, for its progress.

STAGE_SECONDS = {
    "kernels": (0.25, 0.0, 0.0),
    "cameras": (0.5, 1.2, 7e-6),
    "sensitivity": (0.4, 1.2, 4e-6),
    "rate_distortion": (0.05, 0.0, 4e-6),
    "order": (0.0, 0.0, 0.2e-6),
    "forms": (0.0, 0.0, 0.2e-6),
    "codebook": (0.01, 0.0, 13e-6),
    "sort codebook": (0.01, 0.0, 3e-6),
    "rounding": (0.01, 0.0, 2e-6),
    "refit": (0.2, 1.0, 4e-6),
    "reorder": (0.01, 0.0, 3e-6),
    "images": (0.1, 0.0, 35e-6),
    "evaluate": (0.3, 0.3, 15e-6),
    "merge": (0.0, 0.0, 8e-6),
}
"""Seconds of each stage with the preset balanced, in parts as those of :data:`ENCODE_SECONDS`."""

OTHER_PRESETS = {
    Preset.FAST: {"order": (0.2, 0.0, 0.2e-6), "codebook": (0.01, 0.0, 4e-6)}
    | {"sort codebook": (0.0, 0.0, 0.6e-6), "images": (0.0, 0.0, 1.4e-6)},
    Preset.PAPER: {"order": (0.2, 0.0, 70e-6), "forms": (0.0, 0.0, 16e-6)}
    | {"sort codebook": (0.0, 0.0, 21e-6), "images": (0.02, 0.0, 7e-6)},
}
"""Seconds that differ with other presets; the first stage also loads what was compiled."""

SMALL_IMAGES = 0.75e-8  # seconds of images with high effort by the square of the number of Gaussians
FIRST_EVALUATION = 1.2  # seconds in which a search chooses the views that it evaluates in

STEP, TUNING_STEP, SCORE, TARGET = (3e-3, 1.2e-7, 3e-7), (8e-3, 2e-7, 1.2e-6), (5e-3, 1.2e-7, 1e-6), (2e-3, 8e-8, 1e-7)
"""Seconds of an image in training, fine-tuning, scoring and as a target: fixed, for each pixel, for each Gaussian."""

FOR_SIZE, COMPACTIONS, PRUNED, POINTS, FEWER = 3, 7, 2, 3, 0.4
"""Results that searches usually make: containers of a scene for a size, compactions for a loss, scenes that are pruned
without training, twice as many for a size, and others on the way; share of the Gaussians in these."""


@dataclass(frozen=True, slots=True)
class Expected:
    """The stages to expect of a compression, from what is known when it begins."""

    settings: Settings
    count: int  # Gaussians
    sh_degree: int
    captured: int = 0  # training views of the capture
    speed: float = 1.0  # of this machine, see :func:`speed`

    @classmethod
    def of(cls, splats: Splats, settings: Settings, views: Views | None, threads: int) -> Expected:
        """Return what is known of the compression of a scene."""
        return cls(settings, len(splats), splats.sh_degree, 0 if views is None else len(views.train), speed(threads))

    def stages(self, *names: str) -> list[Step]:
        """Return stages with their seconds."""
        parts = STAGE_SECONDS | OTHER_PRESETS.get(self.settings.preset, {})
        return [(name, _reference_seconds(parts[name], self.count) / self.speed) for name in names]

    def steps(self, *, evaluate: bool = False) -> list[Step]:
        """Return the steps of :func:`kissgs.compress`, from the scene on."""
        settings, scene, before = self.settings, self, self.stages("kernels")
        if settings.compact.enabled and not settings.compact.auto_count:
            scene, before = self._fewer(self._kept), self.compaction()
        tuned = bool(settings.finetune.enabled)
        views = [*scene.stages("cameras"), scene._targets(settings.finetune)] * tuned
        once = [*scene._measured(), *views, *scene._container(tuned=tuned)]
        made = scene._search() if settings.encode.has_goal else once
        return [*before, *made, *scene.stages("evaluate") * evaluate]

    def compaction(self) -> list[Step]:
        """Return the steps of a compaction to a number or share of the Gaussians, or with a loss."""
        compact, steps, once = self.settings.compact, self.stages("kernels"), self.stages("merge")
        if compact.method == "prune":
            steps += self.stages("cameras")
            first = self._kept**compact.initial_prune_fraction if compact.sparsify_steps else self._kept
            once, fewer, left = [self._scored(first)], self._fewer(first), self._fewer(self._kept)
            if compact.trains:
                steps.append(self._targets(compact))
                scoring = compact.prune_rounds * fewer._scored(1.0)[1]
                once.append(("sparsify", scoring + fewer._images(STEP, compact.sparsify_steps, compact)))
                once.append(("refine", left._images(STEP, compact.refine_steps, compact)))
        if compact.max_psnr_drop is None:
            return [*steps, *once]
        return [*steps, *self._with_views([*once, *self.stages("evaluate")] * COMPACTIONS)]

    @property
    def _kept(self) -> float:
        """The share of the Gaussians that a compaction keeps; a guess where a loss is given."""
        compact = self.settings.compact
        return min(compact.ratio or (compact.count or FEWER * self.count) / max(self.count, 1), 1.0)

    def _fewer(self, share: float) -> Expected:
        return replace(self, count=round(share * self.count))

    def _images(self, seconds: tuple[float, float, float], images: float, views: TrainingViewSettings) -> float:
        """Return the seconds of so many images of training, scoring or targets."""
        side = views.view_size * (1.0 if self.captured else 0.6)
        fixed, each_pixel, each_gaussian = seconds
        return images * (fixed + each_pixel * 0.7 * side**2 + each_gaussian * self.count) / self.speed

    def _targets(self, views: TrainingViewSettings) -> Step:
        return "targets", self._images(TARGET, self.captured or views.views, views)

    def _scored(self, kept: float) -> Step:
        """Return the pruning of all but a share of the Gaussians, by a quarter of the views or those of the capture."""
        compact = self.settings.compact
        most = compact.min_keep_per_scoring or kept
        rounds = max(1, math.ceil(math.log(kept) / math.log(most) - 1e-9)) if most < 1 else 1
        return "score", self._images(SCORE, rounds * (0.5 * self.captured or 0.25 * compact.views), compact)

    def _measured(self) -> list[Step]:
        """Return the steps before a scene is encoded for the first time."""
        return self.stages("cameras", "sensitivity") if self.settings.encode.rate_distortion else []

    def _container(self, *, tuned: bool) -> list[Step]:
        """Return the steps of an encoding."""
        encode, finetune = self.settings.encode, self.settings.finetune
        plans, refits = encode.rate_distortion, self.captured > 0 and not (tuned and encode.has_goal)
        reorder = ["reorder"] * (encode.order == "refined")
        names = [*["rate_distortion"] * plans, "order", "forms", *["codebook", "sort codebook"] * (self.sh_degree > 0)]
        names += [*["rounding"] * plans, *["refit"] * (plans and refits), *reorder]
        images = self.stages("images")
        if self.count <= encode.high_effort_pixels:
            images = [("images", (0.1 + SMALL_IMAGES * self.count**2) / self.speed)]
        tuning = ("finetune", images[0][1] + self._images(TUNING_STEP, finetune.steps, finetune))
        return [*self.stages(*names), *[tuning, *self.stages(*reorder)] * tuned, *images]

    def _evaluated(self) -> list[Step]:
        """Return the comparison of a container in a search: the views of captures are few."""
        return [(name, seconds * (0.2 if self.captured else 1.0)) for name, seconds in self.stages("evaluate")]

    def _search(self) -> list[Step]:
        """Return the steps of a search for a goal."""
        compact, fewer = self.settings.compact, self._fewer(FEWER)
        begin = self.stages("cameras") * bool(compact.auto_count)
        if not (compact.auto_count and self.captured):
            return [*begin, *self._measured(), *self.further(self.settings.encode.max_encodes)]
        unit = "sparsify", fewer._images(STEP, compact.sparsify_steps / compact.prune_rounds, compact)
        begin += [*[self._scored(0.8), *self._evaluated()] * PRUNED, self._targets(compact)]
        begin += [*[unit, fewer._scored(0.8)] * POINTS, *[unit, *self._evaluated()] * 2]
        return begin + self.further(compact.max_compactions, fewer.count, tuned=bool(self.settings.finetune.enabled))

    def further(self, left: int, count: int | None = None, *, tuned: bool = False) -> list[Step]:
        """Return the steps of a search when up to ``left`` further containers may follow, half of which are expected:
        of ``count`` Gaussians, fine-tuned or not; or without a count, of the whole scene, and then of fewer."""
        compact, encode, steps = self.settings.compact, self.settings.encode, list[Step]()
        by_size, fewer = encode.target_size is not None, replace(self, count=self.count if count is None else count)
        evaluated, again = [] if by_size else self._evaluated(), list[Step]()
        number = -(-left // 2)
        if count is not None:
            again = fewer._measured() if self.captured and count < self.count else []
        else:
            steps = [*self._container(tuned=False), *evaluated] * (min(left, FOR_SIZE) if by_size else number)
            tuned = bool(self.settings.finetune.enabled)
            number = -(-compact.max_compactions * tuned // 2)
            if compact.auto_count and not self.captured:
                fewer = self._fewer(FEWER)
                steps += [self._scored(0.8), *self._evaluated()] * (PRUNED * (1 + by_size))
                steps += [self._targets(compact), *fewer._measured()]
        steps += [*again, *fewer._container(tuned=tuned), *evaluated] * number + self._evaluated() * by_size
        return steps if count is not None or (left < encode.max_encodes and not by_size) else self._with_views(steps)

    def _with_views(self, steps: list[Step]) -> list[Step]:
        """Return the steps of a search, the first evaluation of which includes the choice of its views; a capture has
        them."""
        if self.captured:
            return steps
        first = next(at for at, (name, _) in enumerate(steps) if name == "evaluate")
        steps[first] = "evaluate", steps[first][1] + FIRST_EVALUATION / self.speed
        return steps


# ``SearchTime``: how a limited time is divided among training and containers. The unit is the expected time of an
# encoding of the whole scene without training.

CONTAINER_SHARE, LAST_CONTAINER_SHARE = 2.0, 4.0  # to fine-tune one; a point's training is 1
ENDING_SHARE = 0.38  # time to write a fine-tuned container and to evaluate it in small images
LEAST_FOR_CONTAINER, CAPTURE_TIME = 2.0, 1.5  # to begin a trained one; an encoding with a capture and refits

# Time to score in one view, share of the time that all scoring shall take, and views that score in any case.
SCORE_SHARE, SCORING_SHARE, LEAST_SCORING_VIEWS = 0.004, 0.15, 16


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """Containers and training of a search. A search for a small loss that began with a fifth of the Gaussians ended,
    for a scene of 300, with more bytes than the encoder alone takes; 5 dB instead of 4 take 4 % more bytes and rarely
    save a second container."""

    containers: int
    number: int = 6  # point of the path that is tried first for a loss of 0.1 dB: a quarter of the Gaussians
    offset_db: float = 4.0  # added to quality_offset_db there


TIME_ONLY = (
    (4.2, SearchPlan(1, 4, 3.0)),
    (8.0, SearchPlan(1, 5, 3.0)),
    (16.0, SearchPlan(1)),
    (40.0, SearchPlan(2)),
    (math.inf, SearchPlan(3)),
)
"""Plans where the goal is no more than an aim, each up to a time.

With fewer Gaussians, training that is too short loses more than they save.
"""

WITH_GOAL = (
    (4.2, SearchPlan(1, 2, 3.0)),
    (8.5, SearchPlan(1, 4, 3.0)),
    (40.0, SearchPlan(2, 5, 3.0)),
    (math.inf, SearchPlan(3)),
)
"""Plans where the goal must be met: a single container needs a reserve, two can come near it."""

RENDERED = ((15.0, SearchPlan(0)), (30.0, SearchPlan(1)), (60.0, SearchPlan(2)), (math.inf, SearchPlan(3)))
"""Plans where renderings of the scene are the targets: number and lambda follow from a search of the encoder."""


@dataclass(frozen=True, slots=True)
class SearchTime:
    """The time of a search."""

    deadline: Deadline  # until which the best container shall be ready
    encode_seconds: float  # expected of an encoding of the whole scene without training

    def expected(self, longest: float, *, trained: bool) -> float:
        """Return the expected seconds of another container; ``longest`` is the longest one without training so far."""
        if trained:
            return LEAST_FOR_CONTAINER * self.encode_seconds
        return longest or CAPTURE_TIME * self.encode_seconds

    @property
    def ending_seconds(self) -> float:
        """Expected seconds to write a fine-tuned container and to evaluate it in small images."""
        return ENDING_SHARE * self.encode_seconds

    def plan(self, *, photographs: bool, time_only: bool) -> SearchPlan:
        """Return what to do in the time that is left, by the targets, and whether the goal is no more than an aim."""
        left = self.deadline.seconds / self.encode_seconds
        plans = RENDERED if not photographs else TIME_ONLY if time_only else WITH_GOAL
        return next(plan for most, plan in plans if left <= most)

    def scoring_views(self, rounds: int) -> int:
        """Return the number of views for which there is time in so many rounds of scoring."""
        seconds = rounds * SCORE_SHARE * self.encode_seconds
        return max(LEAST_SCORING_VIEWS, int(SCORING_SHARE * max(self.deadline.seconds, 0.0) / seconds))

    def for_point(self, points: int, containers: int) -> Deadline:
        """Return the deadline for training the next of so many points, before so many containers."""
        left = self.deadline.seconds - containers * self.encode_seconds
        share = LAST_CONTAINER_SHARE if containers == 1 else CONTAINER_SHARE
        return Deadline.after(max(left, 0.0) / (points + share * containers))

    def for_container(self, containers: int) -> Deadline:
        """Return the deadline of the next of so many containers."""
        return Deadline.after(max(self.deadline.seconds, 0.0) / containers)


# ``Choice``: compaction, fine-tuning and the preset where the settings leave them open, or the time is too short.

NOT_TRAINED = (
    f"nothing was trained, which needs {TORCH_MISSING}; training makes containers smaller at equal quality, much "
    "smaller on photographs"
)

TOO_LITTLE_TIME = "there was too little time for training"

TRAINING_TIME, TUNING_TIME = 3.5, 5.0
"""Time from which training on photographs and fine-tuning on renderings of the scene pay, in units of an encoding
without training."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Settings without anything open, the time for them, and a note of what the user may not expect."""

    settings: Settings
    time: SearchTime | None = None
    note: str = ""


def resolved(settings: Settings, views: Views | None, *, keep_all: bool = False, torch: bool | None = None) -> Settings:
    """Return the settings with what they leave open resolved, see :meth:`kissgs.Settings.resolved`. ``keep_all`` says
    that all Gaussians stay unless the settings request otherwise, ``torch`` whether it is installed."""
    if keep_all and settings.compact.auto_count is None:
        settings = settings.model_copy(update={"compact": settings.compact.model_copy(update={"auto_count": False})})
    photographs = None if views is None else views.has_photographs
    return settings.resolved(photographs=photographs, torch=has_torch() if torch is None else torch)


def choose(requested: Settings, views: Views | None, count: int, context: Context, *, keep_all: bool) -> Choice:
    """Choose what to do with ``count`` Gaussians until the deadline; the note also says where torch is missing."""
    chosen, time = {}, None
    if context.deadline is not None:
        time = SearchTime(context.deadline, encode_seconds(requested.preset, count, context.threads))
    for torch in {has_torch(), True}:
        settings = resolved(requested, views, keep_all=keep_all, torch=torch)
        chosen[torch] = in_time(requested, settings, time, count=count, captured=views is not None, torch=torch)
    found = chosen[has_torch()]
    if found.settings == chosen[True].settings:
        return found
    return Choice(found.settings, found.time, "; ".join(filter(None, [found.note, NOT_TRAINED])))


def in_time(
    requested: Settings, settings: Settings, time: SearchTime | None, *, count: int, captured: bool, torch: bool
) -> Choice:
    """Return the ``settings`` that were resolved as if there were time for everything, changed to fit into the time.
    Training that was not requested is left out where there is too little time for it, and the preset where even a plain
    encoding takes too long, unless a goal or a setting of the encoder is given. Without a goal and a capture, time that
    is left goes to fine-tuning on renderings of the scene."""
    if time is None:
        return Choice(settings)
    plain, left = time.encode_seconds, time.deadline.seconds
    if left >= TRAINING_TIME * plain and count > 1:
        tunes = requested.time_only and not captured and settings.finetune.enabled is None
        if tunes and torch and left >= TUNING_TIME * plain:
            settings = settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": True})})
        return Choice(settings, time)
    trained = settings.compact.auto_count and not requested.compact.auto_count
    settings = requested.resolved(photographs=False, torch=False)
    note = TOO_LITTLE_TIME if trained and count > 1 else ""
    if note and not settings.encode.has_goal:
        note += ", so nothing limits the loss but the preset"
    usual = Settings.from_preset(settings.preset, seed=settings.encode.seed).encode
    takes = plain * (CAPTURE_TIME if captured and settings.encode.rate_distortion else 1.0)
    if left >= takes or settings.preset == Preset.FAST or settings.encode != usual or settings.finetune.enabled:
        return Choice(settings, time, note)
    fast = Settings.from_preset(Preset.FAST, time_limit=settings.time_limit, seed=settings.encode.seed)
    return Choice(fast, time, f"encoded with the preset fast: {settings.preset} would take about {takes:.0f} s")
