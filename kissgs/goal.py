"""Encodes until a goal is met: a size, a PSNR, or a loss of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from kissgs.errors import Enough, UnsupportedError
from kissgs.evaluation.drop import drop_of
from kissgs.finetuning.result import FinetuneReport
from kissgs.progress import Annotated, silent
from kissgs.search import Trial, seek
from kissgs.settings import EncodeSettings
from kissgs.settings.encode import GOALS
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.sogxt.encode import Encoded
from kissgs.splats import Splats
from kissgs.views.view import Views

if TYPE_CHECKING:
    from kissgs.evaluation.likeness import Evaluation

PRICES = (-70.0, -6.0)
"""Between which prices are sought, as powers of 2."""

JUMP = 1 / 32
"""Powers of 2: a size that jumps between prices as near as this jumps for good, and is not looked for any finer."""


@dataclass(frozen=True, slots=True)
class Container:
    """The files, and how they were improved, if they were."""

    encoded: Encoded
    finetuning: FinetuneReport | None = None


Encoder = Callable[[EncodeSettings], Container]


@dataclass(frozen=True, slots=True)
class Goal:
    """What a container should be like.

    Attributes:
        settings: with one goal.
        slope: of :meth:`spare`, per doubling of the price of a bit, about.
        near: spare that is near enough to none.
    """

    settings: EncodeSettings
    slope: float
    near: float

    @classmethod
    def of(cls, settings: EncodeSettings) -> Goal:
        """The goal of these settings: of sizes 3 % to spare will do, of a PSNR 0.1 dB, of a loss 0.02 dB."""
        if settings.target_size is not None:
            return cls(settings, 0.2, -math.log2(0.97))
        if settings.psnr is not None:
            return cls(settings, -1.5, 0.1)
        return cls(settings, -0.5, -math.log2(max(1 - 0.02 / (settings.max_psnr_drop or 1.0), 0.5)))

    @property
    def by_size(self) -> bool:
        """Whether no pictures are needed to tell that it is met."""
        return self.settings.target_size is not None

    def spare(self, trial: Trial) -> float:
        """At least 0 where the goal is met: sizes and losses as powers of 2, PSNR in decibels."""
        if self.settings.target_size is not None:
            return math.log2(self.settings.target_size / trial.bytes)
        if self.settings.psnr is not None:
            return min(trial.psnr or 0.0, 1e3) - self.settings.psnr
        allowed, lost = self.settings.max_psnr_drop or 1.0, math.inf if trial.drop is None else trial.drop
        return math.log2(allowed / max(lost, allowed / 64))  # photographs may even find a container better

    def regret(self, trials: Sequence[Trial], *, all_stay: bool = True) -> str:
        """Why none of these will do; ``all_stay``: whether none with fewer Gaussians were tried."""
        if self.settings.target_size is not None:
            least = min(trial.bytes for trial in trials)
            return (
                f"no container of this scene that was found has at most {self.settings.target_size:,} bytes, the "
                f"smallest has {least:,}; ask for no less than that"
                + (", or let Gaussians go: --compact auto" if all_stay else "")
            )
        if self.settings.psnr is not None:
            most = max(trial.psnr or 0.0 for trial in trials)
            return (
                f"no container of this scene that was found has {self.settings.psnr:g} dB, the best has {most:.2f}; "
                "ask for no more than that"
            )
        least_lost = min(math.inf if trial.drop is None else trial.drop for trial in trials)
        return (
            f"no container of this scene that was found loses at most {self.settings.max_psnr_drop:g} dB, the best "
            f"loses {least_lost:.3f}; allow as much"
        )


class GoalSearch:
    """For the price at which a container meets the goal of the settings, and hardly more.

    Among those that meet it the best is the largest, where a size is the goal, or the smallest; a fine-tuned one before
    one that fine-tuning could not improve, whose report says so.

    Attributes:
        trials: all attempts.
        best: of them; None if none met the goal.
        stopped: whether somebody said that it was enough.
        overhead: bytes of a container that are no images, however few Gaussians it holds.
    """

    def __init__(
        self,
        original: Splats,
        settings: EncodeSettings,
        views: Views | None,
        threads: int,
        progress: Annotated,
        *,
        count: int | None = None,
    ) -> None:
        """``count``: Gaussians of what is encoded, if it is not the original."""
        self.original, self.settings, self.goal = original, settings, Goal.of(settings)
        self.views, self.threads, self.progress = views, threads, progress
        self.count = len(original) if count is None else count
        self.trials: list[Trial] = []
        self.best: Container | None = None
        self.stopped = False
        self.overhead = 0
        self._worth = (False, -math.inf, False)

    def run(self, encoder: Encoder, price: float | None = None, attempts: int | None = None) -> None:
        """So many attempts at most, by default as many as the settings have, the first at ``price`` if one is given."""
        self.encoder = encoder
        try:
            self._run(price, attempts or self.settings.attempts)
        except Enough:
            if self.best is None:
                raise
            self.stopped = True

    def found(self) -> tuple[Container, tuple[Trial, ...]]:
        """The best, and all attempts.

        Raises:
            UnsupportedError: none met the goal.
        """
        if self.best is None:
            raise UnsupportedError(self.goal.regret(self.trials))
        return self.best, tuple(self.trials)

    def _run(self, price: float | None, attempts: int) -> None:
        first = self.encoder(self.settings if price is None else self._at(price))
        start = self._judge(first)
        if first.encoded.price is not None:
            begin = math.log2(first.encoded.price)
            seek(
                lambda x: start if x == begin else self._try(2.0**x),
                *(begin, self.goal.slope, self.goal.near, PRICES),
                attempts=attempts,
                jump=JUMP,
            )

    def _at(self, price: float) -> EncodeSettings:
        without = dict.fromkeys(GOALS)
        return EncodeSettings(**{**self.settings.model_dump(), **without, "price": price})

    def _try(self, price: float) -> float:
        return self._judge(self.encoder(self._at(price)))

    def _judge(self, container: Container) -> float:
        """What is to spare: at least 0 where the goal is met."""
        encoded = container.encoded
        trial = Trial(self.count, encoded.price or 0.0, len(zip_bytes(encoded.files)))
        if not self.goal.by_size:
            seen = self.pictures(encoded)
            trial = replace(trial, psnr=seen.mean.between.psnr, drop=drop_of(seen))
        self.trials.append(trial)
        self.overhead = trial.bytes - sum(len(data) for name, data in encoded.files.items() if name.endswith(".webp"))
        self.progress.note = f"try {len(self.trials) + 1}, after {trial.spelled()}"
        improved = container.finetuning is not None and container.finetuning.kept
        size = trial.bytes if self.goal.by_size else -trial.bytes
        worth = (improved, size, container.finetuning is not None)
        spare = self.goal.spare(trial)
        if spare >= 0 and worth > self._worth:
            self.best, self._worth = container, worth
        return spare

    def pictures(self, encoded: Encoded) -> Evaluation:
        """Of a container beside those of the original."""
        from kissgs.evaluation.pictures import evaluate
        from kissgs.views.virtual import virtual_views

        self.progress("evaluate", 0.0)
        if self.views is None:  # those that evaluate would take
            self.views = virtual_views(self.original, threads=self.threads)
        decoded = decode(encoded.files, max_gaussians=max(len(self.original), MAX_GAUSSIANS), threads=self.threads)
        return evaluate(self.original, decoded, self.views, threads=self.threads, progress=silent)
