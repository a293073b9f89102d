"""Settings of the files of a level."""

from __future__ import annotations

from kissgs.settings import EncodeSettings

COARSER_DB = 6.0
"""Decibels by which coarser levels are encoded less accurately, with rate-distortion planning."""

COARSER_STEPS = 1.6
"""Steps of coarser levels of SH degree 0 in units of the finest level's, without rate-distortion planning."""


def file_settings(settings: EncodeSettings, level: int, sh_degree: int) -> EncodeSettings:
    """Return the settings of the files of a level.

    There is one class of steps: within each leaf, classes would have an order of their own, which costs 5 % of the
    bytes. Coarser levels are encoded less accurately, because the error of merging is larger than that of the finest
    level's encoding; where there is no codebook that could be smaller, the steps are larger. docs/method/streaming.md
    has what it saves and costs.
    """
    settings = settings.model_copy(update={"step_classes": 1})
    if level == 0:
        return settings
    if settings.rate_distortion:
        return settings.model_copy(update={"quality_offset_db": settings.quality_offset_db - COARSER_DB})
    changes = {"means_tolerance": min(1.0, 2 * settings.means_tolerance)}
    if sh_degree > 0:
        changes["gaussians_per_codebook_entry"] = min(4096.0, 2 * settings.gaussians_per_codebook_entry)
    else:
        steps = ("opacity_step", "scale_step", "quat_step", "sh0_step")
        changes |= {name: COARSER_STEPS * getattr(settings, name) for name in steps}
    return settings.model_copy(update=changes)
