"""The choice of compaction and fine-tuning where the settings leave it open, and by a limited time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from kissgs.core.context import Context
from kissgs.core.resources import TORCH_MISSING, has_torch
from kissgs.pipeline.limited_time import CAPTURE_TIME, SearchTime, encode_seconds
from kissgs.settings import Preset, Settings

if TYPE_CHECKING:
    from kissgs.cameras.views import Views

NOT_TRAINED = (
    f"nothing was trained, which needs {TORCH_MISSING}; training makes containers smaller at equal quality, much "
    "smaller on photographs"
)

TOO_LITTLE_TIME = "there was too little time for training"

TRAINING_TIME, TUNING_TIME = 3.5, 5.0
"""Time from which training on photographs and fine-tuning on renderings of the scene pay, in units of an encoding
without training."""


@dataclass(frozen=True, slots=True)
class Choice:
    """Settings without anything open, the time for them, and a note of what the user may not expect."""

    settings: Settings
    time: SearchTime | None = None
    note: str = ""


def resolved(settings: Settings, views: Views | None, *, keep_all: bool = False, torch: bool | None = None) -> Settings:
    """Return the settings with what they leave open resolved, see :meth:`kissgs.Settings.resolved`. ``keep_all`` says
    that all Gaussians stay unless the settings request otherwise, ``torch`` whether it is installed."""
    if keep_all and settings.compact.auto_count is None:
        settings = settings.model_copy(update={"compact": settings.compact.model_copy(update={"auto_count": False})})
    photographs = None if views is None else views.has_photographs
    return settings.resolved(photographs=photographs, torch=has_torch() if torch is None else torch)


def choose(requested: Settings, views: Views | None, count: int, context: Context, *, keep_all: bool) -> Choice:
    """Choose what to do with ``count`` Gaussians until the deadline; the note also says where torch is missing."""
    chosen, time = {}, None
    if context.deadline is not None:
        time = SearchTime(context.deadline, encode_seconds(requested.preset, count, context.threads))
    for torch in {has_torch(), True}:
        settings = resolved(requested, views, keep_all=keep_all, torch=torch)
        chosen[torch] = in_time(requested, settings, time, count=count, captured=views is not None, torch=torch)
    found = chosen[has_torch()]
    if found.settings == chosen[True].settings:
        return found
    return Choice(found.settings, found.time, "; ".join(filter(None, [found.note, NOT_TRAINED])))


def in_time(
    requested: Settings, settings: Settings, time: SearchTime | None, *, count: int, captured: bool, torch: bool
) -> Choice:
    """Return the ``settings`` that were resolved as if there were time for everything, changed to fit into the time.
    Training that was not requested is left out where there is too little time for it, and the preset where even a plain
    encoding takes too long, unless a goal or a setting of the encoder is given. Without a goal and a capture, time that
    is left goes to fine-tuning on renderings of the scene."""
    if time is None:
        return Choice(settings)
    plain, left = time.encode_seconds, time.deadline.seconds
    if left >= TRAINING_TIME * plain and count > 1:
        tunes = requested.time_only and not captured and settings.finetune.enabled is None
        if tunes and torch and left >= TUNING_TIME * plain:
            settings = settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": True})})
        return Choice(settings, time)
    trained = settings.compact.auto_count and not requested.compact.auto_count
    settings = requested.resolved(photographs=False, torch=False)
    note = TOO_LITTLE_TIME if trained and count > 1 else ""
    if note and not settings.encode.has_goal:
        note += ", so nothing limits the loss but the preset"
    usual = Settings.from_preset(settings.preset, seed=settings.encode.seed).encode
    takes = plain * (CAPTURE_TIME if captured and settings.encode.rate_distortion else 1.0)
    if left >= takes or settings.preset == Preset.FAST or settings.encode != usual or settings.finetune.enabled:
        return Choice(settings, time, note)
    fast = Settings.from_preset(Preset.FAST, time_limit=settings.time_limit, seed=settings.encode.seed)
    return Choice(fast, time, f"encoded with the preset fast: {settings.preset} would take about {takes:.0f} s")
