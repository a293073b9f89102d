"""Evaluation of compacted scenes: image quality in views that no training used, and the size of the container."""

from __future__ import annotations

from functools import partial

from kissgs.cameras.views import Views
from kissgs.compaction.step_log import StepLog
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import ImageMetrics
from kissgs.settings import Preset, Settings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.encode import encode
from kissgs.training.supervision import SupervisionViews


def evaluate_scene(
    scene: Splats, reference: Splats, supervision: SupervisionViews, threads: int = 0, progress: Progress = silent
) -> tuple[ImageMetrics, int]:
    """Return the image metrics of a scene and its compressed size.

    Args:
        scene: the scene to evaluate, clean.
        reference: the original scene; its renderings are compared with if there are no photographs.
        supervision: its evaluation views are used if they have photographs, else cameras drawn over all of
            ``reference``.
        threads: number of threads; 0 means one per processor. The result does not depend on it.
        progress: receives the stage ``"evaluate"``.

    Returns:
        Metrics to photographs if there are any, means over the views, and the bytes of a container with the preset
        ``fast``, as a zip.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: an image would take too much memory.
    """
    as_evaluate = as_stage("evaluate", progress)
    views = _views(reference, supervision, threads, as_evaluate)
    evaluation = compare_images(reference, scene, views, threads=threads, progress=as_evaluate)
    encoded = encode(scene, Settings(preset=Preset.FAST).encode, threads=threads, progress=as_evaluate)
    return evaluation.mean.candidate, len(zip_bytes(encoded.files))


def step_log(
    evaluate: bool, reference: Splats, supervision: SupervisionViews, threads: int, progress: Progress
) -> StepLog:
    """Return an empty log, which evaluates each step if ``evaluate``; see :func:`evaluate_scene`."""
    if not evaluate:
        return StepLog(None)
    return StepLog(
        partial(evaluate_scene, reference=reference, supervision=supervision, threads=threads, progress=progress)
    )


def _views(reference: Splats, supervision: SupervisionViews, threads: int, progress: Progress) -> Views:
    """Return the evaluation views of a capture with photographs, else cameras drawn over the whole scene."""
    if any(view.photo is not None for view in supervision.test):
        return supervision.eval_views
    return evaluation_views(reference, threads=threads, progress=progress)
