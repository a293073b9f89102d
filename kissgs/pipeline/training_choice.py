"""The choice of compaction and fine-tuning where the settings leave it open."""

from __future__ import annotations

from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING

from kissgs.core.progress import Deadline
from kissgs.pipeline.search_time import TimePlan, time_plan
from kissgs.settings import Settings

if TYPE_CHECKING:
    from kissgs.cameras.views import Views

NOT_TRAINED = (
    "nothing was trained, because torch is missing: pip install 'kissgs[train]'; training makes "
    "containers smaller at equal quality, much smaller on photographs"
)


def decided(settings: Settings, views: Views | None, *, keep_all: bool = False, torch: bool | None = None) -> Settings:
    """Return the settings with what they leave open decided, see :meth:`kissgs.Settings.decided`.

    Args:
        settings: settings as requested.
        views: capture of the scene; None for no capture.
        keep_all: whether all Gaussians stay unless the settings request otherwise.
        torch: whether to decide as if torch were installed; None for whether it is.
    """
    if keep_all and settings.compact.auto_count is None:
        settings = settings.model_copy(update={"compact": settings.compact.model_copy(update={"auto_count": False})})
    photographs = None if views is None else has_photographs(views)
    return settings.decided(photographs=photographs, torch=has_torch() if torch is None else torch)


def work_plan(
    settings: Settings, views: Views | None, count: int, deadline: Deadline | None, *, keep_all: bool, threads: int
) -> TimePlan:
    """Return what to do; its note says what the user may not expect, also where torch is missing.

    Args:
        settings: settings as requested.
        views: capture of the scene; None for no capture.
        count: number of Gaussians.
        deadline: time until which the container shall be ready; None for no limit.
        keep_all: see :func:`decided`.
        threads: number of threads; 0 means one per processor.
    """

    def plan(torch: bool) -> TimePlan:
        chosen, captured = decided(settings, views, keep_all=keep_all, torch=torch), views is not None
        return time_plan(settings, chosen, count, deadline, captured=captured, torch=torch, threads=threads)

    present, best = plan(has_torch()), plan(True)
    missing = "" if present.settings == best.settings else NOT_TRAINED
    return replace(present, note="; ".join(filter(None, [present.note, missing])))


def has_torch() -> bool:
    """Return whether torch is installed, which training needs."""
    return find_spec("torch") is not None


def has_photographs(views: Views | None) -> bool:
    """Return whether a capture has photographs to train on, and others to evaluate the result."""
    if views is None or not views.test:
        return False
    return any(view.photo for view in views.train) and all(view.photo for view in views.test)
