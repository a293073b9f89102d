"""Choice of what a limited time is used for: training, the preset, or the fastest preset."""

from __future__ import annotations

from dataclasses import dataclass

from kissgs.core.deadline import Deadline
from kissgs.pipeline.machine_speed import encode_seconds
from kissgs.pipeline.search_time import CAPTURE_TIME, SearchTime
from kissgs.settings import Preset, Settings

TRAINING_TIME = 3.5
"""Time from which training on photographs pays, in units of an encoding without training."""

TUNING_TIME = 5.0
"""Time from which fine-tuning on renderings of the scene pays, in the same unit."""

TOO_LITTLE_TIME = "there was too little time for training"
"""Note where training is left out."""


@dataclass(frozen=True, slots=True)
class TimePlan:
    """How a limited time is used.

    Attributes:
        settings: settings that fit into the time.
        time: the time, for a search that trains; None for no limit.
        note: what the user may not expect; empty if there is nothing to say.
    """

    settings: Settings
    time: SearchTime | None = None
    note: str = ""


def time_plan(
    requested: Settings,
    settings: Settings,
    count: int,
    deadline: Deadline | None,
    *,
    captured: bool,
    torch: bool,
    threads: int,
) -> TimePlan:
    """Choose what to do in the time that is left for a scene.

    Training that was not requested is left out where there is too little time for it, and the preset where even a
    plain encoding takes too long, unless a goal or a setting of the encoder is given. Without a goal and a capture,
    time that is left goes to fine-tuning on renderings of the scene.

    Args:
        requested: settings as requested.
        settings: the same with what they leave open decided, as if there were time for everything.
        count: number of Gaussians.
        deadline: time until which the container shall be ready; None for no limit.
        captured: whether there is a capture.
        torch: whether torch is installed, which training needs.
        threads: number of threads; 0 means one per processor.
    """
    if deadline is None:
        return TimePlan(settings)
    plain, left = encode_seconds(settings.preset, count, threads), deadline.seconds
    time = SearchTime(deadline, plain)
    if left >= TRAINING_TIME * plain and count > 1:
        tunes = requested.aims and not captured and settings.finetune.enabled is None
        if tunes and torch and left >= TUNING_TIME * plain:
            settings = settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": True})})
        return TimePlan(settings, time)
    trained = settings.compact.auto_count and not requested.compact.auto_count
    settings = requested.decided(photographs=False, torch=False)
    note = TOO_LITTLE_TIME if trained and count > 1 else ""
    if note and not settings.encode.has_goal:
        note += ", so nothing limits the loss but the preset"
    usual = Settings.from_preset(settings.preset, seed=settings.encode.seed).encode
    takes = plain * (CAPTURE_TIME if captured and settings.encode.rate_distortion else 1.0)
    if left >= takes or settings.preset == Preset.FAST or settings.encode != usual or settings.finetune.enabled:
        return TimePlan(settings, time, note)
    fast = Settings.from_preset(Preset.FAST, time_limit=settings.time_limit, seed=settings.encode.seed)
    return TimePlan(fast, time, f"encoded with the preset fast: {settings.preset} would take about {takes:.0f} s")
