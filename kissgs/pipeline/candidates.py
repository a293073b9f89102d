"""``Candidates``: the best container of searches at several numbers of Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from kissgs.core.errors import StopSearch
from kissgs.evaluation.psnr_loss import drop_of
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.rate_control import Container, RateControl
from kissgs.sogxt.container import stored_sizes

if TYPE_CHECKING:
    from kissgs.compaction.result import Compacted


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
