"""Rate control: search for the lambda whose container meets a goal."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import Deadline, SearchNote
from kissgs.core.root_finding import StopRule, find_root
from kissgs.core.splats import MAX_GAUSSIANS, Splats
from kissgs.evaluation.results import ESTIMATED_DROP
from kissgs.finetuning.result import FinetuneReport
from kissgs.io.scene_format import ReadOptions
from kissgs.pipeline.goal import Goal, Limit, Trial
from kissgs.pipeline.scene_files import read_scene
from kissgs.planning.encoding_plan import Encoded
from kissgs.planning.sh_codebook import COEFFICIENTS, codebook_side
from kissgs.settings import GOALS, EncodeSettings
from kissgs.sogxt.container import stored_sizes

if TYPE_CHECKING:
    from kissgs.compaction.budget import SearchEvaluation
    from kissgs.evaluation.results import Evaluation

LOG2_LAMBDA_RANGE = (-70.0, -6.0)
"""log2 of the smallest and the largest lambda that the search tries: the finest and the coarsest container."""

MIN_STEP_LOG2 = 1 / 32
"""Below this interval of log2(lambda), a jump of the size is taken for a discontinuity and not searched further."""

FAR_BELOW_LOG2 = 1.5
"""Room for growth of the first container's images (log2 of bytes) above which the finest container is tried next.

The finest container takes longest to make, and rarely has more than three times the bytes of the first.
"""

PLANE_CHANNELS = 21
"""Bytes per cell of all grid images before compression: mask 1, means 6, opacity 1, scales 3, quaternions 4, base
colour 3, codebook labels 3."""

WEBP_EXPANSION = 1.1
"""Generous bound of lossless WebP: bytes of an image in units of its channels times its pixels, beyond small images."""

NOT_FINETUNED = "no fine-tuned container meets the goal better: this one is not fine-tuned"


@dataclass(frozen=True, slots=True)
class Container:
    """A container in memory.

    Attributes:
        encoded: its files, with the report of the encoder.
        settings: the settings that it was made with.
        finetuning: report of its fine-tuning; None without fine-tuning.
        note: a fact that may surprise the user; empty if there is none.
    """

    encoded: Encoded
    settings: EncodeSettings
    finetuning: FinetuneReport | None = None
    note: str = ""


Encoder = Callable[[EncodeSettings], Container]


class RateControl:
    """Search for the lambda at which a container just meets the goal of the settings.

    Of the containers that meet the goal, the best is the largest if the goal is a size, else the smallest. Of
    fine-tuned containers for a size, the best has the highest PSNR in the evaluation views of fine-tuning.

    Attributes:
        goal: goal of the settings.
        settings: settings of the containers: those given, with another codebook size where the goal needs it.
        trials: all containers made so far.
        best: best container so far; None if none meets the goal.
        closest: of the containers that miss the goal, the one with the least distance to it; None if there is none.
        stopped: whether the search was stopped from outside (:class:`kissgs.StopSearch`).
        cannot_improve: whether ``byte_limit`` was reached.
        overhead: bytes of the latest container that are no images.
    """

    def __init__(
        self,
        original: Splats,
        settings: EncodeSettings,
        compare: SearchEvaluation,
        threads: int,
        progress: SearchNote,
        *,
        count: int | None = None,
        packed: bool = True,
        byte_limit: float = math.inf,
        deadline: Deadline | None = None,
        trained: bool = False,
    ) -> None:
        """Prepare the search; nothing is encoded yet.

        Args:
            original: reference scene of the evaluation.
            settings: settings with a goal.
            compare: compares a decoded container with ``original``.
            threads: number of threads; 0 means one per processor.
            progress: receives events; its note is set to the latest trial.
            count: number of Gaussians of the scene that is encoded, if it is not ``original``.
            packed: whether the files become a zip, whose size then counts; False for a folder.
            byte_limit: for a goal that is no size: the search ends if a container of this size or more misses the goal.
            deadline: once a container meets the goal, no other one is begun that would not be finished by then.
            trained: whether each container takes a training. Then one that is less near the goal ends the search, and
                the finest or coarsest one is not tried where all others missed the goal.
        """
        self.original, self.settings, self.goal = original, settings, Goal.of(settings)
        self.compare, self.threads, self.progress = compare, threads, progress
        self.count = len(original) if count is None else count
        self.packed, self.byte_limit = packed, byte_limit
        self.trials: list[Trial] = []
        self.best: Container | None = None
        self.closest: Container | None = None
        self.stopped = self.cannot_improve = False
        self.overhead = 0
        self._bytes = 0
        self._samples: dict[float, _Sample] = {}
        self._finest: tuple[EncodeSettings, _Sample] | None = None
        self._jump: tuple[float, int] | None = None
        self._psnr: float | None = None
        self._finetuning: FinetuneReport | None = None
        self._against_renderings = False
        self._distance, self._trained = -math.inf, trained
        self._deadline, self._begun, self._longest = deadline, time.perf_counter(), 0.0

    def search_all(self, encoder: Encoder) -> None:
        """Search with up to ``max_encodes`` containers; change the codebook size if lambda alone cannot meet the goal.

        The codebook size is limited by ``gaussians_per_codebook_entry`` to save time, and its side is a multiple of 8.
        So the goal may lie beyond that limit, or between the containers of two sides.
        If the first container is far below the target size, the second one is the finest; the search ends if it fits.
        """
        self.run(encoder)
        if self._samples and self._short and self._is_codebook_limited(self.settings):
            largest = max(sample.side for sample in self._samples.values())
            coarsest = max(x for x, sample in self._samples.items() if sample.side == largest)
            self._samples = {x: sample for x, sample in self._samples.items() if sample.side < largest}
            self._search_again(encoder, 2.0**coarsest, gaussians_per_codebook_entry=1.0)
        if self._jump is not None:
            rd_lambda, side = self._jump
            self._samples = {x: sample for x, sample in self._samples.items() if sample.side <= side}
            self._search_again(encoder, rd_lambda, sh_codebook_size=side**2)
        self._samples, self._finest = {}, None  # not comparable with fine-tuned containers
        if self.best is not None:
            used = self.best.settings
            self.settings = self.settings.model_copy(
                update={
                    "gaussians_per_codebook_entry": used.gaussians_per_codebook_entry,
                    "sh_codebook_size": used.sh_codebook_size,
                }
            )

    def _search_again(self, encoder: Encoder, rd_lambda: float, **changes: float) -> None:
        remaining = self.settings.max_encodes - len(self.trials)
        if remaining > 0 and not (self.stopped or self.cannot_improve):
            self.settings = self.settings.model_copy(update=changes)
            self.run(encoder, rd_lambda, remaining)

    @property
    def finetuned(self) -> bool:
        """Whether a container was fine-tuned."""
        return self._finetuning is not None

    @property
    def _short(self) -> bool:
        """Whether all samples are well below the target size, or all miss the quality goal."""
        margins = [sample.margin for sample in self._samples.values()]
        return min(margins) > self.goal.limits[0].near if self.goal.by_size else max(margins) < 0

    def make(self, encoder: Encoder, rd_lambda: float | None) -> None:
        """Make one container, at ``rd_lambda`` or as the settings say."""
        container = encoder(self.settings if rd_lambda is None else self._settings_at(rd_lambda))
        try:
            self._sample(container)
        except _CannotImprove:
            self.cannot_improve = True

    def run(self, encoder: Encoder, rd_lambda: float | None = None, attempts: int | None = None) -> None:
        """Make up to ``attempts`` containers, by default ``max_encodes``, the first at ``rd_lambda``."""
        try:
            self._run(encoder, rd_lambda, attempts or self.settings.max_encodes)
        except _CannotImprove:
            self.cannot_improve = True
        except StopSearch:
            if self.best is None:
                raise
            self.stopped = True
        finally:
            self.progress.note = ""

    def result(self, *, trained: Sequence[Trial] = (), suggest_compaction: bool = True) -> Container:
        """Return the best container; its reports say if fine-tuning was in vain, or if the target size is out of reach.

        ``trained`` are the trials of other numbers of Gaussians.

        Raises:
            UnsupportedError: no container meets the goal. With ``suggest_compaction``, the message may advise fewer
                Gaussians.
        """
        if self.best is None:
            suggest = suggest_compaction and self.count > 1 and self.overhead < (self.settings.target_size or 0)
            message = self.goal.failure_message(self.trials, trained, suggest_compaction=suggest)
            coarse = "" if self.closest is None else self.closest.encoded.coarse
            raise UnsupportedError("; ".join(filter(None, [message, coarse])))
        if self.goal.most_bytes is not None and self._bytes > self.goal.most_bytes:
            names = " and ".join(["target_size", *(limit.setting for limit in self.goal.limits)])
            verb = "were not met before the search was stopped" if self.stopped else "cannot be met together"
            raise UnsupportedError(
                f"{names} {verb}: the smallest container found with that quality has {self._bytes:,} bytes; allow at "
                f"least that{'' if self._deadline is None else ', or more time'}"
            )
        estimated = self.settings.max_psnr_drop is not None and self._against_renderings
        best = replace(self.best, note=ESTIMATED_DROP if estimated else self._surplus_note(self.best))
        if self._finetuning is None or best.finetuning is not None:
            return best
        return replace(best, finetuning=replace(self._finetuning, kept=False, note=NOT_FINETUNED))

    def _surplus_note(self, best: Container) -> str:
        """Say that the finest container of the scene is below the target size; empty if that is not the case."""
        target = self.settings.target_size if self.goal.by_size else None
        if target is None or best.encoded.rd_lambda != 2.0 ** LOG2_LAMBDA_RANGE[0]:
            return ""
        if self._is_codebook_limited(best.settings):
            return ""
        if math.log2(target / self._bytes) <= self.goal.limits[0].near:
            return ""
        return f"target_size {int(target):,} bytes is above the finest container of this scene: {self._bytes:,} bytes"

    def _run(self, encoder: Encoder, rd_lambda: float | None, attempts: int) -> None:
        first = self._encode(encoder, self.settings if rd_lambda is None else self._settings_at(rd_lambda))
        first_sample = self._sample(first)
        if first.encoded.rd_lambda is None:
            return
        if (
            rd_lambda is None
            and attempts > 1
            and first_sample.margin >= 0
            and self._is_far_below(self.trials[-1].bytes)
        ):
            if self._finest_fits(encoder):
                return
            attempts -= 1
        start = math.log2(first.encoded.rd_lambda)

        def margin_at(x: float) -> float:
            settings = self._settings_at(2.0**x)
            if x == start:
                sample = first_sample
            elif self._finest is not None and settings == self._finest[0]:
                sample = self._finest[1]
            else:
                sample = self._sample(self._encode(encoder, settings))
            self._samples[x] = sample
            return sample.margin

        find_root(
            margin_at,
            start,
            first_sample.limit.slope,
            lambda x: self._samples[x].limit.near_enough(trained=self._trained),
            LOG2_LAMBDA_RANGE,
            stop=StopRule(attempts, tries_bound=not self._trained, settled=self._is_jump),
            before={x: sample.margin for x, sample in self._samples.items()},
        )

    def _encode(self, encoder: Encoder, settings: EncodeSettings) -> Container:
        """Make a container.

        Raises:
            StopSearch: the search was stopped while a container was evaluated; or one that meets the goal exists, and
                another would not be finished before the deadline.
        """
        if self.stopped:
            raise StopSearch
        self._begun = time.perf_counter()
        met = self.best is not None and self._bytes <= (self.goal.most_bytes or math.inf)
        if self._deadline is not None and met and self._deadline.seconds < self._longest:
            raise StopSearch
        return encoder(settings)

    def _is_far_below(self, size: int) -> bool:
        """Whether the finest container may fit into the target size, given the bytes of the first container."""
        target = self.settings.target_size if self.goal.by_size else None
        if target is None:
            return False
        growth = (target - self.overhead) / max(size - self.overhead, 1)
        return growth >= 2**FAR_BELOW_LOG2 or target >= min(self._most_bytes(), self.original.nbytes)

    def _finest_fits(self, encoder: Encoder) -> bool:
        """Make the finest container, with the largest codebook, and return whether it fits into the target size."""
        limited = self._is_codebook_limited(self.settings)
        unlimited = self.settings.model_copy(update={"gaussians_per_codebook_entry": 1.0} if limited else {})
        settings = self._settings_at(2.0 ** LOG2_LAMBDA_RANGE[0], unlimited)
        sample = self._sample(self._encode(encoder, settings))
        if sample.margin < 0:
            self._finest = settings, sample
        return sample.margin >= 0

    def _is_codebook_limited(self, settings: EncodeSettings) -> bool:
        """Whether ``gaussians_per_codebook_entry`` may keep the codebook smaller than the goal allows."""
        return settings.gaussians_per_codebook_entry > 1 and self.original.sh_degree > 0

    def _most_bytes(self) -> float:
        """Return an upper bound of the size of any container of the scene: all images uncompressed, and the rest."""
        entries = min(self.settings.sh_codebook_size, self.count)
        codebook = 3 * COEFFICIENTS * codebook_side(entries) ** 2
        cells = (math.isqrt(self.count) + 9) ** 2  # the side of the grid is a multiple of 8
        return WEBP_EXPANSION * (PLANE_CHANNELS * cells + codebook) + 2 * self.overhead

    def _is_jump(self, inside: float, outside: float) -> bool:
        """Whether the size jumps between two values of log2(lambda), the last that fits and the next that does not.

        If it jumps because the codebook does, the search goes on with the smaller of the two codebooks at the finer
        lambda. Only for sizes: for a PSNR or a drop, the codebook that belongs to the finer lambda is the better one.
        """
        if not self.goal.by_size:
            return False
        one, other, gap = self._samples[inside], self._samples[outside], abs(inside - outside)
        smooth = gap * abs(one.limit.slope)
        jumps = gap < 1 and (smooth < one.limit.near or one.margin - other.margin > 2 * smooth)
        if jumps and one.side != other.side and self._finetuning is None:
            self._jump = 2.0 ** min(inside, outside), min(one.side, other.side)
            return True
        return gap < MIN_STEP_LOG2

    def _settings_at(self, rd_lambda: float, settings: EncodeSettings | None = None) -> EncodeSettings:
        no_goal = dict.fromkeys(GOALS)
        return EncodeSettings(**{**(settings or self.settings).model_dump(), **no_goal, "rd_lambda": rd_lambda})

    def _sample(self, container: Container) -> _Sample:
        """Record a container as a trial, and as the best if it is."""
        encoded = container.encoded
        size, sizes = stored_sizes(encoded.files, packed=self.packed)
        trial = Trial(self.count, encoded.rd_lambda, size)
        if not self.goal.by_size:
            evaluation = self._evaluation(encoded)
            trial = self.goal.measured(trial, evaluation)
            self._against_renderings = evaluation.against == "renderings"
        self.trials.append(trial)
        self.overhead = size - sum(stored for name, stored in sizes.items() if name.endswith(".webp"))
        self.progress.note = f"try {len(self.trials) + 1}, last: {trial.summary()}"
        limit = self.goal.decisive(trial)
        margin = limit.room(trial)
        if margin < 0 and (self.closest is None or margin > self._distance):
            self.closest, self._distance = container, margin
        self._longest = max(self._longest, time.perf_counter() - self._begun)
        self._finetuning = container.finetuning or self._finetuning
        if margin >= 0 and self._is_better(container, size):
            self.best, self._bytes = container, size
        if margin < 0 and not self.goal.by_size and size >= self.byte_limit:
            raise _CannotImprove
        return _Sample(encoded.codebook_side, limit, margin)

    def _is_better(self, container: Container, size: int) -> bool:
        """Whether a container that meets the goal is better than the best so far."""
        finetuning = container.finetuning
        if finetuning is None or not self.goal.by_size:
            return self.best is None or (size > self._bytes if self.goal.by_size else size < self._bytes)
        if self._psnr is None and self.best is not None:  # the first is fine-tuned at the lambda of the best
            self._psnr = finetuning.psnr_before
        psnr = finetuning.psnr_after if finetuning.kept else finetuning.psnr_before
        if self._psnr is not None and (psnr is None or psnr < self._psnr):
            return False
        self._psnr = psnr
        return True

    def _evaluation(self, encoded: Encoded) -> Evaluation:
        """Evaluate a container even if the search is stopped meanwhile, and then end it."""
        try:
            return self.evaluate(encoded)
        except StopSearch:
            self.stopped = True
            return self.evaluate(encoded)

    def evaluate(self, encoded: Encoded) -> Evaluation:
        """Compare the renderings of a container with those of the original, or both with the photographs."""
        self.progress("evaluate", 0.0)
        most = max(len(self.original), MAX_GAUSSIANS)
        decoded = read_scene(encoded.files, ReadOptions(max_gaussians=most), threads=self.threads)
        return self.compare(decoded)


@dataclass(frozen=True, slots=True)
class _Sample:
    """One container: the side of its codebook's image in pixels, the limit that decides, and its margin to that."""

    side: int
    limit: Limit
    margin: float


class _CannotImprove(Exception):
    """Raised when no container of this scene can become smaller than one that is known of another scene."""
