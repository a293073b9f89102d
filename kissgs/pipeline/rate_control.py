"""Encodes until a goal is met: a size, a PSNR, or a loss of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from kissgs.cameras.views import Views
from kissgs.core.errors import StopSearch, UnsupportedError
from kissgs.core.progress import Annotated
from kissgs.core.root_finding import find_root
from kissgs.core.splats import Splats
from kissgs.evaluation.psnr_loss import SEARCH_SEED
from kissgs.evaluation.results import MOST
from kissgs.finetuning.result import FinetuneReport
from kissgs.pipeline.trial import Trial
from kissgs.settings import EncodeSettings
from kissgs.settings.encode import GOALS
from kissgs.sogxt.container import stored_sizes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.sogxt.encode import Encoded

if TYPE_CHECKING:
    from kissgs.evaluation.evaluate import Picture
    from kissgs.evaluation.results import Evaluation

PRICES = (-70.0, -6.0)
"""Between which prices are sought, as powers of 2."""

MIN_STEP_LOG2 = 1 / 32
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

    def margin(self, trial: Trial) -> float:
        """At least 0 where the goal is met: sizes and losses as powers of 2, PSNR in decibels.

        Infinite where nothing is lost, so that it is not known how much may still go.
        """
        if self.settings.target_size is not None:
            return math.log2(self.settings.target_size / trial.bytes)
        if self.settings.psnr is not None:
            return (trial.psnr or 0.0) - self.settings.psnr
        if (
            trial.drop is None or trial.drop == math.inf
        ):  # infinite where photographs were equal to the scene's pictures
            return -math.inf
        if trial.drop <= 0:  # photographs may even find a container better
            return math.inf
        return math.log2((self.settings.max_psnr_drop or 1.0) / trial.drop)

    def failure_message(self, trials: Sequence[Trial], *, fewer: bool) -> str:
        """Why none of these will do; ``fewer``: whether fewer Gaussians have not been tried, and may serve."""
        at = (max if self.by_size else min)((trial.rd_lambda for trial in trials if trial.rd_lambda), default=None)
        trials = [trial for trial in trials if trial.rd_lambda in (None, at)]  # where another ends, too
        if self.settings.target_size is not None:
            least, wanted = min(trial.bytes for trial in trials), int(self.settings.target_size)
            return (
                f"no container of this scene that was found has at most {wanted:,} byte{'' if wanted == 1 else 's'}, "
                f"the smallest has {least:,}; ask for no less than that"
                + (", or let Gaussians go: --compact auto" if fewer else "")
            )
        if self.settings.psnr is not None:
            most = math.floor(100 * max(trial.psnr or 0.0 for trial in trials)) / 100
            return (
                f"no container of this scene that was found has {self.settings.psnr:g} dB, the finest has {most:.2f}; "
                "ask for no more than that"
                + (f"; views count for at most {MOST:g} dB each" if self.settings.psnr > MOST else "")
            )
        least_lost = 1.005 * min(math.inf if trial.drop is None else trial.drop for trial in trials)
        return (
            f"no container of this scene that was found loses at most {self.settings.max_psnr_drop:g} dB, the finest "
            f"loses {least_lost:.3g}; allow as much"
        )


class RateControl:
    """For the price at which a container meets the goal of the settings, and hardly more.

    Among those that meet it the best is the largest, where a size is the goal, or the smallest. Of fine-tuned ones for
    a size, it is the one that those views which judge them find best.

    Attributes:
        goal: of the settings.
        settings: with which containers are made: those that were asked for, or with another codebook.
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
            views: from where; None: cameras drawn over the whole scene.
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
        self._known: dict[float, _Sample] = {}
        self._jump: tuple[float, int] | None = None
        self._psnr: float | None = None
        self._tuned: FinetuneReport | None = None
        self._taken: dict[str, Picture] | None = None

    def search_all(self, encoder: Encoder) -> None:
        """As many attempts as the settings have; with another codebook where one in balance with the rest will not do.

        Its size is bounded for the sake of time, and its side is a multiple of 8: there may be nothing beyond that
        bound, and nothing between two sides.
        """
        self.run(encoder)
        if (
            self._short
            and self.settings.gaussians_per_codebook_entry > 1
            and self.original.sh_degree > 0
            and self._known
        ):
            largest = max(known.side for known in self._known.values())
            bounded = max(x for x, known in self._known.items() if known.side == largest)
            self._known = {x: known for x, known in self._known.items() if known.side < largest}
            self._again(encoder, 2.0**bounded, gaussians_per_codebook_entry=1.0)
        if self._jump is not None:
            rd_lambda, side = self._jump
            self._known = {x: known for x, known in self._known.items() if known.side <= side}
            self._again(encoder, rd_lambda, sh_codebook_size=side**2)
        self._known = {}  # nothing of what fine-tuning will find
        if self.best is not None:
            made = self.best.settings
            self.settings = self.settings.model_copy(
                update={
                    "gaussians_per_codebook_entry": made.gaussians_per_codebook_entry,
                    "sh_codebook_size": made.sh_codebook_size,
                }
            )

    def _again(self, encoder: Encoder, rd_lambda: float, **changes: float) -> None:
        left = self.settings.max_encodes - len(self.trials)
        if left > 0 and not (self.stopped or self.hopeless):
            self.settings = self.settings.model_copy(update=changes)
            self.run(encoder, rd_lambda, left)

    @property
    def _short(self) -> bool:
        """Whether nothing was good enough, or nothing large enough."""
        spares = [self.goal.margin(trial) for trial in self.trials]
        return min(spares) > self.goal.near if self.goal.by_size else max(spares) < 0

    def run(self, encoder: Encoder, rd_lambda: float | None = None, attempts: int | None = None) -> None:
        """Make up to ``attempts`` containers, by default as many as the settings allow, the first at ``rd_lambda``."""
        try:
            self._run(encoder, rd_lambda, attempts or self.settings.max_encodes)
        except _CannotImprove:
            self.hopeless = True
        except StopSearch:
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
            fewer = all_stay and self.count > 1 and self.overhead < (self.settings.target_size or 0)
            raise UnsupportedError(self.goal.failure_message(self.trials, fewer=fewer))
        if self._tuned is None or self.best.finetuning is not None:
            return self.best
        return replace(self.best, finetuning=replace(self._tuned, kept=False, note=NOT_TUNED))

    def _run(self, encoder: Encoder, rd_lambda: float | None, attempts: int) -> None:
        first = encoder(self.settings if rd_lambda is None else self._at(rd_lambda))
        start = self._judge(first)
        if first.encoded.rd_lambda is not None:
            begin = math.log2(first.encoded.rd_lambda)

            def spare(x: float) -> float:
                container = first if x == begin else encoder(self._at(2.0**x))
                found = start if x == begin else self._judge(container)
                self._known[x] = _Sample(container.encoded.codebook_side, found)
                return found

            find_root(
                spare,
                *(begin, self.goal.slope, self.goal.near, PRICES),
                attempts=attempts,
                settled=self._settled,
                before={x: known.margin for x, known in self._known.items()},
            )

    def _settled(self, inside: float, outside: float) -> bool:
        """Whether what lies between these prices, as powers of 2, is a jump.

        Where a size is the goal, what is made finer with the codebook of ``inside`` is only better than that; pictures
        are better served by the codebook of the finer one.
        """
        if not self.goal.by_size:
            return False
        one, other, gap = self._known[inside], self._known[outside], abs(inside - outside)
        smooth = gap * abs(self.goal.slope)
        jumps = gap < 1 and (smooth < self.goal.near or one.margin - other.margin > 2 * smooth)
        if jumps and one.side != other.side and self._tuned is None:
            self._jump = 2.0 ** min(inside, outside), min(one.side, other.side)
            return True
        return gap < MIN_STEP_LOG2

    def _at(self, rd_lambda: float) -> EncodeSettings:
        without = dict.fromkeys(GOALS)
        return EncodeSettings(**{**self.settings.model_dump(), **without, "rd_lambda": rd_lambda})

    def _judge(self, container: Container) -> float:
        """What is to spare: at least 0 where the goal is met."""
        encoded = container.encoded
        size, sizes = stored_sizes(encoded.files, packed=self.packed)
        trial = Trial(self.count, encoded.rd_lambda, size)
        if not self.goal.by_size:
            trial = trial.with_pictures(self.pictures(encoded))
        self.trials.append(trial)
        self.overhead = size - sum(taken for name, taken in sizes.items() if name.endswith(".webp"))
        self.progress.note = f"try {len(self.trials) + 1}, after {trial.spelled()}"
        spare = self.goal.margin(trial)
        self._tuned = container.finetuning or self._tuned
        if spare >= 0 and self._better(container, size):
            self.best, self._bytes = container, size
        if spare < 0 and not self.goal.by_size and size >= self.limit:
            raise _CannotImprove
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
        from kissgs.evaluation.cameras import evaluation_views
        from kissgs.evaluation.evaluate import compare_pictures

        self.progress("evaluate", 0.0)
        if self.views is None:
            self.views = evaluation_views(self.original, seed=SEARCH_SEED, threads=self.threads)
            self._taken = {}
        decoded = decode(encoded.files, max_gaussians=max(len(self.original), MAX_GAUSSIANS), threads=self.threads)
        return compare_pictures(self.original, decoded, self.views, threads=self.threads, taken=self._taken)


@dataclass(frozen=True, slots=True)
class _Sample:
    """Of a container: the side of its codebook's image, and what it left to spare."""

    side: int
    margin: float


class _CannotImprove(Exception):
    """No container of this scene can be better than one that is known of another."""
