"""What comparing pictures gives: how alike they are, view by view and on average, for people and for machines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from kissgs.cameras.views import View
from kissgs.core.array_types import Float32, Float64

Split = Literal["test", "train", "all"]

MOST = 60.0
"""Decibels that a view counts for at most in a mean: beyond about 59 no display of 8 bits shows a difference, and one
view of an unchanged part, at 120 dB or infinite, would make up for others that are spoilt."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMetrics:
    """How alike two pictures are, or many pairs of them on average.

    Attributes:
        psnr: decibels; infinite for equal pictures. On average, views count for at most :data:`MOST`, and it is
            infinite only where all pictures are equal.
        ssim: -1 to 1; 1 for equal pictures.
        lpips: from 0 for equal pictures up to about 1; None where it was not asked for.

    NaN, should a picture have it, is kept: no average hides a failed rendering.
    """

    psnr: float
    ssim: float
    lpips: float | None = None

    def as_dict(self) -> dict[str, float | str | None]:
        """For JSON, which has no infinity and no NaN: an infinite value is None (null), NaN the string ``"NaN"``."""
        values = {"psnr": as_json(self.psnr), "ssim": as_json(self.ssim)}
        return values if self.lpips is None else {**values, "lpips": as_json(self.lpips)}

    def spelled(self) -> list[str]:
        """For people."""
        values = [spell(self.psnr, 2), spell(self.ssim, 4)]
        return values if self.lpips is None else [*values, spell(self.lpips, 4)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """The three likenesses that matter, of one view or on average over all.

    Attributes:
        reference: of the reference's rendering to the photograph; None where there are no photographs.
        candidate: of the candidate's rendering to the photograph; equal to ``candidate_vs_reference`` where
            there are none.
        candidate_vs_reference: of the candidate's rendering to the reference's.
    """

    reference: ImageMetrics | None
    candidate: ImageMetrics
    candidate_vs_reference: ImageMetrics

    @property
    def change(self) -> float | None:
        """Of the PSNR to the photograph, decibels: below 0 the candidate lost. None where there are no photographs."""
        if self.reference is None:
            return None
        if self.reference.psnr == self.candidate.psnr:  # both may be infinite
            return 0.0
        return self.candidate.psnr - self.reference.psnr

    def as_dict(self) -> dict[str, Any]:
        """By name."""
        reference = None if self.reference is None else self.reference.as_dict()
        return {
            "reference": reference,
            "candidate": self.candidate.as_dict(),
            "candidate_vs_reference": self.candidate_vs_reference.as_dict(),
        }

    def spelled(self) -> list[str]:
        """For people, a row of a table: reference, candidate, change, between; without photographs only the last."""
        if self.reference is None or self.change is None:
            return self.candidate_vs_reference.spelled()
        change = spell(self.change, 2, signed=True)
        return [*self.reference.spelled(), *self.candidate.spelled(), change, *self.candidate_vs_reference.spelled()]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewComparison:
    """One view, and how alike the pictures from it are."""

    view: View
    comparison: Comparison

    @property
    def badness(self) -> float:
        """PSNR of the candidate to the reference; NaN, a failed picture, is the worst there is."""
        psnr = self.comparison.candidate_vs_reference.psnr
        return -math.inf if math.isnan(psnr) else psnr

    @property
    def place(self) -> str:
        """Where the camera stands and looks, in the scene's coordinates, for people."""
        camera = self.view.camera
        if self.view.target is not None:
            return f"at {_point(camera.position)} looking at {_point(self.view.target)}"
        return f"at {_point(camera.position)} looking along {_point(camera.viewmat[2, :3])}"

    def where(self) -> dict[str, Any]:
        """For JSON: the name, the PSNR of the candidate to the reference, and where the camera stands and looks.

        ``position``, ``target`` (null where none is known) and the unit vector ``direction`` are in the scene's
        coordinates.
        """
        camera, target = self.view.camera, self.view.target
        return {
            "name": self.view.name,
            "psnr": as_json(self.comparison.candidate_vs_reference.psnr),
            "position": camera.position.tolist(),
            "target": None if target is None else target.tolist(),
            "direction": camera.viewmat[2, :3].tolist(),
        }

    def as_dict(self) -> dict[str, Any]:
        """Name, size in pixels, and the likenesses."""
        camera = self.view.camera
        return {"name": self.view.name, "width": camera.width, "height": camera.height, **self.comparison.as_dict()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """A candidate scene's pictures beside those of its reference; see :func:`evaluate`.

    Attributes:
        against: what ``candidate`` was compared with: "photos", or the reference's "renderings".
        split: the views that were used: "test", "train" or "all". Where "test" was asked for and no view is held out,
            this is "train".
        source: of the views, for people.
        background: ``(3,)`` red, green, blue from 0 to 1, over which views without a background of their own were
            rendered.
        reference_count: Gaussians of the reference.
        candidate_count: Gaussians of the candidate.
        views: in their order, one or more.
        note: of the views, for people; see :class:`kissgs.cameras.views.Views`.
        shown: share of the scene that the views show, from 0 to 1; see
            :func:`kissgs.evaluation.visibility.share_shown`. None where it was not computed.
        surroundings: the same from cameras drawn over the whole scene; None where those are the ``views``, or were not
            asked for.
    """

    against: Literal["photos", "renderings"]
    split: Split
    source: str
    background: Float32[np.ndarray, "3"]
    reference_count: int
    candidate_count: int
    views: tuple[ViewComparison, ...]
    note: str = ""
    shown: float | None = None
    surroundings: Evaluation | None = None

    @property
    def views_used(self) -> str:
        """For people: "7 held-out photographs", "1 training camera"."""
        kind = {"test": "held-out ", "train": "training ", "all": ""}[self.split]
        noun = "photograph" if self.against == "photos" else "camera"
        return f"{len(self.views)} {kind}{noun}{'' if len(self.views) == 1 else 's'}"

    @property
    def size(self) -> str:
        """For people, in pixels: "540x960", or "3 sizes"."""
        sizes = {f"{each.view.camera.width}x{each.view.camera.height}" for each in self.views}
        return sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"

    @property
    def added(self) -> int:
        """How many of the views were put beside the drawn ones for parts of the scene that those overlook."""
        return sum(view.view.added for view in self.views)

    @property
    def mean(self) -> Comparison:
        """Mean over views of each figure; of the PSNR a mean of decibels, of at most :data:`MOST` for each view.

        Added views count as all others do: without them, the mean would say nothing of the parts they were added for.
        """
        all_views = [view.comparison for view in self.views]
        references = [view.reference for view in all_views if view.reference is not None]
        return Comparison(
            reference=_mean(references) if references else None,
            candidate=_mean([view.candidate for view in all_views]),
            candidate_vs_reference=_mean([view.candidate_vs_reference for view in all_views]),
        )

    @property
    def worst(self) -> ViewComparison:
        """The view from which the candidate is least like the reference; the first of several."""
        return min(self.views, key=lambda view: view.badness)

    @property
    def fifth_percentile(self) -> float:
        """PSNR of the candidate to the reference that one view in twenty falls short of, between views linearly.

        NaN where a picture failed; between a number and infinity, the number.
        """
        values = sorted(view.comparison.candidate_vs_reference.psnr for view in self.views)
        if any(math.isnan(value) for value in values):
            return math.nan
        place = 0.05 * (len(values) - 1)
        lower, upper = values[math.floor(place)], values[math.ceil(place)]
        return lower if math.isinf(upper) else lower + (place - math.floor(place)) * (upper - lower)

    @property
    def extremes(self) -> str:
        """For people: the worst view and where it is, the fifth percentile, and how much of the scene is shown."""
        worst = self.worst
        lowest = worst.comparison.candidate_vs_reference.psnr
        told = (
            f"worst view {spell(lowest, 1)} dB ({worst.view.name}, {worst.place}), "
            f"5th percentile {spell(self.fifth_percentile, 1)} dB"
        )
        if self.shown is not None:
            told += f"; the views show {math.floor(100 * self.shown)} % of the scene"
        added = f"{self.added} of the views {'was' if self.added == 1 else 'were'} added"
        return told if not self.added else f"{told}; {added} for parts that the others overlook"

    def as_dict(self) -> dict[str, Any]:
        """For JSON; see :meth:`ImageMetrics.as_dict` for infinity and NaN."""
        return {
            "against": self.against,
            "split": self.split,
            "source": self.source,
            "note": self.note,
            "count": {"reference": self.reference_count, "candidate": self.candidate_count},
            "views": [view.as_dict() for view in self.views],
            "added": self.added,
            "mean": self.mean.as_dict(),
            "worst": self.worst.where(),
            "fifth_percentile": as_json(self.fifth_percentile),
            "shown": self.shown,
            "surroundings": None if self.surroundings is None else self.surroundings.as_dict(),
        }


def spell(value: float, digits: int, *, signed: bool = False) -> str:
    """A figure for people: ∞ where two pictures are equal, NaN where one of them failed."""
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if math.isnan(value):
        return "NaN"
    return f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # which makes -0.0 a +0.0


def _mean(values: Sequence[ImageMetrics]) -> ImageMetrics:
    distances = [value.lpips for value in values if value.lpips is not None]
    return ImageMetrics(
        psnr=_mean_decibels([value.psnr for value in values]),
        ssim=sum(value.ssim for value in values) / len(values),
        lpips=sum(distances) / len(values) if distances else None,
    )


def _mean_decibels(values: Sequence[float]) -> float:
    if all(value == math.inf for value in values):
        return math.inf
    return sum(value if math.isnan(value) else min(value, MOST) for value in values) / len(values)


def _point(point: Float64[np.ndarray, "3"]) -> str:
    return f"({', '.join(f'{value:.4g}' for value in point)})"


def as_json(value: float) -> float | str | None:
    """For JSON, which has no infinity and no NaN: None and ``"NaN"``."""
    if math.isinf(value):
        return None
    return "NaN" if math.isnan(value) else value
