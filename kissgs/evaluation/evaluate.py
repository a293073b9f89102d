"""Image metrics of a candidate scene's renderings against photographs and against the reference's renderings.

Renderings are clamped to [0, 1], as a screen does, but not rounded to 8 bits: rounding would limit every PSNR to about
59 dB. (Published values often come from 8-bit files; near 30 dB the difference is below 0.01 dB.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from kissgs.cameras.views import View, Views
from kissgs.core.array_types import Float32, Shaped
from kissgs.core.errors import InvalidViewsError, UnsupportedError
from kissgs.core.origin import with_origin
from kissgs.core.progress import Progress, load_kernels, silent
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.cameras import evaluation_views, farther
from kissgs.evaluation.capture_fit import in_scene_frame
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, Split, ViewComparison
from kissgs.evaluation.scene_parts import share_shown
from kissgs.rendering.camera import Camera
from kissgs.rendering.metrics import Flip, Lpips, ms_ssim, psnr, ssim
from kissgs.rendering.rasterizer import Device, render

NOTHING_VISIBLE = "no rendering shows any of the reference, so these values mean nothing; choose other views"
"""Note of an evaluation whose views all miss the reference."""

Rendering = Float32[np.ndarray, "H W 3"]
Measure = Callable[[np.ndarray, np.ndarray], ImageMetrics]
"""Measures an image against a target, both from 0 to 1."""


def evaluate(
    reference: Splats,
    candidate: Splats,
    views: Views | None = None,
    *,
    split: Split = "test",
    seed: int = 0,
    distance: float = 1.0,
    flip: bool = False,
    lpips: bool = False,
    device: Device = "cpu",
    threads: int = 0,
    progress: Progress = silent,
) -> Evaluation:
    """Render two scenes from the same views, and compare the images with photographs, if any, and with each other.

    Without ``views``, cameras are drawn over the whole scene (:func:`kissgs.evaluation.cameras.evaluation_views`). With
    ``views``, the results of the drawn cameras are the ``surroundings`` of the evaluation.

    The images of one view at a time are in memory. They are clamped to [0, 1] and not rounded to 8 bits.

    Args:
        reference: the original scene; cleaned first, like the candidate.
        candidate: the scene to evaluate, with any number of Gaussians in any order.
        views: views of a capture, which are moved into the reference's coordinates if the capture's files say how
            (:func:`kissgs.evaluation.capture_fit.in_scene_frame`). Without photographs, the candidate is compared only
            with renderings of the reference.
        split: which of the views to use. If "test" is empty, "train" is used; see :attr:`Evaluation.split`.
        seed: seed of the drawn cameras.
        distance: distance of the drawn cameras from what they look at, in units of that where they were drawn; a
            coarse level of detail is meant for larger ones.
        flip: compute FLIP too; needs the extra ``kissgs[flip]``.
        lpips: compute LPIPS too; needs the extra ``kissgs[lpips]``.
        device: ``"cuda"`` needs the extra ``kissgs[cuda]``.
        threads: number of threads; 0 means one per processor. The results do not depend on it.
        progress: receives the stages ``"kernels"``, ``"cameras"`` (drawing them) and ``"evaluate"``.

    Raises:
        InvalidViewsError: the distance is not positive, the split is empty, only some of its views have a photograph,
            or one cannot be read.
        UnsupportedError: an image would take too much memory, CUDA, FLIP or LPIPS is missing, or the split is unknown.
    """
    reference, candidate = clean(reference)[0], with_origin(clean(candidate)[0], reference.origin)
    measure = _measure(flip, lpips, device)
    if views is not None:
        _select_split(views, split)  # refused before any work
        views = in_scene_frame(reference, views, threads=threads, progress=progress)
    given = [] if views is None else [_select_split(views, split)]
    load_kernels(progress)
    drawn = farther(evaluation_views(reference, seed=seed, threads=threads, progress=progress), distance)
    groups = [*given, _select_split(drawn, "all")]
    total, done, evaluations = sum(len(group.views) for group in groups), 0, list[Evaluation]()
    for group in groups:
        begin, share = done / total, len(group.views) / total
        evaluation = _compare_views(
            reference,
            candidate,
            group,
            measure,
            device,
            threads,
            progress=lambda stage, fraction, begin=begin, share=share: progress(stage, begin + share * fraction),
        )
        shown = share_shown(reference, [view.camera for view in group.views], threads=threads)
        evaluations.append(replace(evaluation, shown=shown))
        done += len(group.views)
    progress("evaluate", 1.0)
    return evaluations[0] if len(evaluations) == 1 else replace(evaluations[0], surroundings=evaluations[1])


def compare_images(
    reference: Splats,
    candidate: Splats,
    views: Views,
    *,
    device: Device = "cpu",
    threads: int = 0,
    reference_images: dict[str, Rendering] | None = None,
    progress: Progress = silent,
) -> Evaluation:
    """Compare two scenes from these views alone: the test views, or the training views if there are none.

    Args:
        reference: the original scene.
        candidate: the scene to evaluate.
        views: the views, in the coordinates of the reference.
        device: see :func:`evaluate`.
        threads: see :func:`evaluate`.
        reference_images: cache of the reference's renderings by view name, read and filled; for comparisons of many
            candidates with one reference.
        progress: receives the stages ``"kernels"`` and ``"evaluate"``.

    Raises:
        InvalidViewsError: see :func:`evaluate`.
        UnsupportedError: see :func:`evaluate`.
    """
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    group = _select_split(views, "test")
    if device == "cpu":
        load_kernels(progress)
    measure = _measure(False, False, device)
    evaluation = _compare_views(
        reference, candidate, group, measure, device, threads, reference_images, progress=progress
    )
    progress("evaluate", 1.0)
    return evaluation


@dataclass(frozen=True, slots=True, eq=False)
class _SplitViews:
    """The views of one split.

    Attributes:
        all_views: all views, with their source, background and note.
        split: the split that is used.
        views: its views, one or more.
        photographed: whether they have photographs: all or none of them do.
    """

    all_views: Views
    split: Split
    views: tuple[View, ...]
    photographed: bool


def _compare_views(
    reference: Splats,
    candidate: Splats,
    group: _SplitViews,
    measure: Measure,
    device: Device,
    threads: int,
    reference_images: dict[str, Rendering] | None = None,
    *,
    progress: Progress,
) -> Evaluation:
    """Compare two clean scenes view by view."""
    compared, blank = [], len(reference) > 0
    for done, view in enumerate(group.views):
        progress("evaluate", done / len(group.views))
        background = background_of(view, group.all_views.background)
        image = None if reference_images is None else reference_images.get(view.name)
        if image is None:
            image = render_clamped(reference, view.camera, background, device, threads)
        if reference_images is not None:
            reference_images[view.name] = image
        other = render_clamped(candidate, view.camera, background, device, threads)
        blank = blank and bool((image == np.clip(background, 0, 1)).all())
        photo = view.load_photo() if group.photographed else None
        comparison = _compare(image, other, photo, measure)
        compared.append(ViewComparison(view=view, comparison=comparison, origin=reference.origin))
    return Evaluation(
        against="photos" if group.photographed else "renderings",
        split=group.split,
        source=group.all_views.source,
        background=group.all_views.background,
        reference_count=len(reference),
        candidate_count=len(candidate),
        views=tuple(compared),
        note="; ".join(filter(None, [group.all_views.note, NOTHING_VISIBLE if blank else ""])),
    )


def background_of(view: View, default: Float32[np.ndarray, "3"]) -> Float32[np.ndarray, "3"]:
    """Return the view's own background, or ``default`` if it has none; ``(3,)`` RGB."""
    return default if view.background is None else view.background


def render_clamped(
    splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], device: Device, threads: int
) -> Rendering:
    """Return a rendering with its values clamped to [0, 1]."""
    image, _ = render(splats, camera, background=background.tolist(), threads=threads, device=device)
    return np.clip(image, 0, 1)


def _measure(flip: bool, lpips: bool, device: Device) -> Measure:
    perceptual: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {}
    if flip:
        perceptual["flip"] = Flip()
    if lpips:
        perceptual["lpips"] = Lpips(device)

    def measure(image: np.ndarray, target: np.ndarray) -> ImageMetrics:
        return ImageMetrics(
            psnr=psnr(image, target),
            ssim=ssim(image, target),
            ms_ssim=ms_ssim(image, target),
            **{name: distance(image, target) for name, distance in perceptual.items()},
        )

    return measure


def _select_split(views: Views, split: str) -> _SplitViews:
    """Return the views of a split; if "test" is empty, those of "train"."""
    splits = {
        "test": views.test,
        "train": views.train,
        "all": views.all,
    }
    used = "train" if split == "test" and not views.test else split
    if used not in splits:
        raise UnsupportedError(f"there is no split {split!r}; choose test, train or all")
    if not splits[used]:
        raise InvalidViewsError(
            f"there is no view to evaluate from: the split {used!r} of {views.source} is empty; choose another split"
        )
    return _SplitViews(views, cast(Split, used), splits[used], _have_photos(splits[used]))


def _compare(
    reference: Float32[np.ndarray, "H W 3"],
    candidate: Float32[np.ndarray, "H W 3"],
    photo: Shaped[np.ndarray, "H W 3"] | None,
    measure: Measure,
) -> Comparison:
    candidate_vs_reference = measure(candidate, reference)
    if photo is None:
        return Comparison(
            reference=None, candidate=candidate_vs_reference, candidate_vs_reference=candidate_vs_reference
        )
    return Comparison(
        reference=measure(reference, photo),
        candidate=measure(candidate, photo),
        candidate_vs_reference=candidate_vs_reference,
    )


def _have_photos(views: Sequence[View]) -> bool:
    """Return whether all of these views have photographs; raise InvalidViewsError if only some have."""
    without = [view.name for view in views if view.photo is None]
    if without and len(without) < len(views):
        raise InvalidViewsError(
            f"{len(without)} of {len(views)} views have no photograph, the first is {without[0]!r}; give all views a "
            "photograph, or none"
        )
    return not without
