"""From where a scene is scored, fitted and judged while it is compacted or fine-tuned."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.views import View, Views
from kissgs.cameras.virtual.close_ups import close_ups
from kissgs.cameras.virtual.random_poses import random_poses
from kissgs.cameras.virtual.scene_views import scene_views
from kissgs.core.array_types import Float32
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.settings.training import TrainingViewSettings

SCORED = 4
"""Of virtual cameras to learn from, one in so many scores."""

CLOSE, CLOSE_SHRINK = 4, 4
"""Close-ups that score beside each virtual camera that does, and how much shorter their sides are."""

BACKDROPS = (0.0, 0.5, 1.0)
"""Grey levels behind what virtual cameras score."""

MAX_EVAL_VIEWS = 16
"""Held-out views that are looked at, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class SupervisionViews:
    """Views, all at the size at which to learn.

    Attributes:
        train: to learn from; one or more.
        score: to score by: those of a capture; or some virtual ones and close-ups, each before a background of its own.
        test: to judge by: held out, or where no view is, some of those to learn from. All have photographs, or none.
        background: ``(3,)`` RGB over which to render.
        source: for people.
        captured: whether the views to learn from are those of a capture.
        note: a sentence for people about what they may not have expected, without a capital and a full stop; or none.
    """

    train: tuple[View, ...]
    score: tuple[View, ...]
    test: tuple[View, ...]
    background: Float32[np.ndarray, "3"]
    source: str
    captured: bool = False
    note: str = ""

    @property
    def eval_views(self) -> Views:
        """The views to judge by, for :func:`kissgs.evaluate`."""
        return Views((), self.test, self.background, self.source)


def supervision_views(
    splats: Splats,
    views: Views | None,
    settings: TrainingViewSettings,
    *,
    scored: int = SCORED,
    threads: int = 0,
    progress: Progress = silent,
) -> SupervisionViews:
    """A capture's views for training and a few virtual ones all around, or virtual ones alone if there is none.

    Args:
        splats: finite.
        views: of a capture. Where none is for training, virtual ones teach and these judge.
        settings: how many virtual views, and the size of pictures; smaller ones stay as they are.
        scored: one in so many virtual views scores; 1 where they are for nothing else, and :data:`SCORED` times fewer
            will do; 0 if none has to.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.
    """
    if views is None or not views.train:
        alone = _virtual(splats, settings, scored, threads, progress)
        if views is None or not views.test:
            return alone
        return replace(alone, test=_held_out(views, settings.view_size), background=views.background)
    size, train, source = settings.view_size, views.train, views.source
    if settings.synthetic_view_share > 0:
        camera = views.train[0].camera.at_most(size)
        side = round(math.sqrt(camera.width * camera.height))
        count = max(1, round(len(views.train) * settings.synthetic_view_share / (1 - settings.synthetic_view_share)))
        around = scene_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
        train, source = (*train, *around.all), f"{source}, and {around.source}"
    sized = _sized(train, size)
    unheld = "" if views.test else "no view is held out: the figures are those of views that were learned from"
    return SupervisionViews(
        train=sized,
        score=sized,
        test=_held_out(views, size),
        background=views.background,
        source=source,
        captured=True,
        note="; ".join(filter(None, [views.note, unheld])),
    )


def _held_out(views: Views, size: int) -> tuple[View, ...]:
    """Those of a capture to judge by, at most so large: all with photographs, or none."""
    return _sized(_some(_alike(views.test or views.train)), size)


def _alike(views: Sequence[View]) -> Sequence[View]:
    """Those with a photograph, if any has one."""
    return [view for view in views if view.photo is not None] or views


def _virtual(
    splats: Splats, settings: TrainingViewSettings, stride: int, threads: int, progress: Progress
) -> SupervisionViews:
    """Where the scene is its own teacher, pictures of it cost nothing but time."""
    side = settings.view_size * 3 // 5
    found = random_poses(
        splats,
        side=side,
        count=max(1, settings.views * (stride or SCORED) // SCORED),
        seed=settings.seed,
        threads=threads,
        progress=progress,
    )
    scoring = _to_score_by(splats, found.train[::stride], side, settings.seed) if stride else ()
    close = len(scoring) - len(found.train[::stride]) if stride else 0
    return SupervisionViews(
        train=found.train,
        score=scoring,
        test=tuple(_some(found.test or found.train)),
        background=found.background,
        source=f"{len(found.train)} virtual camera{'' if len(found.train) == 1 else 's'}"
        + (f", and {close} close-ups that score" if close else ""),
    )


def _to_score_by(splats: Splats, views: Sequence[View], side: int, seed: int) -> tuple[View, ...]:
    """Those and close-ups beside them, before black, grey and white in turn: what is dark does not show on black."""
    close = close_ups(splats, side=max(1, side // CLOSE_SHRINK), count=CLOSE * len(views), seed=seed)
    added = [View(f"close-up {n}", camera) for n, camera in enumerate(close)]
    return tuple(
        replace(view, background=np.full(3, BACKDROPS[n % len(BACKDROPS)], np.float32))
        for part in (views, added)
        for n, view in enumerate(part)
    )


def _sized(views: Iterable[View], size: int) -> tuple[View, ...]:
    return tuple(view.at_most(size) for view in views)


def _some(views: Sequence[View]) -> list[View]:
    chosen = np.unique(np.linspace(0, len(views) - 1, MAX_EVAL_VIEWS).astype(int))
    return [views[n] for n in chosen]
