"""What a compressed scene looks like beside the original: PSNR, SSIM and LPIPS of pictures taken from the same places.

Pictures are clamped to [0, 1], as a screen clamps them, but not rounded to 8 bits: rounding would put a floor of some
59 dB under every error. (Published figures often come from 8-bit files; near 30 dB that is less than 0.01 dB.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from kissgs._typing import Float32, Shaped
from kissgs.errors import InvalidViewsError, UnsupportedError
from kissgs.evaluation.likeness import Comparison, Evaluation, Likeness, Split, ViewComparison
from kissgs.progress import Progress, silent
from kissgs.rendering.camera import Camera
from kissgs.rendering.lpips import Lpips
from kissgs.rendering.metrics import psnr, ssim
from kissgs.rendering.rasterizer import Device, load_kernels, render
from kissgs.splats import Splats, clean
from kissgs.views.view import View, Views

NOTHING_SEEN = (
    "no picture shows anything of the reference, so these figures say nothing; choose other cameras (--views)"
)


def evaluate(
    reference: Splats,
    candidate: Splats,
    views: Views | None = None,
    *,
    split: Split = "test",
    lpips: bool = False,
    device: Device = "cpu",
    threads: int = 0,
    progress: Progress = silent,
) -> Evaluation:
    """Take the same pictures of two scenes, and compare them with the photographs, if there are any, and each other.

    The pictures of one view are in memory at a time. They are clamped to [0, 1] and not rounded to 8 bits.

    Args:
        reference: the scene as it was; cleaned first, as is the candidate.
        candidate: what became of it. Gaussians need not be as many, nor in the same order.
        views: from where; by default virtual cameras around the reference. Without photographs, the candidate is
            compared with the reference's renderings alone.
        split: the views to use. Where "test" has none, it is "train", which the result says.
        lpips: compute LPIPS too, which needs the extra ``kissgs[lpips]``.
        device: ``"cuda"`` needs the extra ``kissgs[cuda]``.
        threads: of the processor; 0 means one each. The figures do not depend on it.
        progress: receives the stages ``"kernels"``, ``"cameras"`` (of virtual ones) and ``"evaluate"``.

    Raises:
        InvalidViewsError: there is no view to use; some of them have photographs and some have not; a photograph
            cannot be read.
        UnsupportedError: a picture would take too much memory; no CUDA or no LPIPS here; no such split.
    """
    reference, candidate = clean(reference)[0], clean(candidate)[0]
    measure = _measure(lpips, device)
    if device == "cpu" or views is None:
        load_kernels(progress)
    if views is None:
        from kissgs.views.virtual import virtual_views

        views = virtual_views(reference, threads=threads, progress=progress)
    used, chosen = _views_to_use(views, split)
    photographed = _have_photos(chosen)
    compared, blank = [], len(reference) > 0
    for done, view in enumerate(chosen):
        progress("evaluate", done / len(chosen))
        scenes = (reference, candidate)
        pictures = [take_picture(scene, view.camera, views.background, device, threads) for scene in scenes]
        blank = blank and bool((pictures[0] == np.clip(views.background, 0, 1)).all())
        photo = view.load_photo() if photographed else None
        compared.append(ViewComparison(view=view, comparison=_compare(pictures[0], pictures[1], photo, measure)))
    progress("evaluate", 1.0)
    return Evaluation(
        against="photos" if photographed else "renderings",
        split=used,
        source=views.source,
        background=views.background,
        reference_count=len(reference),
        candidate_count=len(candidate),
        views=tuple(compared),
        note="; ".join(filter(None, [views.note, NOTHING_SEEN if blank else ""])),
    )


def take_picture(
    splats: Splats, camera: Camera, background: Float32[np.ndarray, "3"], device: Device, threads: int
) -> Float32[np.ndarray, "H W 3"]:
    """What a screen would show: clamped to [0, 1]."""
    image, _ = render(splats, camera, background=background.tolist(), threads=threads, device=device)
    return np.clip(image, 0, 1)


Measure = Callable[[np.ndarray, np.ndarray], Likeness]


def _measure(lpips: bool, device: Device) -> Measure:
    perceptual = Lpips(device) if lpips else None

    def measure(image: np.ndarray, target: np.ndarray) -> Likeness:
        distance = None if perceptual is None else perceptual(image, target)
        return Likeness(psnr=psnr(image, target), ssim=ssim(image, target), lpips=distance)

    return measure


def _views_to_use(views: Views, split: str) -> tuple[Split, tuple[View, ...]]:
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
    return cast(Split, used), parts[used]


def _compare(
    reference: Float32[np.ndarray, "H W 3"],
    candidate: Float32[np.ndarray, "H W 3"],
    photo: Shaped[np.ndarray, "H W 3"] | None,
    measure: Measure,
) -> Comparison:
    between = measure(candidate, reference)
    if photo is None:
        return Comparison(reference=None, candidate=between, between=between)
    return Comparison(reference=measure(reference, photo), candidate=measure(candidate, photo), between=between)


def _have_photos(views: Sequence[View]) -> bool:
    without = [view.name for view in views if view.photo is None]
    if without and len(without) < len(views):
        raise InvalidViewsError(
            f"{len(without)} of {len(views)} views have no photograph, the first is {without[0]!r}; give all of them "
            "one, or none"
        )
    return not without
