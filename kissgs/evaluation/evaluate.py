"""Image metrics of a candidate's renderings against photographs and the reference's, and whether a capture fits."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import cast

import numpy as np

from kissgs.cameras.captures.colmap import gsplat_similarities
from kissgs.cameras.captures.load import as_views
from kissgs.cameras.photographs import orientation
from kissgs.cameras.views import Similarity, View, Views
from kissgs.core.array_types import Float32, Float64
from kissgs.core.context import DEFAULT_CONTEXT, Context, Device, JobProgress, Progress, load_kernels, silent
from kissgs.core.errors import InvalidViewsError, KissgsError, UnsupportedError
from kissgs.core.positions import Origin, with_origin
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.cameras import evaluation_views, farther
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, Split, ViewComparison
from kissgs.evaluation.scene_parts import share_shown
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import drawn_opacities
from kissgs.rendering.metrics import Flip, Lpips, ms_ssim, psnr, ssim_with_patches
from kissgs.rendering.rasterizer import render

# Whether a capture belongs to a scene: renderings are compared with some photographs, since a capture of another scene,
# or one whose cameras have other coordinates, would let an encoder remove what matters.

LEAST_PSNR, USUAL_PSNR = 12.0, 18.0
"""Median PSNR, decibels, below which a capture is refused, and below which a note says so. Images of different scenes
have about 8 to 12 dB; renderings of a trained scene have 20 to 35."""

FRAME_MARGIN = 3.0  # decibels by which a frame that no file states must be better than all others
COMPARED, SIDE = 5, 160  # photographs that are compared, and pixels on the longer side of each
CAMERAS = 16  # number of cameras that tell, where there are no photographs, how much of the scene they show
GAINS = 0.25, 4.0  # by which a photograph may be darker or brighter than renderings of the same scene
MIN_ALPHA = 0.02  # smallest mean alpha of a rendering that is compared where the scene is opaque

NOT_COMPARED = "no photograph of the capture can be compared with, so whether it belongs to this scene is not known"
"""Note on a capture whose cameras see the scene, but that has no photographs."""

_Sample = tuple[View, Float32[np.ndarray, "h w 3"]]


@dataclass(frozen=True, slots=True)
class _Fit:
    """How well a capture fits a scene."""

    seen: bool  # whether any rendering shows any of the scene
    psnr: float = math.nan  # median of renderings to photographs, decibels; NaN if there are none
    # Where the scene is opaque, with the best exposure of each photograph: scenes that were trained with masks or on
    # white have another background than the photographs, or than is known here.
    psnr_inside: float = math.nan
    shown: float = math.nan  # share of the scene that the cameras show, 0 to 1; NaN if there are photographs
    unread: str = ""  # why gsplat's normalisation could not be tried

    @property
    def quality(self) -> float:
        """The larger PSNR, decibels, or the share of the scene; -1 if nothing of the scene is seen."""
        if not self.seen:
            return -1.0
        return self.shown if math.isnan(self.psnr) else max(self.psnr, self.psnr_inside)

    def __str__(self) -> str:
        if math.isnan(self.psnr):
            return f"{100 * self.shown:.0f} % of the scene shown"
        return f"{self.quality:.1f} dB to the photographs" if self.seen else "nothing of the scene shown"


def in_scene_frame(splats: Splats, views: Views, context: Context = DEFAULT_CONTEXT) -> Views:
    """Return views with cameras in the coordinates of the scene; their note says if there was a choice. Each of
    :attr:`Views.similarities` is tried, and the best is kept if it is better than none: the one with the highest median
    PSNR to some photographs; without photographs, the one whose cameras show most of the scene. Where the photographs
    still do not show the scene, gsplat's normalisation of the world is tried, and kept if whole images then do."""
    samples = _samples(views) if views.similarities or views.points else []
    if not views.all or not (views.similarities or samples):
        return _moved(views, None, splats.origin)
    load_kernels(context.progress)
    context.progress("cameras", 0.0)
    moved, _, note = _best(splats, views, samples, context.threads)
    return replace(moved, note="; ".join(filter(None, [views.note, note])))


def fitting_views(
    splats: Splats, views: Views, context: Context = DEFAULT_CONTEXT, *, force: bool = False
) -> tuple[Views, str]:
    """Return views in the coordinates of the scene, as :func:`in_scene_frame` does, and what is odd about them.
    Photographs that do not show the scene are refused, unless ``force``."""
    if not views.all or not drawn_opacities(splats).any():
        return _moved(views, None, splats.origin), ""
    load_kernels(context.progress)
    context.progress("cameras", 0.0)
    samples, given = _samples(views), views
    views, fit, note = _best(splats, views, samples, context.threads, guess=not force)
    problem = _problem(fit, given, samples)
    refused = not fit.seen or (fit.psnr < LEAST_PSNR and fit.psnr_inside < USUAL_PSNR)
    if samples and not force and refused:
        problem = "; ".join(filter(None, [fit.unread, problem]))
        raise InvalidViewsError(
            f"{problem}: give the capture of this scene, with dataparser_transforms.json beside it if nerfstudio "
            "trained the scene, or its COLMAP model with its points3D if gsplat did, or --force-views (in Python "
            "force_views) to use it all the same"
        )
    return views, "; ".join(filter(None, [note, problem]))


def _problem(fit: _Fit, views: Views, samples: Sequence[_Sample]) -> str:
    if not fit.seen:
        return f"no rendering from the cameras of the capture ({views.source}) shows any of the scene"
    if not samples:
        return "; ".join(filter(None, [views.note, NOT_COMPARED]))
    if fit.psnr >= USUAL_PSNR:
        return ""
    paths = [view.photo for view, _ in samples if view.photo is not None]
    turned = "; their EXIF orientation is ignored here: turn the pixels ('mogrify -auto-orient')"
    turned = turned if any(orientation(path) != 1 for path in paths) else ""
    return (
        f"the photographs of the capture ({views.source}) differ much from renderings of the scene: PSNR "
        f"{fit.psnr:.1f} dB, the median of {len(samples)}, where more than {USUAL_PSNR:g} are usual{turned}"
    )


def _best(
    splats: Splats, views: Views, samples: Sequence[_Sample], threads: int, *, guess: bool = True
) -> tuple[Views, _Fit, str]:
    """Return the views in the coordinates that fit best, how well they fit, and a note if there was a choice. With
    ``guess``, gsplat's normalisation counts too, which no file states: it must show the scene in whole images, much
    better than any other; its four choices are many for parts of images, where some wrong scene may look right."""
    tried = tuple(view for view, _ in samples) or tuple(_spread(views.train or views.test, CAMERAS))

    def fit(similarity: Similarity | None) -> _Fit:
        moved = _moved(replace(views, train=tried, test=()), similarity, splats.origin).train
        if not samples:
            shown = share_shown(splats, [view.camera for view in moved], threads=threads)
            return _Fit(shown > 0, shown=shown)
        return _fit_to_photos(splats, [(view, photo) for view, (_, photo) in zip(moved, samples, strict=True)], threads)

    given = best = fit(None)
    chosen = None
    for similarity in views.similarities:
        found = fit(similarity)
        if found.quality > best.quality:
            best, chosen = found, similarity
    if guess and samples and best.quality < USUAL_PSNR and views.points is not None:
        try:
            guesses = gsplat_similarities(views.points, [view.camera.viewmat for view in views.all])
        except InvalidViewsError as error:  # in points that other trainers' scenes do not need
            guesses, best = (), replace(best, unread=str(error))
        ordered = sorted(((fit(each), each) for each in guesses), key=lambda pair: pair[0].psnr, reverse=True)
        if ordered and ordered[0][0].seen:
            second = max(best.psnr, ordered[1][0].psnr)
            if ordered[0][0].psnr >= max(USUAL_PSNR, second + FRAME_MARGIN):
                best, chosen = ordered[0]
    files = ", ".join(dict.fromkeys(similarity.source for similarity in views.similarities))
    views = _moved(views, chosen, splats.origin)
    if chosen is None:
        unused = f"the cameras fit the scene as they are ({given}), so {files} is not applied"
        return views, best, best.unread or (unused if ".json" in files else "")
    return views, best, f"the cameras are moved by {chosen.source} to fit the scene: {best} instead of {given}"


def _moved(views: Views, similarity: Similarity | None, origin: Origin) -> Views:
    """Return the views moved by a similarity of the world, in coordinates relative to ``origin``."""
    x, y, z = (new - old for new, old in zip(origin, views.origin, strict=True))

    def moved(part: tuple[View, ...]) -> tuple[View, ...]:
        return tuple((similarity.moved(view) if similarity else view).relative_to((x, y, z)) for view in part)

    return replace(views, train=moved(views.train), test=moved(views.test), similarities=(), points=None, origin=origin)


def _fit_to_photos(splats: Splats, samples: Sequence[_Sample], threads: int) -> _Fit:
    seen, whole, inside = False, list[float](), list[float]()
    for view, photo in samples:
        colour, alpha = render(splats, view.camera, threads=threads)
        seen |= bool(alpha.any())
        whole.append(psnr(np.clip(colour + (1 - alpha[:, :, None]) * view.background, 0, 1), photo))
        inside.append(_psnr_inside(np.clip(colour, 0, 1), alpha[:, :, None], photo))
    return _Fit(seen, float(np.median(whole)), float(np.median(inside)))


def _psnr_inside(
    colour: Float32[np.ndarray, "h w 3"], alpha: Float32[np.ndarray, "h w 1"], photo: Float32[np.ndarray, "h w 3"]
) -> float:
    """Return the PSNR where the scene is opaque; -∞ where it hardly is. ``colour`` is premultiplied by alpha."""
    if alpha.mean() < MIN_ALPHA:
        return -math.inf
    target = alpha * photo
    gain = np.clip((colour * target).sum() / max(float(np.square(target).sum()), 1e-12), *GAINS)
    error = np.square(colour - gain * target).sum() / (3 * np.square(alpha).sum())
    return float(-10 * np.log10(max(error, 1e-12)))


def _samples(views: Views) -> list[_Sample]:
    """Return samples of some photographs with their views; those that cannot be read are left to whoever needs them."""
    photographed = [view for view in views.train or views.test if view.photo is not None]
    samples = list[_Sample]()
    for view in _spread(photographed, COMPARED):
        sampled = view.sampled(math.ceil(max(view.camera.width, view.camera.height) / SIDE), (0, 0))
        with contextlib.suppress(KissgsError):
            photo = sampled.load_photo() / np.float32(255)
            samples.append((replace(sampled, background=background_of(view, views.background)), photo))
    return samples


def _spread(views: Sequence[View], most: int) -> list[View]:
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).astype(int))
    return [views[n] for n in chosen]


# Image metrics. Rounded to 8 bits, as published values often are, PSNR would end at about 59 dB; near 30 dB it hardly
# differs.

NOTHING_VISIBLE = "no rendering shows any of the reference, so these values mean nothing; choose other views"
"""Note of an evaluation whose views all miss the reference."""

Rendering = Float32[np.ndarray, "H W 3"]
Measure = Callable[[np.ndarray, np.ndarray], tuple[ImageMetrics, Float64[np.ndarray, "h w"]]]
"""Returns the metrics of an image against a target, and the SSIM of each patch."""


def evaluate(
    reference: Splats,
    candidate: Splats,
    views: Views | str | PathLike[str] | None = None,
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
        views: views of a capture, or its path; they are moved into the reference's coordinates if its files say how
            (:func:`kissgs.evaluation.evaluate.in_scene_frame`). Without photographs, the candidate is compared only
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
    views = as_views(views)
    given = 0 if views is None else len(_select_split(views, split)[1])  # an empty split is refused before any work
    progress = JobProgress(progress, [("kernels", 0.5), ("cameras", 1.0), ("evaluate", 2.0)])
    context = Context(threads, device, progress)
    if views is not None:
        views = in_scene_frame(reference, views, context)
    load_kernels(progress)
    drawn = farther(evaluation_views(reference, context, seed=seed), distance)
    total = given + len(drawn.test)

    def compared(views: Views, split: Split, before: int, count: int) -> Evaluation:
        def advance(stage: str, fraction: float, note: str = "", /) -> None:
            progress(stage, (before + fraction * count) / total)

        found = _compare_views(reference, candidate, views, split, measure, replace(context, progress=advance))
        return replace(found, shown=share_shown(reference, [each.view.camera for each in found.views], threads=threads))

    evaluation = None if views is None else compared(views, split, 0, given)
    surroundings = compared(drawn, "all", given, len(drawn.test))
    progress("evaluate", 1.0)
    progress.stop()
    return surroundings if evaluation is None else replace(evaluation, surroundings=surroundings)


def compare_images(
    reference: Splats,
    candidate: Splats,
    views: Views,
    context: Context = DEFAULT_CONTEXT,
    *,
    reference_images: dict[int, Rendering] | None = None,
    lpips: bool = False,
) -> Evaluation:
    """Compare two scenes from these views alone: the test views, or the training views if there are none.
    ``reference_images`` are the reference's renderings by number of the view, read and filled, for comparisons of many
    candidates with one reference."""
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    if context.device == "cpu":
        load_kernels(context.progress)
    measure = _measure(False, lpips, context.device)
    evaluation = _compare_views(reference, candidate, views, "test", measure, context, reference_images)
    context.progress("evaluate", 1.0)
    return evaluation


def _compare_views(
    reference: Splats,
    candidate: Splats,
    views: Views,
    split: Split,
    measure: Measure,
    context: Context,
    reference_images: dict[int, Rendering] | None = None,
) -> Evaluation:
    """Compare two clean scenes view by view."""
    used, chosen = _select_split(views, split)
    photographed = chosen[0].photo is not None
    compared, blank = [], len(reference) > 0
    for done, view in enumerate(chosen):
        context.progress("evaluate", done / len(chosen))
        background = background_of(view, views.background)
        image = (reference_images or {}).get(done)
        if image is None:
            image = render_clamped(reference, view.camera, background, context)
        if reference_images is not None:
            reference_images[done] = image
        other = render_clamped(candidate, view.camera, background, context)
        blank = blank and bool((image == np.clip(background, 0, 1)).all())
        found, patches = measure(other, image)
        comparison, changes = Comparison(reference=None, candidate=found, candidate_vs_reference=found), patches - 1
        if photographed:
            photo = view.load_photo()
            (before, patches_before), (after, patches_after) = measure(image, photo), measure(other, photo)
            comparison = Comparison(reference=before, candidate=after, candidate_vs_reference=found)
            changes = patches_after - patches_before
        origin = reference.origin
        compared.append(ViewComparison(view=view, comparison=comparison, patch_changes=changes, origin=origin))
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


def render_clamped(splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], context: Context) -> Rendering:
    """Return a rendering with its values clamped to [0, 1]."""
    colour = background.tolist()
    image, _ = render(splats, camera, background=colour, threads=context.threads, device=context.device)
    return np.clip(image, 0, 1)


def _measure(flip: bool, lpips: bool, device: Device) -> Measure:
    perceptual: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {}
    perceptual |= {"flip": Flip()} if flip else {}
    perceptual |= {"lpips": Lpips(device)} if lpips else {}

    def measure(image: np.ndarray, target: np.ndarray) -> tuple[ImageMetrics, Float64[np.ndarray, "h w"]]:
        mean, patches = ssim_with_patches(image, target)
        others = {name: distance(image, target) for name, distance in perceptual.items()}
        metrics = ImageMetrics(psnr=psnr(image, target), ssim=mean, ms_ssim=ms_ssim(image, target), **others)
        return metrics, patches

    return measure


def _select_split(views: Views, split: str) -> tuple[Split, tuple[View, ...]]:
    """Return the split that is used, and its views; if "test" is empty, those of "train". All of them have photographs,
    or none has."""
    splits: dict[str, tuple[View, ...]] = {"test": views.test, "train": views.train, "all": views.all}
    used = "train" if split == "test" and not views.test else split
    if used not in splits:
        raise UnsupportedError(f"there is no split {split!r}; choose test, train or all")
    if not splits[used]:
        raise InvalidViewsError(
            f"there is no view to evaluate from: the split {used!r} of {views.source} is empty; choose another split"
        )
    without = [view.name for view in splits[used] if view.photo is None]
    if without and len(without) < len(splits[used]):
        raise InvalidViewsError(
            f"{len(without)} of {len(splits[used])} views have no photograph, the first is {without[0]!r}; give all "
            "views a photograph, or none"
        )
    return cast(Split, used), splits[used]
