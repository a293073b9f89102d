"""``SearchTime``: how a search that trains divides its time among training and containers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kissgs.core.deadline import Deadline

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
