"""Results of an evaluation, which a command prints without loading what computes them; losses as goals define them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from kissgs.cameras.views import View
from kissgs.core.array_types import Float32, Float64
from kissgs.core.positions import WORLD, Origin


def format_metric(value: float, digits: int, *, signed: bool = False) -> str:
    """Return a value as text with this number of digits: ∞ for equal images, NaN for a failed rendering."""
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if math.isnan(value):
        return "NaN"
    return f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # -0.0 + 0.0 is 0.0


# Loss of detail: changes of SSIM in small patches, which no mean over an image shows.

PatchChanges = Float64[np.ndarray, "_h _w"]
"""Change of SSIM in each patch of an image (:func:`kissgs.rendering.metrics.ssim_with_patches`), negative for a loss: a
candidate's less the original's, both to a photograph; without photographs the candidate's to the original, less 1."""

LARGE_LOSS = 0.05  # loss of SSIM beyond which a patch counts in share_below


@dataclass(frozen=True, slots=True)
class Detail:
    """Changes of SSIM in patches, -2 to 2 and negative for a loss; all NaN if a rendering failed."""

    worst: float  # of the worst patch
    worst_percent: float  # mean of the worst 1 % of all patches, rounded up to whole patches
    share_below: float  # of patches, 0 to 1, that lose more than LARGE_LOSS

    @classmethod
    def of(cls, views: Sequence[PatchChanges]) -> Detail:
        """Return the figures over all patches of all views, of which there is at least one."""
        changes = np.sort(np.concatenate([view.ravel() for view in views]))  # NaN comes last
        if np.isnan(changes[-1]):
            return cls(math.nan, math.nan, math.nan)
        worst = changes[: -(-len(changes) // 100)]
        return cls(float(worst[0]), float(worst.mean()), float((changes < -LARGE_LOSS).mean()))


def detail_text(detail: Detail, against: str) -> str:
    """Return the changes of SSIM in patches, to "photos" or to "renderings" of the reference, as text."""
    from kissgs.rendering.metrics import PATCH  # only for its size

    return (
        f"SSIM to {'photographs' if against == 'photos' else 'the reference'} in patches of {PATCH}x{PATCH} pixels: "
        f"{format_metric(detail.worst_percent, 4, signed=True)} in the worst 1 %, "
        f"{format_metric(detail.worst, 4, signed=True)} in the worst one, "
        f"{format_metric(100 * detail.share_below, 2)} % lose more than {LARGE_LOSS}"
    )


Split = Literal["test", "train", "all"]

MAX_VIEW_PSNR = 60.0
"""Largest PSNR, decibels, with which a view enters a mean. No 8-bit display shows a difference above about 59 dB, and a
single unchanged view, at 120 dB or infinite, would hide damage in others."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ImageMetrics:
    """Metrics of an image against a target, or their means over views; NaN where a rendering has failed."""

    psnr: float  # decibels; infinite for equal images
    ssim: float  # -1 to 1; 1 for equal images
    ms_ssim: float  # 0 to 1; 1 for equal images
    flip: float | None = None  # 0 for equal images, up to 1; None if not requested
    lpips: float | None = None  # 0 for equal images, up to about 1; None if not requested

    def as_dict(self) -> dict[str, float | str | None]:
        """Return the metrics for JSON (:func:`as_json`)."""
        return {name: as_json(value) for name, value in asdict(self).items() if value is not None}

    def texts(self) -> dict[str, str]:
        """Return the metrics as text, by the names that tables give them; without those not requested."""
        values = {"SSIM": self.ssim, "MS-SSIM": self.ms_ssim, "FLIP": self.flip, "LPIPS": self.lpips}
        others = {name: format_metric(value, 4) for name, value in values.items() if value is not None}
        return {"PSNR": format_metric(self.psnr, 2), **others}

    @property
    def summary(self) -> str:
        """All metrics in one line: "PSNR 31.42 dB, SSIM 0.9310, MS-SSIM 0.9702"."""
        psnr, *others = self.texts().items()
        return ", ".join([f"PSNR {psnr[1]} dB", *(f"{name} {text}" for name, text in others)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Metrics of one view, or their means over all views."""

    reference: ImageMetrics | None  # to the photograph; None without photographs
    candidate: ImageMetrics  # to the photograph; without photographs, to the reference's rendering
    candidate_vs_reference: ImageMetrics

    @property
    def change(self) -> float | None:
        """Change of the PSNR to photographs, decibels, negative for a loss; None without photographs."""
        if self.reference is None:
            return None
        if self.reference.psnr == self.candidate.psnr:  # both may be infinite
            return 0.0
        return self.candidate.psnr - self.reference.psnr

    def as_dict(self) -> dict[str, Any]:
        """Return the metrics by name, for JSON."""
        found = {name: getattr(self, name) for name in ("reference", "candidate", "candidate_vs_reference")}
        return {name: None if metrics is None else metrics.as_dict() for name, metrics in found.items()}

    def cells(self, names: Sequence[str] | None = None) -> list[str]:
        """Return a table row: reference, candidate, change, candidate to reference; without photographs the last.
        ``names`` are metrics as :meth:`ImageMetrics.texts` names them, by default all."""
        names = list(self.candidate.texts()) if names is None else names
        *to_photo, to_reference = (
            [metrics.texts()[name] for name in names]
            for metrics in (self.reference, self.candidate, self.candidate_vs_reference)
            if metrics is not None
        )
        if self.change is None:
            return to_reference
        return [*to_photo[0], *to_photo[1], format_metric(self.change, 2, signed=True), *to_reference]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ViewComparison:
    """A view and the metrics of its images; ``origin``: where the view's coordinates are zero in the world."""

    view: View
    comparison: Comparison
    patch_changes: PatchChanges
    origin: Origin = WORLD

    @property
    def ranking_psnr(self) -> float:
        """PSNR of the candidate to the reference, decibels; -inf for NaN, so that a failed rendering ranks worst."""
        psnr = self.comparison.candidate_vs_reference.psnr
        return -math.inf if math.isnan(psnr) else psnr

    @property
    def pose(self) -> str:
        """Position of the camera, and its target or direction, in the world, as text."""
        pose = self.pose_as_dict()
        looking = f"along {_point(pose['direction'])}" if pose["target"] is None else f"at {_point(pose['target'])}"
        return f"at {_point(pose['position'])} looking {looking}"

    def pose_as_dict(self) -> dict[str, Any]:
        """Return the view's name, its PSNR of the candidate to the reference, and the camera's pose in the world."""
        camera, target = self.view.camera, self.view.target
        return {
            "name": self.view.name,
            "psnr": as_json(self.comparison.candidate_vs_reference.psnr),
            "position": (camera.position + self.origin).tolist(),
            "target": None if target is None else (target + self.origin).tolist(),
            "direction": camera.viewmat[2, :3].tolist(),
        }

    def as_dict(self) -> dict[str, Any]:
        """Return name, size in pixels and metrics, for JSON."""
        camera = self.view.camera
        return {"name": self.view.name, "width": camera.width, "height": camera.height, **self.comparison.as_dict()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """Evaluation of a candidate scene against its reference; see :func:`evaluate`.

    Attributes:
        against: what ``candidate`` was compared with: "photos", or the reference's "renderings".
        split: the views that were used: "test", "train" or "all". "train" if "test" was requested and no view is held
            out.
        source: description of the views.
        background: ``(3,)`` RGB from 0 to 1, behind views without a background of their own.
        reference_count: number of Gaussians of the reference.
        candidate_count: number of Gaussians of the candidate.
        views: metrics of each view, one or more.
        note: note about the views (:class:`kissgs.cameras.views.Views`) and the renderings; may be empty.
        shown: share of the scene that the views show, 0 to 1 (:func:`kissgs.evaluation.scene_parts.share_shown`); None
            if not computed.
        surroundings: evaluation from cameras drawn over the whole scene; None if those are the ``views`` or were not
            requested.
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
        """Number and kind of the views: "7 held-out photographs", "1 training camera"."""
        kind = {"test": "held-out ", "train": "training ", "all": ""}[self.split]
        noun = "photograph" if self.against == "photos" else "camera"
        return f"{len(self.views)} {kind}{noun}{'' if len(self.views) == 1 else 's'}"

    @property
    def size(self) -> str:
        """Image size in pixels: "540x960", or "3 sizes"."""
        sizes = {f"{view.view.camera.width}x{view.view.camera.height}" for view in self.views}
        return sizes.pop() if len(sizes) == 1 else f"{len(sizes)} sizes"

    @property
    def added(self) -> int:
        """Number of views that were added for overlooked parts of the scene."""
        return sum(view.view.added for view in self.views)

    @property
    def mean(self) -> Comparison:
        """Mean of each metric over all views, added ones included; of PSNR, the mean of decibels.

        Each view counts for at most :data:`MAX_VIEW_PSNR`.
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
        """View with the lowest PSNR of the candidate to the reference; the first of several."""
        return min(self.views, key=lambda view: view.ranking_psnr)

    @property
    def fifth_percentile(self) -> float:
        """5th percentile over views of the PSNR of the candidate to the reference, interpolated linearly, decibels.

        NaN if a rendering failed; between a number and infinity, the number.
        """
        values = sorted(_psnrs(self))
        if any(math.isnan(value) for value in values):
            return math.nan
        rank = 0.05 * (len(values) - 1)
        lower, upper = values[math.floor(rank)], values[math.ceil(rank)]
        return lower if math.isinf(upper) else lower + (rank - math.floor(rank)) * (upper - lower)

    @property
    def detail(self) -> Detail:
        """Changes of SSIM in the patches of all views: to photographs, without them to the reference's renderings."""
        return Detail.of([view.patch_changes for view in self.views])

    @property
    def extremes(self) -> str:
        """Worst view and its pose, fifth percentile, detail, and share of the scene that is shown, as text."""
        worst = self.worst
        lowest = worst.comparison.candidate_vs_reference.psnr
        text = (
            f"worst view {format_metric(lowest, 1)} dB ({worst.view.name}, {worst.pose}), "
            f"5th percentile {format_metric(self.fifth_percentile, 1)} dB; {detail_text(self.detail, self.against)}"
        )
        if self.shown is not None:
            text += f"; the views show {math.floor(100 * self.shown)} % of the scene"
        added = f"{self.added} of the views {'was' if self.added == 1 else 'were'} added"
        return text if not self.added else f"{text}; {added} for parts that the others overlook"

    def as_dict(self) -> dict[str, Any]:
        """Return the evaluation for JSON; see :meth:`ImageMetrics.as_dict` for infinity and NaN."""
        return {
            "against": self.against,
            "split": self.split,
            "source": self.source,
            "note": self.note,
            "count": {"reference": self.reference_count, "candidate": self.candidate_count},
            "views": [view.as_dict() for view in self.views],
            "added": self.added,
            "mean": self.mean.as_dict(),
            "worst": self.worst.pose_as_dict(),
            "fifth_percentile": as_json(self.fifth_percentile),
            "detail": {name: as_json(value) for name, value in asdict(self.detail).items()},
            "shown": self.shown,
            "surroundings": None if self.surroundings is None else self.surroundings.as_dict(),
        }


def _psnrs(evaluation: Evaluation) -> list[float]:
    """Return the PSNR of the candidate to the reference in each view, decibels."""
    return [view.comparison.candidate_vs_reference.psnr for view in evaluation.views]


def _mean(values: Sequence[ImageMetrics]) -> ImageMetrics:
    columns = {name: [getattr(value, name) for value in values] for name in ("ssim", "ms_ssim", "flip", "lpips")}
    means: dict[str, Any] = {name: None if None in of else sum(of) / len(of) for name, of in columns.items()}
    psnrs = [value.psnr for value in values]
    bounded = [psnr if math.isnan(psnr) else min(psnr, MAX_VIEW_PSNR) for psnr in psnrs]
    mean = math.inf if all(psnr == math.inf for psnr in psnrs) else sum(bounded) / len(bounded)
    return ImageMetrics(psnr=mean, **means)


def _point(point: Sequence[float]) -> str:
    return f"({', '.join(f'{value:.4g}' if abs(value) < 1000 else f'{value:.1f}' for value in point)})"


def as_json(value: float) -> float | str | None:
    """Return a value for JSON, which has neither infinity nor NaN: None for infinity, ``"NaN"`` for NaN."""
    if math.isinf(value):
        return None
    return "NaN" if math.isnan(value) else value


# PSNR of an evaluation, and its loss of PSNR and of SSIM, as goals define them.

ASSUMED_PSNR = 30.0  # decibels to photographs, where there are none: about that of good captures

ESTIMATED_DROP = f"without photographs, the drop of PSNR is estimated for a scene that has {ASSUMED_PSNR:g} dB to them"
"""Note for a drop that was not measured with photographs."""

SEARCH_SEED = 20_011
"""Seed of the cameras that evaluate the trials of a search. ``evaluate`` has seed 0: a result selected with some
cameras is better from these than from others."""

WORST_SHARE = 0.05  # share of the views, the worst ones, that a goal limits separately

MAX_ERROR_RATIO = 20.0
"""Largest ratio of the worst views' squared error to that of the goal. The mean alone would accept the loss of a part
that few views show: there the ratio is in the hundreds, in views that are merely difficult below ten."""

MAX_SSIM_RATIO = 5.0
"""Largest ratio of the worst views' loss of SSIM to that of the goal; the mean alone limits it to 20, as no loss to
renderings is negative."""


def over_scene(evaluation: Evaluation) -> Evaluation:
    """Return the evaluation from cameras over the whole scene, where there are any and no photographs."""
    surroundings = evaluation.surroundings
    return evaluation if surroundings is None or evaluation.against == "photos" else surroundings


def psnr_of(evaluation: Evaluation) -> float:
    """Return the PSNR of the candidate to the reference as goals define it, decibels; NaN if a rendering failed. It is
    the mean over views (:func:`over_scene`), limited by the worst views: at most the PSNR of their mean squared error
    divided by :data:`MAX_ERROR_RATIO`."""
    evaluation = over_scene(evaluation)
    mean = evaluation.mean.candidate_vs_reference.psnr
    worst = _worst([[squared_error(psnr) for psnr in _psnrs(evaluation)]]) / MAX_ERROR_RATIO
    return mean if math.isnan(mean) or worst <= 0 else min(mean, -10 * math.log10(worst))


def drop_of(evaluation: Evaluation) -> float:
    """Return the drop of PSNR from reference to candidate as goals define it, decibels; NaN if a rendering failed. With
    photographs it is the drop of the mean PSNR to them. Without, the reference is assumed to have :data:`ASSUMED_PSNR`
    to photographs, with errors independent of the new ones, so that squared errors add up. It is at least the drop that
    the squared error that the worst views add, divided by :data:`MAX_ERROR_RATIO`, would cause in all views."""
    mean = evaluation.mean
    if mean.change is None:
        drop = _drop_by(squared_error(mean.candidate_vs_reference.psnr) / squared_error(ASSUMED_PSNR))
        groups = [_errors_to_renderings(evaluation), _errors_to_renderings(over_scene(evaluation))]
    else:
        pairs = [
            (squared_error(view.comparison.candidate.psnr), squared_error(view.comparison.reference.psnr))
            for view in evaluation.views
            if view.comparison.reference is not None
        ]
        mean_error = max(sum(reference for _, reference in pairs) / len(pairs), 1e-30)
        drop, groups = -mean.change, [[(candidate - reference) / mean_error for candidate, reference in pairs]]
    worst = _worst(groups) / MAX_ERROR_RATIO
    return _at_least(drop, worst if worst <= 0 else _drop_by(worst))


def ssim_drop_of(evaluation: Evaluation) -> float:
    """Return the drop of SSIM from reference to candidate as goals define it; NaN if a rendering failed. With
    photographs it is the drop of the mean SSIM to them, without photographs 1 - SSIM to the renderings of the
    reference; at least the mean drop of the worst views divided by :data:`MAX_SSIM_RATIO`."""
    groups = [_ssim_drops(evaluation), _ssim_drops(over_scene(evaluation))]
    return _at_least(sum(groups[0]) / len(groups[0]), _worst(groups) / MAX_SSIM_RATIO)


def _at_least(drop: float, worst: float) -> float:
    """Return a mean drop, limited by that of the worst views if they lose anything; NaN if either is."""
    if math.isnan(drop) or math.isnan(worst):
        return math.nan
    return drop if worst <= 0 else max(drop, worst)


def _ssim_drops(evaluation: Evaluation) -> list[float]:
    """Return each view's drop of SSIM to its photograph, without photographs 1 - SSIM to the rendering."""
    return [
        (1.0 if view.reference is None else view.reference.ssim) - view.candidate.ssim
        for view in (compared.comparison for compared in evaluation.views)
    ]


def _errors_to_renderings(evaluation: Evaluation) -> list[float]:
    """Return each view's squared error to the reference's rendering, in units of that of :data:`ASSUMED_PSNR`."""
    return [squared_error(psnr) / squared_error(ASSUMED_PSNR) for psnr in _psnrs(evaluation)]


def _worst(groups: Sequence[Sequence[float]]) -> float:
    """Return the largest mean of the largest errors, :data:`WORST_SHARE` of a group of views; NaN if any error is."""
    if any(math.isnan(error) for errors in groups for error in errors):
        return math.nan
    counts = [math.ceil(WORST_SHARE * len(errors)) for errors in groups]
    return max(sum(sorted(errors)[-count:]) / count for errors, count in zip(groups, counts, strict=True))


def squared_error(psnr: float) -> float:
    """Return the mean squared error of a PSNR in decibels; 0 if that is infinite."""
    return float(10 ** (-psnr / 10))


def _drop_by(errors: float) -> float:
    """Return the drop of PSNR, decibels, caused by additional squared error in units of the former error."""
    return 10 * math.log10(1 + max(errors, 0.0))
