"""How many Gaussians serve a goal best: fewer ones, stored finely, or more, stored coarsely."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.errors import Enough, UnsupportedError
from kissgs.goal import Container, Goal
from kissgs.search import Trial, lowest
from kissgs.sogxt.container import zip_bytes
from kissgs.splats import Splats

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.encoding import Encoding

FINELY = 1.4
"""Bytes that a Gaussian is worth where there are few, in those that it takes where all stay: the first guess."""

FEW = -2.0
"""Of which share to begin with where a loss is given, or a PSNR; a power of 2."""

STEPS = {True: 0.5, False: 1.0}
"""By which counts change at first, as powers of 2: for a size, and for what pictures lose."""


@dataclass(frozen=True, slots=True)
class Offer:
    """What came of one count.

    Attributes:
        cost: what is to be small: of containers of a wanted size minus the PSNR to what judges them, else the bytes;
            infinite where the goal cannot be met.
        container: the best.
        compacted: the scene that is in it; None for the scene with all its Gaussians.
    """

    cost: float
    container: Container | None = None
    compacted: Compacted | None = None


@dataclass(slots=True, eq=False)
class Tradeoff:
    """Compacts to several counts, and encodes each towards the goal.

    The first guess follows from one encoding of the scene as it is. Pictures are drawn to confirm: of what compaction
    has left, which tells whether it is worth encoding, and of the container.

    Attributes:
        encoding: of the scene with all its Gaussians; what is said there of fine-tuning is left for later.
        compactor: of the same scene.
        trials: containers that were made.
    """

    encoding: Encoding
    compactor: Compactor
    trials: list[Trial] = field(default_factory=list)
    _drops: dict[int, float] = field(default_factory=dict)
    _offers: dict[float, Offer] = field(default_factory=dict)
    _overhead: int = 0
    _stopped: bool = False

    def run(self) -> tuple[Compacted, Container | None, tuple[Trial, ...]]:
        """The scene that serves the goal best, its container, and the way to it.

        The container is None where it is still to be fine-tuned.

        Raises:
            UnsupportedError: no count meets the goal.
        """
        from kissgs.compaction.budget import unchanged

        splats, most = self.compactor.splats, math.log2(len(self.compactor.splats))
        by_size = self.goal.by_size
        try:
            self._offers[most] = whole = self._encode(splats, None)
            if not (self._roomy() if by_size else math.isinf(whole.cost)):
                known = {most: whole.cost}
                start = most + (min(self._guess(), 0.0) if by_size else FEW)
                attempts = self.encoding.settings.compact.attempts
                way_out = -1.0 if by_size else 1.0  # fewer Gaussians are smaller, more are better
                lowest(self._cost, known, start, STEPS[by_size], (0.0, most), way_out, attempts)
        except Enough:
            if all(offer.container is None for offer in self._offers.values()):
                raise
            self._stopped = True
        best = min(self._offers, key=lambda x: (self._offers[x].cost, x))
        offer = self._offers[best]
        if offer.container is None:
            raise UnsupportedError(self.goal.regret(self.trials, all_stay=False))
        tried = "and no smaller number that was tried serves the goal better"
        compacted = offer.compacted or unchanged(splats, tried if self._drops else "and there is room for all of them")
        notes = filter(None, [compacted.report.note, self.compactor.note])
        report = replace(compacted.report, trials=tuple(self._drops.items()), note="; ".join(notes))
        tunes = self.encoding.settings.finetune.wanted and not self._stopped
        return replace(compacted, report=report), None if tunes else offer.container, tuple(self.trials)

    @property
    def goal(self) -> Goal:
        """Of the settings."""
        return Goal.of(self.encoding.settings.encode)

    def _roomy(self) -> bool:
        """Whether all Gaussians have room enough as they are stored where no size is asked for."""
        wanted = self.encoding.settings.encode.target_size
        return wanted is not None and bool(self.trials) and self.trials[0].bytes <= wanted

    def _guess(self) -> float:
        """Of the share of the Gaussians; a power of 2."""
        wanted = self.encoding.settings.encode.target_size or 1
        room, taken = wanted - self._overhead, self.trials[0].bytes - self._overhead
        return math.log2(max(room, 1) / (FINELY * taken))

    def _cost(self, x: float) -> float:
        splats = self.compactor.splats
        count = min(max(1, round(2**x)), len(splats) - 1)
        if self._stopped or count in self._drops:
            return math.inf
        self.encoding.progress.note = f"{count:,} Gaussians"
        found = self.compactor(count)
        drop = self._drops[count] = self.compactor.drop(found)
        allowed = self.encoding.settings.encode.max_psnr_drop
        hopeless = allowed is not None and drop > allowed
        offer = Offer(math.inf, None, found) if hopeless else self._encode(found.splats, found)
        self._offers[x] = offer
        return offer.cost

    def _encode(self, splats: Splats, compacted: Compacted | None) -> Offer:
        cache = self.encoding.cache if compacted is None else None
        encoding = replace(self.encoding, splats=splats, cache=cache)
        search = encoding.search()
        self._stopped = search.stopped
        self.trials += search.trials
        self._overhead = search.overhead
        if search.best is None:
            return Offer(math.inf, None, compacted)
        encoded = search.best.encoded
        if not search.goal.by_size:
            return Offer(len(zip_bytes(encoded.files)), search.best, compacted)
        psnr = search.pictures(encoded).mean.candidate.psnr
        return Offer(-min(psnr, 1e3), search.best, compacted)
