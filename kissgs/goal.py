"""Encodes until a goal is met: a PSNR, or a size."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from kissgs.errors import UnsupportedError
from kissgs.finetuning.result import FinetuneReport
from kissgs.progress import Progress, silent
from kissgs.search import ATTEMPTS, Trial, seek
from kissgs.settings import EncodeSettings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.sogxt.encode import Encoded
from kissgs.splats import Splats
from kissgs.views.view import Views

NEAR_PSNR, PSNR_SLOPE = 0.1, -1.5
"""Decibels above a wanted PSNR that are near enough; decibels per doubling of the price, about."""

NEAR_SIZE, SIZE_SLOPE = -math.log2(0.97), 0.2
"""The same of a wanted size, as powers of 2."""

PRICES = (-70.0, -6.0)
"""Between which prices are sought, as powers of 2."""


@dataclass(frozen=True, slots=True)
class Container:
    """The files, and how they were improved, if they were."""

    encoded: Encoded
    finetuning: FinetuneReport | None = None


Encoder = Callable[[EncodeSettings], Container]


class GoalSearch:
    """For the price at which a container meets the goal of the settings, and hardly more.

    Among those that meet it the best is the largest, where a size is the goal, or the smallest; a fine-tuned one before
    one that fine-tuning could not improve, whose report says so.

    Attributes:
        trials: all attempts.
        best: of them; None if none met the goal.
    """

    def __init__(
        self,
        original: Splats,
        settings: EncodeSettings,
        views: Views | None,
        threads: int,
        progress: Progress,
    ) -> None:
        self.original, self.settings = original, settings
        self.views, self.threads, self.progress = views, threads, progress
        self.trials: list[Trial] = []
        self.best: Container | None = None
        self._worth = (False, -math.inf, False)

    def run(self, encoder: Encoder, price: float | None = None, attempts: int = ATTEMPTS) -> None:
        """So many attempts at most, the first at ``price`` if one is given."""
        self.encoder = encoder
        first = self.encoder(self.settings if price is None else self._at(price))
        start = self._judge(first)
        if first.encoded.price is not None:
            by_size = self.settings.psnr is None
            slope, near = (SIZE_SLOPE, NEAR_SIZE) if by_size else (PSNR_SLOPE, NEAR_PSNR)
            begin = math.log2(first.encoded.price)
            seek(*(lambda x: start if x == begin else self._try(2.0**x), begin, slope, near, PRICES), attempts=attempts)

    def found(self) -> tuple[Container, tuple[Trial, ...]]:
        """The best, and all attempts.

        Raises:
            UnsupportedError: none met the goal.
        """
        if self.best is None:
            raise UnsupportedError(self._regret())
        return self.best, tuple(self.trials)

    def _at(self, price: float) -> EncodeSettings:
        return EncodeSettings(**{**self.settings.model_dump(), "price": price, "psnr": None, "target_size": None})

    def _try(self, price: float) -> float:
        return self._judge(self.encoder(self._at(price)))

    def _judge(self, container: Container) -> float:
        """What is to spare: at least 0 where the goal is met."""
        encoded = container.encoded
        size, psnr = len(zip_bytes(encoded.files)), None
        if self.settings.psnr is not None:
            psnr = self._psnr(encoded)
            spare = min(psnr, 1e3) - self.settings.psnr
        else:
            spare = math.log2((self.settings.target_size or 1) / size)
        self.trials.append(Trial(encoded.price or 0.0, size, psnr))
        improved = container.finetuning is not None and container.finetuning.kept
        worth = (improved, -size if psnr is not None else size, container.finetuning is not None)
        if spare >= 0 and worth > self._worth:
            self.best, self._worth = container, worth
        return spare

    def _psnr(self, encoded: Encoded) -> float:
        from kissgs.evaluation.pictures import evaluate
        from kissgs.views.virtual import virtual_views

        self.progress("evaluate", 0.0)
        if self.views is None:  # those that evaluate would take
            self.views = virtual_views(self.original, threads=self.threads)
        decoded = decode(encoded.files, max_gaussians=max(len(self.original), MAX_GAUSSIANS), threads=self.threads)
        return evaluate(self.original, decoded, self.views, threads=self.threads, progress=silent).mean.between.psnr

    def _regret(self) -> str:
        if self.settings.psnr is not None:
            most = max(trial.psnr or 0.0 for trial in self.trials)
            return (
                f"no container of this scene that was found has {self.settings.psnr:g} dB, the best has {most:.2f}; "
                "ask for no more than that"
            )
        least = min(trial.bytes for trial in self.trials)
        return (
            f"no container of this scene that was found has at most {self.settings.target_size:,} bytes, the smallest "
            f"has {least:,}; ask for no less than that, or give fewer Gaussians"
        )
