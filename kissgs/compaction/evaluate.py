"""How good a smaller scene is: its pictures from views that it has not learned from, and the bytes it will take."""

from __future__ import annotations

from kissgs.cameras.views import Views
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import ImageMetrics
from kissgs.settings import Preset, Settings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.encode import encode
from kissgs.training.supervision import SupervisionViews


def exam(reference: Splats, supervision: SupervisionViews, threads: int = 0, progress: Progress = silent) -> Views:
    """Views to judge by: a capture's held-out photographs, or else cameras drawn over the whole scene."""
    if any(view.photo is not None for view in supervision.test):
        return supervision.eval_views
    return evaluation_views(reference, threads=threads, progress=progress)


def evaluate_scene(
    scene: Splats, reference: Splats, supervision: SupervisionViews, threads: int = 0, progress: Progress = silent
) -> tuple[ImageMetrics, int]:
    """How alike its pictures are to the photographs, or to those of ``reference`` where there are none; and its bytes.

    The bytes are those of its container with the preset ``fast``. ``progress`` receives the stage ``"evaluate"``.
    """
    receive = as_stage("evaluate", progress)
    views = exam(reference, supervision, threads, receive)
    compared = compare_images(reference, scene, views, threads=threads, progress=receive)
    encoded = encode(scene, Settings(preset=Preset.FAST).encode, threads=threads, progress=receive)
    return compared.mean.candidate, len(zip_bytes(encoded.files))
