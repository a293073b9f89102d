"""Evaluations with given metrics of each view."""

import numpy as np

from kissgs.cameras.views import View
from kissgs.evaluation.results import Comparison, Evaluation, ImageMetrics, ViewComparison
from kissgs.rendering.camera import look_at

CAMERA = look_at(np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), fov=1.0, width=4, height=4)


def metrics(psnr, ssim=0.5):
    return ImageMetrics(psnr=psnr, ssim=ssim, ms_ssim=0.5)


def compared(reference, candidate, to_reference):
    """Return the comparison of a view by the metrics of its images; ``reference`` is None without a photograph."""
    return Comparison(reference=reference, candidate=candidate, candidate_vs_reference=to_reference)


def evaluation_with(comparisons, patch_changes=None):
    """Return an evaluation of views with one camera, named by their indices; without patches' changes, of none."""
    patch_changes = patch_changes or [np.zeros((1, 1))] * len(comparisons)
    return Evaluation(
        against="photos" if comparisons[0].reference else "renderings",
        split="all",
        source="",
        background=np.zeros(3, np.float32),
        reference_count=1,
        candidate_count=1,
        views=tuple(
            ViewComparison(view=View(f"{number}", CAMERA), comparison=each, patch_changes=changes)
            for number, (each, changes) in enumerate(zip(comparisons, patch_changes, strict=True))
        ),
    )


def evaluation_of(psnrs, photo_psnrs=None):
    """Return an evaluation; ``photo_psnrs``: PSNRs of reference and candidate to the photograph of each view."""
    if photo_psnrs is None:
        return evaluation_with([compared(None, metrics(psnr), metrics(psnr)) for psnr in psnrs])
    pairs = zip(photo_psnrs, psnrs, strict=True)
    return evaluation_with([compared(metrics(one), metrics(other), metrics(psnr)) for (one, other), psnr in pairs])
