"""Time of a search: expected on this machine, divided among training and containers, and what a limit allows."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

from kissgs.core.errors import OutputError
from kissgs.core.progress import Deadline
from kissgs.core.resources import processors
from kissgs.io.files import atomic_file, reason_of
from kissgs.settings import Preset, Settings

# Expected time of an encoding on this machine, from its speed as ``kissgs warmup`` has measured it.

ENCODE_SECONDS = {
    Preset.FAST: (0.5, 0.0, 6e-6),
    Preset.BALANCED: (1.5, 5.0, 40e-6),
    Preset.SMALL: (1.5, 5.0, 80e-6),
    Preset.PAPER: (1.0, 0.0, 140e-6),
}
"""Seconds of an encoding by preset, measured on two processors: a fixed part; one that all scenes of more than
:data:`FULL_RENDERINGS` Gaussians have, for renderings; one per Gaussian."""

FULL_RENDERINGS = 20_000
"""Number of Gaussians from which renderings take about the same time; with fewer, they take in proportion less."""

SPEEDS = (1e-3, 1e3)
"""Slowest and fastest speed of a processor that is believed, in units of :func:`save_speed`."""

REFERENCE_PROCESSORS, MOST_PROCESSORS = 2, 8
"""Processors of that machine, and the number beyond which an encoding is taken to become no faster."""


def encode_seconds(preset: Preset, count: int, threads: int = 0) -> float:
    """Return the expected wall time of an encoding of ``count`` Gaussians without training, seconds.

    ``threads`` is the number of threads; 0 means one per processor.
    """
    used = min(threads or processors(), processors(), MOST_PROCESSORS)
    return _reference_seconds(preset, count) / (_speed_per_processor() * used)


def _reference_seconds(preset: Preset, count: int) -> float:
    fixed, renderings, each = ENCODE_SECONDS[preset]
    return fixed + renderings * min(count / FULL_RENDERINGS, 1.0) + each * count


def save_speed(seconds: float, preset: Preset, count: int) -> None:
    """Save the speed of this machine, which encoded ``count`` Gaussians in ``seconds`` with all its processors.

    Raises:
        OutputError: the file cannot be written.
    """
    speed = _reference_seconds(preset, count) / seconds
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


# ``SearchTime``: how a search that trains divides its time among training and containers.

CONTAINER_SHARE, LAST_CONTAINER_SHARE = 2.0, 4.0
"""Time to fine-tune a container, in units of that to train one point of the path; the second for the last container,
which is the only one where time is short."""

ENDING_SHARE = 0.38
"""Time to write a fine-tuned container and to evaluate it in small images, in units of an encoding without training."""

LEAST_FOR_CONTAINER = 2.0
"""Time below which another container is not begun, in the same unit."""

CAPTURE_TIME = 1.5
"""Time of an encoding with a capture, whose images colours are refitted to, in the same unit."""

SCORE_SHARE, SCORING_SHARE = 0.004, 0.15
"""Time to score the Gaussians in one view, in the same unit, and the share of the time that all scoring shall take."""

LEAST_SCORING_VIEWS = 16
"""Number of views that score in any case."""

RECOVERABLE_DB = 1.5
"""Loss of PSNR at the end of a short training path, decibels beyond the one that is allowed, from which fine-tuning
is not expected to recover (docs/method/research-log.md, "Large scenes in a limited time")."""

FIRST_NUMBER, TRAINED_OFFSET_DB = 6, 4.0
"""Number of the point of the first container for a loss of 0.1 dB, a quarter of the Gaussians, and decibels added to
``quality_offset_db`` there; :func:`kissgs.pipeline.trained_search.first_position` changes both for other goals.

5 dB instead of 4 take 4 % more bytes and rarely save a second container. A search for a small loss that began with a
fifth of the Gaussians ended, for a scene of 300, with more bytes than the encoder alone takes.
"""


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """Containers and training of a search.

    Attributes:
        containers: number of containers.
        number: number of the point of the path that is tried first for a loss of 0.1 dB.
        offset_db: added to ``quality_offset_db`` there, decibels.
    """

    containers: int
    number: int = FIRST_NUMBER
    offset_db: float = TRAINED_OFFSET_DB


AIMING = (
    (4.2, SearchPlan(1, 4, 3.0)),
    (8.0, SearchPlan(1, 5, 3.0)),
    (16.0, SearchPlan(1)),
    (40.0, SearchPlan(2)),
    (math.inf, SearchPlan(3)),
)
"""Plans where the goal is no more than an aim, each up to a time in units of an encoding without training.

With fewer Gaussians, training that is too short loses more than they save.
"""

MEETING = (
    (4.2, SearchPlan(1, 2, 3.0)),
    (8.5, SearchPlan(1, 4, 3.0)),
    (40.0, SearchPlan(2, 5, 3.0)),
    (math.inf, SearchPlan(3)),
)
"""Plans where the goal must be met: a single container needs a reserve, two can come near it."""

RENDERED = (
    (15.0, SearchPlan(0)),
    (30.0, SearchPlan(1)),
    (60.0, SearchPlan(2)),
    (math.inf, SearchPlan(3)),
)
"""Plans where renderings of the scene are the targets: number and lambda follow from a search of the encoder."""


@dataclass(frozen=True, slots=True)
class SearchTime:
    """The time of a search.

    Attributes:
        deadline: time until which the best container shall be ready.
        encode_seconds: expected seconds of an encoding of the whole scene without training.
    """

    deadline: Deadline
    encode_seconds: float

    @property
    def over(self) -> bool:
        """Whether no time is left for another container."""
        return self.deadline.seconds < LEAST_FOR_CONTAINER * self.encode_seconds

    @property
    def over_for_encoding(self) -> bool:
        """Whether no time is left for another container without training."""
        return self.deadline.seconds < CAPTURE_TIME * self.encode_seconds

    @property
    def ending_seconds(self) -> float:
        """Expected seconds to write a fine-tuned container and to evaluate it in small images."""
        return ENDING_SHARE * self.encode_seconds

    def plan(self, *, photographs: bool, aims: bool) -> SearchPlan:
        """Return what to do in the time that is left.

        Args:
            photographs: whether photographs are the targets of the training.
            aims: whether the goal is no more than an aim.
        """
        left = self.deadline.seconds / self.encode_seconds
        plans = RENDERED if not photographs else AIMING if aims else MEETING
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


# Choice of what a limited time is used for: training, the preset, or the fastest preset.

TRAINING_TIME = 3.5
"""Time from which training on photographs pays, in units of an encoding without training."""

TUNING_TIME = 5.0
"""Time from which fine-tuning on renderings of the scene pays, in the same unit."""

TOO_LITTLE_TIME = "there was too little time for training"
"""Note where training is left out."""


@dataclass(frozen=True, slots=True)
class TimePlan:
    """How a limited time is used.

    Attributes:
        settings: settings that fit into the time.
        time: the time, for a search that trains; None for no limit.
        note: what the user may not expect; empty if there is nothing to say.
    """

    settings: Settings
    time: SearchTime | None = None
    note: str = ""


def time_plan(
    requested: Settings,
    settings: Settings,
    count: int,
    deadline: Deadline | None,
    *,
    captured: bool,
    torch: bool,
    threads: int,
) -> TimePlan:
    """Choose what to do in the time that is left for a scene.

    Training that was not requested is left out where there is too little time for it, and the preset where even a
    plain encoding takes too long, unless a goal or a setting of the encoder is given. Without a goal and a capture,
    time that is left goes to fine-tuning on renderings of the scene.

    Args:
        requested: settings as requested.
        settings: the same with what they leave open decided, as if there were time for everything.
        count: number of Gaussians.
        deadline: time until which the container shall be ready; None for no limit.
        captured: whether there is a capture.
        torch: whether torch is installed, which training needs.
        threads: number of threads; 0 means one per processor.
    """
    if deadline is None:
        return TimePlan(settings)
    plain, left = encode_seconds(settings.preset, count, threads), deadline.seconds
    time = SearchTime(deadline, plain)
    if left >= TRAINING_TIME * plain and count > 1:
        tunes = requested.aims and not captured and settings.finetune.enabled is None
        if tunes and torch and left >= TUNING_TIME * plain:
            settings = settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": True})})
        return TimePlan(settings, time)
    trained = settings.compact.auto_count and not requested.compact.auto_count
    settings = requested.decided(photographs=False, torch=False)
    note = TOO_LITTLE_TIME if trained and count > 1 else ""
    if note and not settings.encode.has_goal:
        note += ", so nothing limits the loss but the preset"
    usual = Settings.from_preset(settings.preset, seed=settings.encode.seed).encode
    takes = plain * (CAPTURE_TIME if captured and settings.encode.rate_distortion else 1.0)
    if left >= takes or settings.preset == Preset.FAST or settings.encode != usual or settings.finetune.enabled:
        return TimePlan(settings, time, note)
    fast = Settings.from_preset(Preset.FAST, time_limit=settings.time_limit, seed=settings.encode.seed)
    return TimePlan(fast, time, f"encoded with the preset fast: {settings.preset} would take about {takes:.0f} s")
