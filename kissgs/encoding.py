"""From a scene to a container, as the settings ask: look at it where bits are weighed; encode it, once or to a goal."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._typing import Float32, Int
from kissgs._version import __version__
from kissgs.errors import UnsupportedError
from kissgs.importance import Importance
from kissgs.io.importance_file import read_importance, write_importance
from kissgs.progress import Progress, silent
from kissgs.search import Trial, seek
from kissgs.settings import EncodeSettings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.decode import decode
from kissgs.sogxt.encode import Encoded, encode
from kissgs.sogxt.encode import load_kernels as load_encoder
from kissgs.sogxt.weighed import Recolor
from kissgs.splats import ATTRIBUTES, Cleaned, Splats
from kissgs.views.view import Views

if TYPE_CHECKING:
    from kissgs.rendering.importance import Watch

HEDGE = {True: 0.1, False: 0.55}
"""How little pictures say of others: those from a capture's cameras, and those from virtual ones."""

NEAR_PSNR, PSNR_SLOPE = 0.1, -1.5
"""Decibels above a wanted PSNR that are near enough; decibels per doubling of the price, about."""

NEAR_SIZE, SIZE_SLOPE = -math.log2(0.97), 0.2
"""The same of a wanted size, as powers of 2."""

PRICES = (-70.0, -6.0)
"""Between which prices are sought, as powers of 2."""


def encode_scene(
    splats: Splats,
    settings: EncodeSettings,
    importance: Importance | None,
    cache: Path | None,
    views: Views | None,
    cleaned: Cleaned,
    threads: int,
    progress: Progress,
    *,
    original: Splats,
) -> tuple[Encoded, tuple[Trial, ...]]:
    """Encode a clean scene as the settings ask, and tell what was tried on the way if they name a goal.

    A goal's PSNR is that to pictures of ``original``, from which the scene may have been compacted.

    Raises:
        OutputError: ``cache`` is something else, or cannot be written.
        UnsupportedError: the goal cannot be met; the scene is too large for one container.
    """
    if not settings.weigh or len(splats) == 0:
        compacted = len(original) - len(splats)
        return encode(splats, settings, cleaned=cleaned, compacted=compacted, threads=threads, progress=progress), ()
    encoder = _look(splats, settings, importance, cache, views, cleaned, len(original) - len(splats), threads, progress)
    if settings.psnr is None and settings.target_size is None:
        return encoder(settings), ()
    return _Search(original, settings, encoder, views, threads, progress).run()


Encoder = Callable[[EncodeSettings], Encoded]


def _look(
    splats: Splats,
    settings: EncodeSettings,
    importance: Importance | None,
    cache: Path | None,
    views: Views | None,
    cleaned: Cleaned,
    compacted: int,
    threads: int,
    progress: Progress,
) -> Encoder:
    """An encoder that weighs by pictures of the scene, which are taken once."""
    from kissgs.rendering.rasterizer import load_kernels as load_rasterizer
    from kissgs.views.watch import watch

    if importance is not None:
        importance.check(splats)
    load_encoder(progress)
    load_rasterizer()
    captured = views is not None and len(views.train) > 0
    recolor = None
    if importance is None or (captured and settings.refit):
        size = settings.view_size
        watched = watch(splats, views, count=settings.views, size=size, threads=threads, progress=progress)
        if importance is None:
            hedge = settings.hedge if settings.hedge is not None else HEDGE[captured]
            importance = _importance(splats, watched, hedge, cache, threads, progress)
        if captured and settings.refit:  # virtual pictures would mislead it
            recolor = _recolor(splats, watched, importance, settings.refit, threads, progress)

    def ready(stage: str, fraction: float, note: str = "") -> None:
        if stage != "kernels":  # that was before
            progress(stage, fraction)

    def encoder(chosen: EncodeSettings) -> Encoded:
        return encode(
            *(splats, chosen),
            importance=importance,
            recolor=recolor,
            cleaned=cleaned,
            compacted=compacted,
            threads=threads,
            progress=ready,
        )

    return encoder


def _importance(
    splats: Splats, watched: Watch, hedge: float, cache: Path | None, threads: int, progress: Progress
) -> Importance:
    """Measured, or as it was kept in the file ``cache`` when it was measured before."""
    from kissgs.rendering.importance import measure_importance

    if cache is None:
        return measure_importance(splats, watched, hedge=hedge, threads=threads, progress=progress)
    key = hashlib.sha256(f"{__version__} {hedge} {splats.sh_degree} {watched.weights} {watched.spread}".encode())
    for camera in watched.cameras:
        key.update(camera.viewmat.tobytes() + camera.K.tobytes() + f"{camera.width} {camera.height} ".encode())
    for values in (watched.background, *(getattr(splats, name) for name in ATTRIBUTES)):
        key.update(values.tobytes())
    found = read_importance(cache, key.hexdigest())
    if found is None:
        found = measure_importance(splats, watched, hedge=hedge, threads=threads, progress=progress)
        write_importance(cache, found, key.hexdigest())
    return found


def _recolor(
    splats: Splats, watched: Watch, importance: Importance, steps: int, threads: int, progress: Progress
) -> Recolor:
    """Refits base colours to pictures of the scene."""
    from kissgs.rendering.refit import refit_colors

    def recolor(decoded: Splats, order: Int[np.ndarray, " M"]) -> Float32[np.ndarray, "M 3"]:
        weights = importance.colors[order], importance.guessed[order]
        return refit_colors(decoded, splats, watched, *weights, steps=steps, threads=threads, progress=progress)

    return recolor


class _Search:
    """For the price at which a container meets the goal of the settings, and hardly more."""

    def __init__(
        self,
        original: Splats,
        settings: EncodeSettings,
        encoder: Encoder,
        views: Views | None,
        threads: int,
        progress: Progress,
    ) -> None:
        self.original, self.settings, self.encoder = original, settings, encoder
        self.views, self.threads, self.progress = views, threads, progress
        self.trials: list[Trial] = []
        self.best: tuple[int, Encoded] | None = None

    def run(self) -> tuple[Encoded, tuple[Trial, ...]]:
        """All attempts.

        Raises:
            UnsupportedError: none meets the goal.
        """
        first = self.encoder(self.settings)
        start = self._judge(first)
        if first.price is not None:
            by_size = self.settings.psnr is None
            slope, near = (SIZE_SLOPE, NEAR_SIZE) if by_size else (PSNR_SLOPE, NEAR_PSNR)
            begin = math.log2(first.price)
            seek(lambda x: start if x == begin else self._try(2.0**x), begin, slope, near, PRICES)
        if self.best is None:
            raise UnsupportedError(self._regret())
        return self.best[1], tuple(self.trials)

    def _try(self, price: float) -> float:
        chosen = {**self.settings.model_dump(), "price": price, "psnr": None, "target_size": None}
        return self._judge(self.encoder(EncodeSettings(**chosen)))

    def _judge(self, encoded: Encoded) -> float:
        """What is to spare: at least 0 where the goal is met."""
        size, psnr = len(zip_bytes(encoded.files)), None
        if self.settings.psnr is not None:
            psnr = self._psnr(encoded)
            spare = min(psnr, 1e3) - self.settings.psnr
        else:
            spare = math.log2((self.settings.target_size or 1) / size)
        self.trials.append(Trial(encoded.price or 0.0, size, psnr))
        worth = -size if psnr is not None else size
        if spare >= 0 and (self.best is None or worth > self.best[0]):
            self.best = worth, encoded
        return spare

    def _psnr(self, encoded: Encoded) -> float:
        from kissgs.evaluation.pictures import evaluate
        from kissgs.views.virtual import virtual_views

        self.progress("evaluate", 0.0)
        if self.views is None:  # those that evaluate would take
            self.views = virtual_views(self.original, threads=self.threads)
        decoded = decode(encoded.files, max_gaussians=len(self.original), threads=self.threads)
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
