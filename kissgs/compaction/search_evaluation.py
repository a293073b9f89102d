"""``SearchEvaluation``: how far the candidates of a search are from the original scene."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from kissgs.cameras.views import Views
from kissgs.cameras.virtual.samples import random_poses
from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import BACKGROUNDS, evaluation_views
from kissgs.evaluation.evaluate import Rendering, compare_images
from kissgs.evaluation.results import SEARCH_SEED, Evaluation

COUNT, SIDE = 24, 320  # number and side, pixels, of the views without a capture, but for those drawn over the scene
KEPT_PIXELS = 2**24  # of a capture's held-out views up to which renderings of the original are kept, 0.2 GB


@dataclass(slots=True, eq=False)
class SearchEvaluation:
    """Compares candidates with the original scene in views that nothing is trained or planned with. With a capture
    these are held-out views of it. Without one they are random poses from which photographs might have been taken, and
    their ``surroundings`` cameras drawn over the whole scene. What a container loses in such poses is near what it
    loses in photographs: for fox 0.7 to 1.5 dB more PSNR to the original, with and without training. Drawn cameras find
    3 to 4 dB more without training and 0.5 with it, but they see every part of the scene."""

    original: Splats
    views: Views | None  # the capture, or some of its held-out views
    seconds: float = field(init=False, default=0.0)  # that the latest comparison took
    _poses: Views | None = field(init=False, default=None)
    _drawn: Views | None = field(init=False, default=None)
    _images: dict[int, Rendering] = field(init=False, default_factory=dict)
    _drawn_images: dict[int, Rendering] = field(init=False, default_factory=dict)

    def __call__(self, candidate: Splats, context: Context = DEFAULT_CONTEXT) -> Evaluation:
        """Evaluate a candidate, always on the CPU; reports the stages "cameras", "kernels" and "evaluate"."""
        started = time.perf_counter()
        found = self._evaluation(candidate, replace(context, device="cpu"))
        self.seconds = time.perf_counter() - started
        return found

    def _evaluation(self, candidate: Splats, context: Context) -> Evaluation:
        if self.views is not None:
            pixels = sum(view.camera.width * view.camera.height for view in self.views.test)
            images = self._images if pixels <= KEPT_PIXELS else None
            return compare_images(self.original, candidate, self.views, context, reference_images=images)
        if self._poses is None or self._drawn is None:
            poses = random_poses(self.original, context, side=SIDE, count=COUNT, seed=SEARCH_SEED)
            self._drawn = evaluation_views(self.original, context, seed=SEARCH_SEED)
            levels = [np.full(3, level, np.float32) for level in BACKGROUNDS]  # on black, dark parts do not show
            views = enumerate(poses.train + poses.test)
            test = tuple(replace(view, background=levels[n % len(levels)]) for n, view in views)
            self._poses = replace(poses, train=(), test=test)
        scenes = self.original, candidate
        found = compare_images(*scenes, self._poses, context, reference_images=self._images)
        around = compare_images(*scenes, self._drawn, context, reference_images=self._drawn_images)
        return replace(found, surroundings=around)
