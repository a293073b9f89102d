"""Which view is meant by a number, a name, or a file of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from kissgs.cameras.captures.camera_json import read_cameras
from kissgs.cameras.captures.files import quoted
from kissgs.cameras.views import View
from kissgs.core.errors import InvalidViewsError


def is_camera_file(which: str) -> bool:
    """Whether ``which`` is FILE.json, FILE.json:N or FILE.json:NAME."""
    return _split(which) is not None


def view_of_file(which: str) -> View:
    """The camera that FILE.json holds, or that FILE.json:N or FILE.json:NAME picks of several.

    Raises:
        InvalidViewsError: there is no such file or camera; the file holds several and none is picked.
    """
    name, picked = _split(which) or (which, "")
    views = read_cameras(Path(name))
    if picked:
        return pick_view(views, picked, name)
    if len(views) > 1:
        first = views[0].name
        raise InvalidViewsError(f"{name} holds {len(views)} cameras; pick one, as in {name}:0 or {name}:{first}")
    return views[0]


def pick_view(views: Sequence[View], which: str, source: str) -> View:
    """The view of that name; else, if it is a number, the one at that place, from 0; else that of that file name.

    ``images/a.png`` goes by ``a.png`` and ``a`` too, if nothing else does. ``source`` says for people what ``views``
    are.

    Raises:
        InvalidViewsError: there is no such view, or more than one.
    """
    found = [view for view in views if view.name == which]
    if not found and which.isascii() and which.isdigit() and len(which) < 10:
        if int(which) >= len(views):
            raise InvalidViewsError(f"there is no view {which} in {source}; they count from 0 to {len(views) - 1}")
        return views[int(which)]
    if not found:
        found = [view for view in views if which in (PurePosixPath(view.name).name, PurePosixPath(view.name).stem)]
    if len(found) == 1:
        return found[0]
    if found:
        raise InvalidViewsError(f"{len(found)} views in {source} are called {quoted(which)}; give the number of one")
    first, last = views[0].name, views[-1].name
    raise InvalidViewsError(f"there is no view {quoted(which)} in {source}; the first is {first}, the last {last}")


def _split(which: str) -> tuple[str, str] | None:
    if which.lower().endswith(".json"):
        return which, ""
    at = which.lower().rfind(".json:")
    return None if at < 0 else (which[: at + 5], which[at + 6 :])
