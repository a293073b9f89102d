"""The choice of compaction and fine-tuning where the settings leave it open."""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING

from kissgs.settings import Settings

if TYPE_CHECKING:
    from kissgs.cameras.views import Views

NOT_TRAINED = (
    "nothing was trained, because torch is missing: pip install 'kissgs[train]'; training on the photographs makes "
    "containers much smaller at equal quality"
)


def decided(settings: Settings, views: Views | None, *, keep_all: bool = False) -> Settings:
    """Return the settings with what they leave open decided, see :meth:`kissgs.Settings.decided`.

    Args:
        settings: settings as requested.
        views: capture of the scene; None for no capture.
        keep_all: whether all Gaussians stay unless the settings request otherwise.
    """
    if keep_all and settings.compact.auto_count is None:
        settings = settings.model_copy(update={"compact": settings.compact.model_copy(update={"auto_count": False})})
    return settings.decided(photographs=has_photographs(views), torch=find_spec("torch") is not None)


def note_on_training(settings: Settings, views: Views | None) -> str:
    """Return a note for the user if the goal of the settings would be served by training, but torch is missing."""
    if find_spec("torch") is not None or not has_photographs(views):
        return ""
    without, with_torch = (settings.decided(photographs=True, torch=torch) for torch in (False, True))
    return "" if without == with_torch else NOT_TRAINED


def has_photographs(views: Views | None) -> bool:
    """Return whether a capture has photographs to train on, and others to evaluate the result."""
    if views is None or not views.test:
        return False
    return any(view.photo for view in views.train) and all(view.photo for view in views.test)
