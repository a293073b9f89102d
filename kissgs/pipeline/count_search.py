"""How many Gaussians serve a goal best: fewer ones, stored finely, or more, stored coarsely."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.root_finding import minimize_unimodal
from kissgs.core.splats import Splats
from kissgs.evaluation.psnr_loss import drop_of, psnr_of
from kissgs.pipeline.rate_control import Goal, RateControl
from kissgs.pipeline.trial import Trial
from kissgs.sogxt.container import stored_sizes

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.pipeline.encoding import Encoding

FINELY = 1.4
"""Bytes that a Gaussian is worth where there are few, in those that it takes where all stay: the first guess."""

FEW = -2.0
"""Of which share to begin with where a loss is given, or a PSNR; a power of 2."""

STEPS = {True: 0.5, False: 1.0}
"""By which counts change at first, as powers of 2: for a size, and for what pictures lose."""


@dataclass(frozen=True, slots=True)
class CountCandidate:
    """What came of one count.

    Attributes:
        cost: what is to be small: of containers of a wanted size minus the PSNR to what judges them, else the bytes;
            infinite where the goal cannot be met.
        search: in which the best container was found.
        compacted: the scene that is in it; None for the scene with all its Gaussians.
    """

    cost: float
    search: RateControl | None = None
    compacted: Compacted | None = None


@dataclass(slots=True, eq=False)
class CountSearch:
    """Compacts to several counts, and encodes each towards the goal.

    The first guess follows from one encoding of the scene as it is. Pictures are drawn to confirm: of what compaction
    has left, which tells whether it is worth encoding, and of the container.

    Attributes:
        encoding: of the scene with all its Gaussians; fine-tuning is left for later.
        compactor: of the same scene.
        trials: containers that were made.
    """

    encoding: Encoding
    compactor: Compactor
    trials: list[Trial] = field(default_factory=list)
    _drops: dict[int, float] = field(default_factory=dict)
    _offers: dict[int, CountCandidate] = field(default_factory=dict)
    _whole: RateControl | None = None
    _stopped: bool = False

    def run(self) -> tuple[Compacted, RateControl, tuple[Trial, ...]]:
        """The scene that serves the goal best, the search for its container, and the way to it.

        Raises:
            UnsupportedError: no count meets the goal.
        """
        from kissgs.compaction.budget import unchanged

        splats, most = self.compactor.splats, math.log2(len(self.compactor.splats))
        try:
            whole = self._offers[len(splats)] = self._encode(splats, None)
            self._whole = whole.search
            if not (self._stopped or self._settled(whole)):
                by_size = self.goal.by_size
                start = most + (min(self._guess(), 0.0) if by_size else FEW)
                way_out = -1.0 if by_size else 1.0  # fewer Gaussians are smaller, more are better
                attempts = self.encoding.settings.compact.max_compactions
                minimize_unimodal(self._cost, {most: whole.cost}, start, STEPS[by_size], (0.0, most), way_out, attempts)
        except StopSearch:
            if all(math.isinf(offer.cost) for offer in self._offers.values()):
                raise
            self._stopped = True
        best = self._offers[min(self._offers, key=lambda count: (self._offers[count].cost, count))]
        if best.search is None or best.search.best is None:
            raise UnsupportedError(self.goal.failure_message(self.trials, fewer=False))
        best.search.stopped |= self._stopped
        compacted = best.compacted or unchanged(splats, self._why_all_stay())
        notes = filter(None, [compacted.report.note, self.compactor.note])
        report = replace(compacted.report, trials=tuple(self._drops.items()), note="; ".join(notes))
        return replace(compacted, report=report), best.search, tuple(self.trials)

    @property
    def goal(self) -> Goal:
        """Of the settings."""
        return Goal.of(self.encoding.settings.encode)

    def _settled(self, whole: CountCandidate) -> bool:
        """Whether fewer Gaussians need not be tried.

        All of them have room enough as they are stored where no size is asked for, or not even they are good enough, or
        what is no image takes all the room.
        """
        wanted = self.encoding.settings.encode.target_size
        if wanted is None or self._whole is None:
            return math.isinf(whole.cost)
        return self.trials[0].bytes <= wanted or self._whole.overhead >= wanted

    def _why_all_stay(self) -> str:
        if self._drops:
            return "and no smaller number that was tried serves the goal better"
        if self._stopped:
            return "and the search was ended before fewer were tried"
        return "and there is room for all of them"

    def _guess(self) -> float:
        """Of the share of the Gaussians; a power of 2."""
        wanted = self.encoding.settings.encode.target_size or 1
        overhead = 0 if self._whole is None else self._whole.overhead
        room, taken = wanted - overhead, self.trials[0].bytes - overhead
        return math.log2(max(room, 1) / (FINELY * taken))

    def _cost(self, x: float) -> float:
        splats = self.compactor.splats
        count = min(max(1, round(2**x)), len(splats) - 1)
        if self._stopped:
            return math.inf
        if count in self._offers:
            return self._offers[count].cost
        self.encoding.progress.note = f"{count:,} Gaussians"
        found = self.compactor(count)
        seen = self.compactor.pictures(found)
        self._drops[count] = drop_of(seen)
        wanted = self.encoding.settings.encode
        hopeless = wanted.max_psnr_drop is not None and self._drops[count] > wanted.max_psnr_drop
        hopeless |= wanted.psnr is not None and psnr_of(seen) < wanted.psnr
        offer = CountCandidate(math.inf, None, found) if hopeless else self._encode(found.splats, found)
        self._offers[count] = offer
        return offer.cost

    def _encode(self, splats: Splats, compacted: Compacted | None) -> CountCandidate:
        cache = self.encoding.cache if compacted is None else None
        search = replace(self.encoding, splats=splats, cache=cache).search(limit=self._least())
        self._stopped = search.stopped
        self.trials += search.trials
        if search.best is None:
            return CountCandidate(math.inf, search, compacted)
        encoded = search.best.encoded
        if not search.goal.by_size:
            return CountCandidate(stored_sizes(encoded.files, packed=self.encoding.packed)[0], search, compacted)
        try:
            psnr = search.pictures(encoded).mean.candidate.psnr
        except StopSearch:  # as it began
            self._stopped, psnr = True, search.pictures(encoded).mean.candidate.psnr
        return CountCandidate(-min(psnr, 1e3), search, compacted)

    def _least(self) -> float:
        """Bytes of the best offer, where these are the cost."""
        return math.inf if self.goal.by_size else min((offer.cost for offer in self._offers.values()), default=math.inf)
