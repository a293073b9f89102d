"""Whether a capture belongs to a scene: renderings of the scene are compared with some of its photographs.

A capture of another scene, or one whose cameras have other coordinates, would let an encoder remove what matters.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.photographs import orientation
from kissgs.cameras.views import Similarity, View, Views
from kissgs.core.array_types import Float32
from kissgs.core.errors import InvalidViewsError, KissgsError
from kissgs.core.origin import Origin
from kissgs.core.progress import Progress, load_kernels, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.scene_parts import drawn_opacities, share_shown
from kissgs.rendering.metrics import psnr
from kissgs.rendering.rasterizer import render

LEAST_PSNR, USUAL_PSNR = 12.0, 18.0
"""Median PSNR, decibels, below which a capture is refused, and below which a note says so. Images of different scenes
have about 8 to 12 dB; renderings of a trained scene have 20 to 35."""

COMPARED, SIDE = 5, 160
"""Number of photographs that are compared, and of pixels on the longer side of each, samples of the photograph."""

CAMERAS = 16
"""Number of cameras that tell, where there are no photographs, how much of the scene they show."""

GAINS = 0.25, 4.0
"""Limits of the factor by which a photograph may be darker or brighter than renderings of the same scene."""

MIN_ALPHA = 0.02
"""Smallest mean alpha of a rendering that is compared where the scene is opaque."""

NOT_COMPARED = "no photograph of the capture can be compared with, so whether it belongs to this scene is not known"
"""Note on a capture whose cameras see the scene, but that has no photographs."""

_Sample = tuple[View, Float32[np.ndarray, "h w 3"]]


@dataclass(frozen=True, slots=True)
class _Fit:
    """How well a capture fits a scene.

    ``psnr_inside`` is that where the scene is opaque, with the best exposure of each photograph: scenes that were
    trained with masks or on white have another background than the photographs, or than is known here.
    """

    seen: bool  # whether any rendering shows any of the scene
    psnr: float  # median of renderings to photographs, decibels; NaN if there are none
    psnr_inside: float
    shown: float  # share of the scene that the cameras show, 0 to 1; NaN if there are photographs

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


def in_scene_frame(splats: Splats, views: Views, *, threads: int = 0, progress: Progress = silent) -> Views:
    """Return views with cameras in the coordinates of the scene; their note says if there was a choice.

    Each of :attr:`Views.similarities` is tried, and the best is kept if it is better than none: the one with the
    highest median PSNR to some photographs; without photographs, the one whose cameras show most of the scene.
    """
    if not views.similarities or not views.all:
        return _moved(views, None, splats.origin)
    load_kernels(progress)
    progress("cameras", 0.0)
    moved, _, note = _best(splats, views, _samples(views), threads)
    return replace(moved, note="; ".join(filter(None, [views.note, note])))


def fitting_views(
    splats: Splats, views: Views, *, force: bool = False, threads: int = 0, progress: Progress = silent
) -> tuple[Views, str]:
    """Return views in the coordinates of the scene, as :func:`in_scene_frame` does, and what is odd about them.

    Photographs that do not show the scene are refused, unless ``force``.
    """
    if not views.all or not drawn_opacities(splats).any():
        return _moved(views, None, splats.origin), ""
    load_kernels(progress)
    progress("cameras", 0.0)
    samples, source = _samples(views), views.source
    views, fit, note = _best(splats, views, samples, threads)
    problem = _problem(fit, source, samples)
    refused = not fit.seen or (fit.psnr < LEAST_PSNR and fit.psnr_inside < USUAL_PSNR)
    if samples and not force and refused:
        raise InvalidViewsError(
            f"{problem}: give the capture of this scene, with dataparser_transforms.json beside it if nerfstudio "
            "trained the scene, or --force-views (in Python force_views) to use it all the same"
        )
    return views, "; ".join(filter(None, [note, problem]))


def _problem(fit: _Fit, source: str, samples: Sequence[_Sample]) -> str:
    if not fit.seen:
        return f"no rendering from the cameras of the capture ({source}) shows any of the scene"
    if not samples:
        return NOT_COMPARED
    if fit.psnr >= USUAL_PSNR:
        return ""
    paths = [view.photo for view, _ in samples if view.photo is not None]
    turned = "; their EXIF orientation is ignored here: turn the pixels ('mogrify -auto-orient')"
    turned = turned if any(orientation(path) != 1 for path in paths) else ""
    return (
        f"the photographs of the capture ({source}) differ much from renderings of the scene: PSNR {fit.psnr:.1f} dB, "
        f"the median of {len(samples)}, where more than {USUAL_PSNR:g} are usual{turned}"
    )


def _best(splats: Splats, views: Views, samples: Sequence[_Sample], threads: int) -> tuple[Views, _Fit, str]:
    """Return the views in the coordinates that fit best, how well they fit, and a note if there was a choice."""
    shown = tuple(view for view, _ in samples) or _spread(views.train or views.test, CAMERAS)

    def fit(similarity: Similarity | None) -> _Fit:
        moved = _moved(replace(views, train=tuple(shown), test=()), similarity, splats.origin).train
        if not samples:
            return _fit_of_cameras(splats, moved, threads)
        return _fit_to_photos(splats, [(view, photo) for view, (_, photo) in zip(moved, samples, strict=True)], threads)

    given = best = fit(None)
    chosen = None
    for similarity in views.similarities:
        found = fit(similarity)
        if found.quality > best.quality:
            best, chosen = found, similarity
    files = ", ".join(dict.fromkeys(similarity.source for similarity in views.similarities))
    views = _moved(views, chosen, splats.origin)
    if chosen is None:
        unused = f"the cameras fit the scene as they are ({given}), so {files} is not applied"
        return views, best, unused if ".json" in files else ""
    return views, best, f"the cameras are moved by {chosen.source} to fit the scene: {best} instead of {given}"


def _moved(views: Views, similarity: Similarity | None, origin: Origin) -> Views:
    """Return the views moved by a similarity of the world, in coordinates relative to ``origin``."""
    x, y, z = (new - old for new, old in zip(origin, views.origin, strict=True))

    def moved(part: tuple[View, ...]) -> tuple[View, ...]:
        return tuple((similarity.moved(view) if similarity else view).relative_to((x, y, z)) for view in part)

    return replace(views, train=moved(views.train), test=moved(views.test), similarities=(), origin=origin)


def _fit_to_photos(splats: Splats, samples: Sequence[_Sample], threads: int) -> _Fit:
    seen, whole, inside = False, list[float](), list[float]()
    for view, photo in samples:
        colour, alpha = render(splats, view.camera, threads=threads)
        seen |= bool(alpha.any())
        whole.append(psnr(np.clip(colour + (1 - alpha[:, :, None]) * view.background, 0, 1), photo))
        inside.append(_psnr_inside(np.clip(colour, 0, 1), alpha[:, :, None], photo))
    return _Fit(seen, float(np.median(whole)), float(np.median(inside)), math.nan)


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


def _fit_of_cameras(splats: Splats, views: Sequence[View], threads: int) -> _Fit:
    shown = share_shown(splats, [view.camera for view in views], threads=threads)
    return _Fit(shown > 0, math.nan, math.nan, shown)


def _samples(views: Views) -> list[_Sample]:
    """Return samples of some photographs with their views; those that cannot be read are left to whoever needs them."""
    photographed = [view for view in views.train or views.test if view.photo is not None]
    samples = list[_Sample]()
    for view in _spread(photographed, COMPARED):
        sampled = view.sampled(math.ceil(max(view.camera.width, view.camera.height) / SIDE), (0, 0))
        with contextlib.suppress(KissgsError):
            photo = sampled.load_photo() / np.float32(255)
            background = views.background if view.background is None else view.background
            samples.append((replace(sampled, background=background), photo))
    return samples


def _spread(views: Sequence[View], most: int) -> list[View]:
    chosen = np.unique(np.linspace(0, len(views) - 1, min(most, len(views))).astype(int))
    return [views[n] for n in chosen]
