"""A limited time: how long encodings take, and how the time is divided among training and containers."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

from kissgs.core.context import Deadline
from kissgs.core.errors import OutputError
from kissgs.core.resources import processors
from kissgs.io.files import atomic_file, reason_of
from kissgs.settings import Preset

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
    used = min(threads or processors(), processors(), MOST_PROCESSORS)
    return _reference_seconds(preset, count) / (_speed_per_processor() * used)


def _reference_seconds(preset: Preset, count: int) -> float:
    fixed, renderings, each = ENCODE_SECONDS[preset]
    return fixed + renderings * min(count / FULL_RENDERINGS, 1.0) + each * count


def save_speed(seconds: float, preset: Preset, count: int) -> None:
    """Save the speed of this machine, which encoded ``count`` Gaussians in ``seconds`` with all its processors."""
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
