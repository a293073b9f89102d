"""From where a scene is scored, fitted and judged while it is compacted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32
from kissgs.progress import Progress, silent
from kissgs.splats import Splats
from kissgs.views.view import View, Views
from kissgs.views.virtual import virtual_views

JUDGED = 16
"""Held-out views that are looked at, at most."""


@dataclass(frozen=True, slots=True, eq=False)
class School:
    """Views, all at the size at which to learn.

    Attributes:
        train: to score by and to learn from; one or more.
        test: to judge by: held out, or where no view is, some of those to learn from.
        background: ``(3,)`` RGB over which to render.
        source: for people.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    background: Float32[np.ndarray, "3"]
    source: str

    @property
    def exam(self) -> Views:
        """The views to judge by, for :func:`kissgs.evaluate`."""
        return Views((), self.test, self.background, self.source)


def school(
    splats: Splats, views: Views | None, *, count: int, size: int, threads: int = 0, progress: Progress = silent
) -> School:
    """A capture's views for training, or virtual ones where there are none.

    Args:
        splats: finite.
        views: of a capture.
        count: of virtual views.
        size: longer side of a picture, pixels; smaller ones stay as they are.
        threads: 0 means one per processor.
        progress: receives the stage ``"cameras"``.
    """
    if views is None or not views.train:
        side = size * 4 // 5
        views = virtual_views(splats, width=side, height=side, count=count, threads=threads, progress=progress)
    return School(
        train=_sized(views.train, size),
        test=_sized(_some(views.test or views.train), size),
        background=views.background,
        source=views.source,
    )


def _sized(views: Iterable[View], size: int) -> tuple[View, ...]:
    return tuple(view.at_most(size) for view in views)


def _some(views: Sequence[View]) -> list[View]:
    chosen = np.unique(np.linspace(0, len(views) - 1, JUDGED).astype(int))
    return [views[n] for n in chosen]
