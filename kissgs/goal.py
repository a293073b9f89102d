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
from kissgs.sogxt.container import stored_sizes
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

NOT_TUNED = "no fine-tuned container serves the goal better; this one is as it was without"


@dataclass(frozen=True, slots=True)
class Container:
    """The files, with which settings they were made, and how they were improved, if they were."""

    encoded: Encoded
    settings: EncodeSettings
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
        """At least 0 where the goal is met: sizes and losses as powers of 2, PSNR in decibels.

        Infinite where nothing is lost, so that it is not known how much may still go.
        """
        if self.settings.target_size is not None:
            return math.log2(self.settings.target_size / trial.bytes)
        if self.settings.psnr is not None:
            return (trial.psnr or 0.0) - self.settings.psnr
        if trial.drop is None or trial.drop <= 0:  # photographs may even find a container better
            return math.inf if trial.drop is not None else -math.inf
        return math.log2((self.settings.max_psnr_drop or 1.0) / trial.drop)

    def regret(self, trials: Sequence[Trial], *, all_stay: bool) -> str:
        """Why none of these will do; ``all_stay``: whether none with fewer Gaussians may be tried."""
        if self.settings.target_size is not None:
            least, wanted = min(trial.bytes for trial in trials), int(self.settings.target_size)
            return (
                f"no container of this scene that was found has at most {wanted:,} byte{'' if wanted == 1 else 's'}, "
                f"the smallest has {least:,}; ask for no less than that"
                + (", or let Gaussians go: --compact auto" if all_stay else "")
            )
        if self.settings.psnr is not None:
            most = math.floor(100 * max(trial.psnr or 0.0 for trial in trials)) / 100
            return (
                f"no container of this scene that was found has {self.settings.psnr:g} dB, the best has {most:.2f}; "
                "ask for no more than that"
            )
        least_lost = 1.005 * min(math.inf if trial.drop is None else trial.drop for trial in trials)
        return (
            f"no container of this scene that was found loses at most {self.settings.max_psnr_drop:g} dB, the best "
            f"loses {least_lost:.3g}; allow as much"
        )


class GoalSearch:
    """For the price at which a container meets the goal of the settings, and hardly more.

    Among those that meet it the best is the largest, where a size is the goal, or the smallest. Of fine-tuned ones for
    a size, it is the one that those views which judge them find best.

    Attributes:
        goal: of the settings.
        trials: all attempts.
        best: of them; None if none met the goal.
        stopped: whether somebody said that it was enough.
        hopeless: whether ``limit`` was reached.
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
        packed: bool = True,
        limit: float = math.inf,
    ) -> None:
        """Nothing is tried yet.

        Args:
            original: whose pictures tell what is lost.
            settings: with a goal.
            views: from where, or virtual cameras.
            threads: 0 means one per processor.
            progress: whose note tells where the search stands.
            count: Gaussians of what is encoded, if it is not the original.
            packed: whether the files become a zip.
            limit: where pictures are the goal: bytes that a container must not have to be of use.
        """
        self.original, self.settings, self.goal = original, settings, Goal.of(settings)
        self.views, self.threads, self.progress = views, threads, progress
        self.count = len(original) if count is None else count
        self.packed, self.limit = packed, limit
        self.trials: list[Trial] = []
        self.best: Container | None = None
        self.stopped = self.hopeless = False
        self.overhead = 0
        self._bytes = 0
        self._psnr: float | None = None
        self._tuned: FinetuneReport | None = None

    def run(self, encoder: Encoder, price: float | None = None, attempts: int | None = None) -> None:
        """So many attempts at most, by default as many as the settings have, the first at ``price`` if one is given."""
        try:
            self._run(encoder, price, attempts or self.settings.attempts)
        except _Hopeless:
            self.hopeless = True
        except Enough:
            if self.best is None:
                raise
            self.stopped = True
        finally:
            self.progress.note = ""

    def found(self, *, all_stay: bool = True) -> Container:
        """The best; where fine-tuning has not found it, with a report that says so.

        Raises:
            UnsupportedError: none met the goal. ``all_stay``: whether none with fewer Gaussians may be tried.
        """
        if self.best is None:
            raise UnsupportedError(self.goal.regret(self.trials, all_stay=all_stay))
        if self._tuned is None or self.best.finetuning is not None:
            return self.best
        return replace(self.best, finetuning=replace(self._tuned, kept=False, note=NOT_TUNED))

    def _run(self, encoder: Encoder, price: float | None, attempts: int) -> None:
        first = encoder(self.settings if price is None else self._at(price))
        start = self._judge(first)
        if first.encoded.price is not None:
            begin = math.log2(first.encoded.price)
            seek(
                lambda x: start if x == begin else self._judge(encoder(self._at(2.0**x))),
                *(begin, self.goal.slope, self.goal.near, PRICES),
                attempts=attempts,
                jump=JUMP if self.goal.by_size else 0.0,
            )

    def _at(self, price: float) -> EncodeSettings:
        without = dict.fromkeys(GOALS)
        return EncodeSettings(**{**self.settings.model_dump(), **without, "price": price})

    def _judge(self, container: Container) -> float:
        """What is to spare: at least 0 where the goal is met."""
        encoded = container.encoded
        size, sizes = stored_sizes(encoded.files, packed=self.packed)
        trial = Trial(self.count, encoded.price, size)
        if not self.goal.by_size:
            seen = self.pictures(encoded)
            trial = replace(trial, psnr=seen.mean.between.psnr, drop=drop_of(seen))
        self.trials.append(trial)
        self.overhead = size - sum(taken for name, taken in sizes.items() if name.endswith(".webp"))
        self.progress.note = f"try {len(self.trials) + 1}, after {trial.spelled()}"
        spare = self.goal.spare(trial)
        self._tuned = container.finetuning or self._tuned
        if spare >= 0 and self._better(container, size):
            self.best, self._bytes = container, size
        if spare < 0 and not self.goal.by_size and size >= self.limit:
            raise _Hopeless
        return spare

    def _better(self, container: Container, size: int) -> bool:
        """Than the best so far; both meet the goal."""
        tuned = container.finetuning
        if tuned is None or not self.goal.by_size:
            return self.best is None or (size > self._bytes if self.goal.by_size else size < self._bytes)
        if self._psnr is None and self.best is not None:  # the first is tuned at the price of the best
            self._psnr = tuned.psnr_before
        psnr = tuned.psnr_after if tuned.kept else tuned.psnr_before
        if self._psnr is not None and psnr < self._psnr:
            return False
        self._psnr = psnr
        return True

    def pictures(self, encoded: Encoded) -> Evaluation:
        """Of a container beside those of the original."""
        from kissgs.evaluation.pictures import evaluate
        from kissgs.views.virtual import virtual_views

        self.progress("evaluate", 0.0)
        if self.views is None:  # those that evaluate would take
            self.views = virtual_views(self.original, threads=self.threads)
        decoded = decode(encoded.files, max_gaussians=max(len(self.original), MAX_GAUSSIANS), threads=self.threads)
        return evaluate(self.original, decoded, self.views, threads=self.threads, progress=silent)


class _Hopeless(Exception):
    """No container of this scene can be better than one that is known of another."""
