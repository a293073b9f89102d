"""``SearchTime``: how a search that trains divides its time among training and containers."""

from __future__ import annotations

from dataclasses import dataclass

from kissgs.core.deadline import Deadline

CONTAINER_SHARE = 4.0
"""Time to fine-tune a container, in units of that to train one point of the path."""

TWO_CONTAINERS, THREE_CONTAINERS = 8.5, 25.0
"""Times from which a second and a third container are worth their time, in units of an encoding without training."""


ENDING_SHARE = 0.38
"""Time to write a fine-tuned container and to evaluate it, in units of an encoding without training."""

FULL_TRAINING = 4.2
"""Time below which fewer Gaussians lose more by too short a training than they save, in the same unit."""

LEAST_FOR_CONTAINER = 2.0
"""Time below which another container is not begun, in the same unit."""


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
    def short(self) -> bool:
        """Whether there is too little time to train as few Gaussians as serve a goal best."""
        return self.deadline.seconds < FULL_TRAINING * self.encode_seconds

    @property
    def ending_seconds(self) -> float:
        """Expected seconds to write a fine-tuned container and to evaluate it."""
        return ENDING_SHARE * self.encode_seconds

    def containers(self, most: int) -> int:
        """Return how many containers to make in the time that is left, from 1 to ``most``."""
        left = self.deadline.seconds / self.encode_seconds
        return min(1 + (left > TWO_CONTAINERS) + (left > THREE_CONTAINERS), most)

    def for_point(self, points: int, containers: int) -> Deadline:
        """Return the deadline for training the next of so many points, before so many containers."""
        left = self.deadline.seconds - containers * self.encode_seconds
        return Deadline.after(max(left, 0.0) / (points + CONTAINER_SHARE * containers))

    def for_container(self, containers: int) -> Deadline:
        """Return the deadline of the next of so many containers."""
        return Deadline.after(max(self.deadline.seconds, 0.0) / containers)
