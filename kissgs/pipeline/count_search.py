"""Search for the number of Gaussians that serves a goal best: fewer with fine levels, or more with coarse ones."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from kissgs.compaction.result import CountTrial
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.root_finding import minimize_unimodal
from kissgs.core.splats import Splats
from kissgs.evaluation.psnr_loss import drop_of
from kissgs.pipeline.goal import Goal
from kissgs.pipeline.rate_control import RateControl
from kissgs.pipeline.trial import Trial
from kissgs.sogxt.container import stored_sizes

if TYPE_CHECKING:
    from kissgs.compaction.budget import Compactor
    from kissgs.compaction.result import Compacted
    from kissgs.pipeline.encoding import Encoding

BYTES_GROWTH = 1.4
"""Bytes per Gaussian expected after compaction, relative to the uncompacted scene; only for the first guess."""

QUALITY_START_LOG2 = -2.0
"""log2 of the share of the Gaussians that is tried first where the goal is no size."""

FIRST_STEP_LOG2 = {True: 0.5, False: 1.0}
"""First change of log2(count): True where the goal is a size."""


@dataclass(frozen=True, slots=True)
class CountCandidate:
    """The result for one number of Gaussians.

    Attributes:
        cost: to be minimised: minus the PSNR of the evaluation where the goal is a size, else the container's bytes;
            infinite if this count cannot meet the goal.
        search: the search that made the containers of this count; None if none was made.
        compacted: the compacted scene; None for the scene with all its Gaussians.
    """

    cost: float
    search: RateControl | None = None
    compacted: Compacted | None = None


@dataclass(slots=True, eq=False)
class CountSearch:
    """Compact the scene to several counts, and search for the best container of each.

    The uncompacted scene is encoded first; its size gives the first guess of a count. The compacted scene is evaluated
    before it is encoded, so that a count that already misses the goal costs no encoding.

    Attributes:
        encoding: encoding of the scene with all its Gaussians; fine-tuning follows after this search.
        compactor: compactor of the same scene.
        trials: all containers that were made, in order.
    """

    encoding: Encoding
    compactor: Compactor
    trials: list[Trial] = field(default_factory=list)
    _tried: list[CountTrial] = field(default_factory=list)
    _candidates: dict[int, CountCandidate] = field(default_factory=dict)
    _full_search: RateControl | None = None
    _stopped: bool = False

    def run(self) -> tuple[Compacted, RateControl, tuple[Trial, ...]]:
        """Return the compacted scene that serves the goal best, the search that made its container, and all trials.

        Raises:
            UnsupportedError: no count meets the goal.
        """
        from kissgs.compaction.budget import unchanged

        splats, log2_all = self.compactor.splats, math.log2(len(self.compactor.splats))
        try:
            uncompacted = self._candidates[len(splats)] = self._encode(splats, None)
            self._full_search = uncompacted.search
            if not (self._stopped or self._keeps_all(uncompacted)):
                by_size = self.goal.by_size
                start = log2_all + (min(self._first_guess(), 0.0) if by_size else QUALITY_START_LOG2)
                feasible_side = -1.0 if by_size else 1.0  # fewer Gaussians take fewer bytes, more have a higher PSNR
                attempts = self.encoding.settings.compact.max_compactions
                known, step = {log2_all: uncompacted.cost}, FIRST_STEP_LOG2[by_size]
                minimize_unimodal(self._cost, known, start, step, (0.0, log2_all), feasible_side, attempts)
        except StopSearch:
            if all(math.isinf(candidate.cost) for candidate in self._candidates.values()):
                raise
            self._stopped = True
        best = self._candidates[min(self._candidates, key=lambda count: (self._candidates[count].cost, count))]
        if best.search is None or best.search.best is None:
            raise UnsupportedError(self.goal.failure_message(self.trials, suggest_compaction=False))
        best.search.stopped |= self._stopped
        compacted = best.compacted or unchanged(splats, self._reason_to_keep_all())
        notes = filter(None, [compacted.report.note, self.compactor.note])
        report = replace(compacted.report, trials=tuple(self._tried), note="; ".join(notes))
        return replace(compacted, report=report), best.search, tuple(self.trials)

    @property
    def goal(self) -> Goal:
        """The goal that the settings name."""
        return Goal.of(self.encoding.settings.encode)

    def _keeps_all(self, uncompacted: CountCandidate) -> bool:
        """Whether no smaller count needs to be tried.

        Without a target size: if even all Gaussians miss the goal. With one: if all of them fit at the preset's own
        quality, or if the files that are no images already exceed the target.
        """
        target_size = self.encoding.settings.encode.target_size
        if target_size is None or self._full_search is None:
            return math.isinf(uncompacted.cost)
        return self.trials[0].bytes <= target_size or self._full_search.overhead >= target_size

    def _reason_to_keep_all(self) -> str:
        if self._tried:
            return "and none of the smaller counts tried serves the goal better"
        if self._stopped:
            return "and the search was stopped before a smaller count was tried"
        return "and all of them fit into the target size"

    def _first_guess(self) -> float:
        """Return log2 of the share of the Gaussians that may fit into the target size at the preset's own quality."""
        target_size = self.encoding.settings.encode.target_size or 1
        overhead = 0 if self._full_search is None else self._full_search.overhead
        available, used = target_size - overhead, self.trials[0].bytes - overhead
        return math.log2(max(available, 1) / (BYTES_GROWTH * used))

    def _cost(self, x: float) -> float:
        splats = self.compactor.splats
        count = min(max(1, round(2**x)), len(splats) - 1)
        if self._stopped:
            return math.inf
        if count in self._candidates:
            return self._candidates[count].cost
        self.encoding.progress.note = f"{count:,} Gaussians"
        compacted = self.compactor(count)
        evaluation = self.compactor.evaluate(compacted)
        trial = self.goal.measured(Trial(count, None, 0), evaluation)
        limit = self.goal.decisive(trial)
        ssim_decides = limit.setting == "max_ssim_drop"
        self._tried.append(CountTrial(count, drop_of(evaluation), trial.ssim_drop, ssim_decides))
        infeasible = not self.goal.by_size and limit.room(trial) < 0
        candidate = (
            CountCandidate(math.inf, None, compacted) if infeasible else self._encode(compacted.splats, compacted)
        )
        self._candidates[count] = candidate
        return candidate.cost

    def _encode(self, splats: Splats, compacted: Compacted | None) -> CountCandidate:
        cache = self.encoding.cache if compacted is None else None
        search = replace(self.encoding, splats=splats, cache=cache).search(byte_limit=self._best_bytes())
        self._stopped = search.stopped
        self.trials += search.trials
        if search.best is None:
            return CountCandidate(math.inf, search, compacted)
        encoded = search.best.encoded
        if not search.goal.by_size:
            return CountCandidate(stored_sizes(encoded.files, packed=self.encoding.packed)[0], search, compacted)
        try:
            psnr = search.evaluate(encoded).mean.candidate.psnr
        except StopSearch:  # raised only once, when the evaluation began
            self._stopped, psnr = True, search.evaluate(encoded).mean.candidate.psnr
        return CountCandidate(-min(psnr, 1e3), search, compacted)

    def _best_bytes(self) -> float:
        """Return the bytes of the best container so far; infinite where bytes are not the cost."""
        if self.goal.by_size:
            return math.inf
        return min((candidate.cost for candidate in self._candidates.values()), default=math.inf)
