"""Image metrics of a candidate scene's renderings against photographs and against the reference's renderings.

Rounded to 8 bits, as published values often are, PSNR would end at about 59 dB; near 30 dB it hardly differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
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
    groups = list[tuple[Views, Split]]()
    if views is not None:
        _select_split(views, split)  # refused before any work
        groups.append((in_scene_frame(reference, views, threads=threads, progress=progress), split))
    load_kernels(progress)
    drawn = farther(evaluation_views(reference, seed=seed, threads=threads, progress=progress), distance)
    groups.append((drawn, "all"))
    counts = [len(_select_split(*group)[1]) for group in groups]
    found = list[Evaluation]()
    for (chosen, wanted), count in zip(groups, counts, strict=True):
        begin, share = sum(len(each.views) for each in found) / sum(counts), count / sum(counts)
        evaluation = _compare_views(
            reference,
            candidate,
            chosen,
            wanted,
            measure,
            device,
            threads,
            progress=lambda stage, fraction, begin=begin, share=share: progress(stage, begin + share * fraction),
        )
        shown = share_shown(reference, [each.view.camera for each in evaluation.views], threads=threads)
        found.append(replace(evaluation, shown=shown))
    progress("evaluate", 1.0)
    return found[0] if len(found) == 1 else replace(found[0], surroundings=found[1])


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

    ``reference_images`` are the reference's renderings by view name, read and filled, for comparisons of many
    candidates with one reference.
    """
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    if device == "cpu":
        load_kernels(progress)
    measure = _measure(False, False, device)
    evaluation = _compare_views(
        reference, candidate, views, "test", measure, device, threads, reference_images, progress=progress
    )
    progress("evaluate", 1.0)
    return evaluation


def _compare_views(
    reference: Splats,
    candidate: Splats,
    views: Views,
    split: Split,
    measure: Measure,
    device: Device,
    threads: int,
    reference_images: dict[str, Rendering] | None = None,
    *,
    progress: Progress,
) -> Evaluation:
    """Compare two clean scenes view by view."""
    used, chosen = _select_split(views, split)
    photographed = _have_photos(chosen)
    compared, blank = [], len(reference) > 0
    for done, view in enumerate(chosen):
        progress("evaluate", done / len(chosen))
        background = background_of(view, views.background)
        image = (reference_images or {}).get(view.name)
        if image is None:
            image = render_clamped(reference, view.camera, background, device, threads)
        if reference_images is not None:
            reference_images[view.name] = image
        other = render_clamped(candidate, view.camera, background, device, threads)
        blank = blank and bool((image == np.clip(background, 0, 1)).all())
        comparison = _compare(image, other, view.load_photo() if photographed else None, measure)
        compared.append(ViewComparison(view=view, comparison=comparison, origin=reference.origin))
    return Evaluation(
        against="photos" if photographed else "renderings",
        split=used,
        source=views.source,
        background=views.background,
        reference_count=len(reference),
        candidate_count=len(candidate),
        views=tuple(compared),
        note="; ".join(filter(None, [views.note, NOTHING_VISIBLE if blank else ""])),
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


def _select_split(views: Views, split: str) -> tuple[Split, tuple[View, ...]]:
    """Return the split that is used, and its views; if "test" is empty, those of "train"."""
    splits: dict[str, tuple[View, ...]] = {"test": views.test, "train": views.train, "all": views.all}
    used = "train" if split == "test" and not views.test else split
    if used not in splits:
        raise UnsupportedError(f"there is no split {split!r}; choose test, train or all")
    if not splits[used]:
        raise InvalidViewsError(
            f"there is no view to evaluate from: the split {used!r} of {views.source} is empty; choose another split"
        )
    _have_photos(splits[used])
    return cast(Split, used), splits[used]


def _compare(
    reference: Float32[np.ndarray, "H W 3"],
    candidate: Float32[np.ndarray, "H W 3"],
    photo: Shaped[np.ndarray, "H W 3"] | None,
    measure: Measure,
) -> Comparison:
    vs_reference = measure(candidate, reference)
    if photo is None:
        return Comparison(reference=None, candidate=vs_reference, candidate_vs_reference=vs_reference)
    return Comparison(
        reference=measure(reference, photo), candidate=measure(candidate, photo), candidate_vs_reference=vs_reference
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
