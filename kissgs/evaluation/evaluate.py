"""What a compressed scene looks like beside the original: PSNR, SSIM and LPIPS of pictures taken from the same places.

Pictures are clamped to [0, 1], as a screen clamps them, but not rounded to 8 bits: rounding would put a floor of some
59 dB under every error. (Published figures often come from 8-bit files; near 30 dB that is less than 0.01 dB.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from kissgs.cameras.views import View, Views
from kissgs.core.array_types import Float32, Shaped
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, Split, ViewComparison
from kissgs.evaluation.visibility import share_shown
from kissgs.rendering.camera import Camera
from kissgs.rendering.lpips import Lpips
from kissgs.rendering.metrics import psnr, ssim
from kissgs.rendering.rasterizer import Device, load_kernels, render

NOTHING_SEEN = (
    "no picture shows anything of the reference, so these figures say nothing; choose other cameras (--views)"
)


Picture = Float32[np.ndarray, "H W 3"]
Measure = Callable[[np.ndarray, np.ndarray], ImageMetrics]


def evaluate(
    reference: Splats,
    candidate: Splats,
    views: Views | None = None,
    *,
    split: Split = "test",
    seed: int = 0,
    lpips: bool = False,
    device: Device = "cpu",
    threads: int = 0,
    progress: Progress = silent,
) -> Evaluation:
    """Take the same pictures of two scenes, and compare them with the photographs, if there are any, and each other.

    Cameras drawn over the whole scene (:func:`kissgs.evaluation.cameras.evaluation_views`) judge where no views are
    given. Where some are, the drawn ones judge beside them: they are the ``surroundings`` of the result.

    The pictures of one view are in memory at a time. They are clamped to [0, 1] and not rounded to 8 bits.

    Args:
        reference: the scene as it was; cleaned first, as is the candidate.
        candidate: what became of it. Gaussians need not be as many, nor in the same order.
        views: from where. Without photographs, the candidate is compared with the reference's renderings alone.
        split: the part of these views to use. Where "test" has none, it is "train", which the result says.
        seed: of the drawn cameras; another one, other cameras.
        lpips: compute LPIPS too, which needs the extra ``kissgs[lpips]``.
        device: ``"cuda"`` needs the extra ``kissgs[cuda]``.
        threads: of the processor; 0 means one each. The figures do not depend on it.
        progress: receives the stages ``"kernels"``, ``"cameras"`` (of those that are drawn) and ``"evaluate"``.

    Raises:
        InvalidViewsError: there is no view to use; some of them have photographs and some have not; a photograph
            cannot be read.
        UnsupportedError: a picture would take too much memory; no CUDA or no LPIPS here; no such split.
    """
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    measure = _measure(lpips, device)
    given = [] if views is None else [_chosen(views, split)]
    load_kernels(progress)
    drawn = evaluation_views(reference, seed=seed, threads=threads, progress=progress)
    parts = [*given, _chosen(drawn, "all")]
    total, done, found = sum(len(part.views) for part in parts), 0, list[Evaluation]()
    for part in parts:
        begin, share = done / total, len(part.views) / total
        told = _compare_all(
            reference,
            candidate,
            part,
            measure,
            device,
            threads,
            progress=lambda stage, fraction, begin=begin, share=share: progress(stage, begin + share * fraction),
        )
        shown = share_shown(reference, [view.camera for view in part.views], threads=threads)
        found.append(replace(told, shown=shown))
        done += len(part.views)
    progress("evaluate", 1.0)
    return found[0] if len(found) == 1 else replace(found[0], surroundings=found[1])


def compare_pictures(
    reference: Splats,
    candidate: Splats,
    views: Views,
    *,
    device: Device = "cpu",
    threads: int = 0,
    taken: dict[str, Picture] | None = None,
    progress: Progress = silent,
) -> Evaluation:
    """As :func:`evaluate` from these views alone: held-out ones, or where none is held out, those for training.

    Args:
        reference: the scene as it was.
        candidate: what became of it.
        views: from where.
        device: as for :func:`evaluate`, as are the following and the errors.
        threads: of the processor.
        taken: pictures of the reference by the names of the views, for those who compare many candidates with it:
            they are taken from there, or put there.
        progress: receives the stages ``"kernels"`` and ``"evaluate"``.
    """
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    part = _chosen(views, "test")
    if device == "cpu":
        load_kernels(progress)
    measure = _measure(False, device)
    found = _compare_all(reference, candidate, part, measure, device, threads, taken, progress=progress)
    progress("evaluate", 1.0)
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Views to compare from: those of one split."""

    of: Views
    split: Split
    views: tuple[View, ...]
    photographed: bool


def _compare_all(
    reference: Splats,
    candidate: Splats,
    part: _Part,
    measure: Measure,
    device: Device,
    threads: int,
    taken: dict[str, Picture] | None = None,
    *,
    progress: Progress,
) -> Evaluation:
    """View by view; both scenes are clean."""
    compared, blank = [], len(reference) > 0
    for done, view in enumerate(part.views):
        progress("evaluate", done / len(part.views))
        background = over(view, part.of.background)
        known = None if taken is None else taken.get(view.name)
        picture = take_picture(reference, view.camera, background, device, threads) if known is None else known
        if taken is not None:
            taken[view.name] = picture
        other = take_picture(candidate, view.camera, background, device, threads)
        blank = blank and bool((picture == np.clip(background, 0, 1)).all())
        photo = view.load_photo() if part.photographed else None
        compared.append(ViewComparison(view=view, comparison=_compare(picture, other, photo, measure)))
    return Evaluation(
        against="photos" if part.photographed else "renderings",
        split=part.split,
        source=part.of.source,
        background=part.of.background,
        reference_count=len(reference),
        candidate_count=len(candidate),
        views=tuple(compared),
        note="; ".join(filter(None, [part.of.note, NOTHING_SEEN if blank else ""])),
    )


def over(view: View, otherwise: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "3"]:
    """The background over which to render for a view: its own, or where it has none, that of all views."""
    return otherwise if view.background is None else view.background


def take_picture(
    splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], device: Device, threads: int
) -> Picture:
    """What a screen would show: clamped to [0, 1]."""
    image, _ = render(splats, camera, background=background.tolist(), threads=threads, device=device)
    return np.clip(image, 0, 1)


def _measure(lpips: bool, device: Device) -> Measure:
    perceptual = Lpips(device) if lpips else None

    def measure(image: np.ndarray, target: np.ndarray) -> ImageMetrics:
        distance = None if perceptual is None else perceptual(image, target)
        return ImageMetrics(psnr=psnr(image, target), ssim=ssim(image, target), lpips=distance)

    return measure


def _chosen(views: Views, split: str) -> _Part:
    """The views of a split, and which that is: where "test" is empty, "train"."""
    parts = {
        "test": views.test,
        "train": views.train,
        "all": views.all,
    }
    used = "train" if split == "test" and not views.test else split
    if used not in parts:
        raise UnsupportedError(f"there is no split {split!r}; choose test, train or all")
    if not parts[used]:
        raise InvalidViewsError(f"there is no view to evaluate from: the split {used!r} of {views.source} is empty")
    return _Part(views, cast(Split, used), parts[used], _have_photos(parts[used]))


def _compare(
    reference: Float32[np.ndarray, "H W 3"],
    candidate: Float32[np.ndarray, "H W 3"],
    photo: Shaped[np.ndarray, "H W 3"] | None,
    measure: Measure,
) -> Comparison:
    between = measure(candidate, reference)
    if photo is None:
        return Comparison(reference=None, candidate=between, candidate_vs_reference=between)
    return Comparison(
        reference=measure(reference, photo), candidate=measure(candidate, photo), candidate_vs_reference=between
    )


def _have_photos(views: Sequence[View]) -> bool:
    without = [view.name for view in views if view.photo is None]
    if without and len(without) < len(views):
        raise InvalidViewsError(
            f"{len(without)} of {len(views)} views have no photograph, the first is {without[0]!r}; give all of them "
            "one, or none"
        )
    return not without
