"""Encoding plans for fine-tuning tests, their scenes, and interruptions."""

import itertools

import numpy as np

from helpers.training_scenes import around, cloud
from kissgs import Settings
from kissgs.cameras.views import black
from kissgs.core.context import Context
from kissgs.planning.planner import plan_encoding
from kissgs.planning.quantize import EVEN_LEVELS
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity

FIELDS = ("means", "opacities", "scales", "quaternions", "f_dc", "f_rest_centroids")


class Interrupted(Exception):
    """Raised from a progress callback."""


def stopping_after(steps, stage=None):
    """Return a progress callback that raises :class:`Interrupted` after some training steps, of a stage or of all."""
    remaining = itertools.count(steps - 1, -1)

    def progress(now, fraction, note=""):
        if stage in (None, now) and note and next(remaining) < 0:
            raise Interrupted

    return progress


def chosen(scene, preset="balanced", container=EVEN_LEVELS, **changes):
    """Return the plan that ``compress`` makes."""
    settings = Settings.research(preset, **changes).encode
    sensitivity = None
    if settings.rate_distortion:
        cameras = [view.camera for view in around(4)]
        sensitivity = measure_sensitivity(
            scene, WeightedCameras(cameras, [1.0] * len(cameras), black()), view_uncertainty=0.3
        )
    return plan_encoding(scene, settings, Context(1), sensitivity=sensitivity, container=container)


def choices():
    """Return scenes and presets: every planning and SH degree, few and many Gaussians, and constant ones."""
    found = [(cloud(count, degree, seed=count), "balanced") for count in (1, 7, 8, 9) for degree in (0, 1, 2, 3)]
    found += [(cloud(300, degree), preset) for degree in (0, 3) for preset in ("fast", "balanced", "paper")]
    constant = cloud(40, 1).select(np.zeros(40, int))
    return [*found, (constant, "balanced"), (constant, "paper")]


def shuffled(work, seed=0, far=3.0):
    """Move all latents randomly."""
    rng = np.random.default_rng(seed)
    for name, latents in work.latents.items():
        latents.data += latents.new_tensor(rng.normal(0, far, latents.shape))
        latents.data.clamp_(work.planes[name].min_latent, work.planes[name].max_latent)
    for name, latents in work.table_latents.items():
        latents.data += latents.new_tensor(rng.normal(0, 0.3, latents.shape))
        latents.data.clamp_(work.trained_tables[name].min_latent, work.trained_tables[name].max_latent)
    turned = work.latents["quaternions"].data
    if turned.shape[1] == 3:  # three components of a rotation must leave room for the fourth
        turned[work.planes["quaternions"].values(turned).square().sum(dim=1) > 1] = 0
