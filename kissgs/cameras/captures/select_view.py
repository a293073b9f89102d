"""Selection of a view by number, by name, or from a camera file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from kissgs.cameras.captures.camera_json import read_cameras
from kissgs.cameras.captures.files import composed, quoted
from kissgs.cameras.views import View
from kissgs.core.errors import InvalidViewsError


def is_camera_file(which: str) -> bool:
    """Whether ``which`` has the form FILE.json, FILE.json:N or FILE.json:NAME."""
    return _split(which) is not None


def view_of_file(which: str) -> View:
    """Return the camera of FILE.json, or the one that FILE.json:N or FILE.json:NAME selects.

    Raises:
        InvalidViewsError: there is no such file or camera, or the file has several cameras and none is selected.
    """
    name, selected = _split(which) or (which, "")
    views = read_cameras(Path(name))
    if selected:
        return pick_view(views, selected, name)
    if len(views) > 1:
        first = views[0].name
        raise InvalidViewsError(f"{name} has {len(views)} cameras; select one, as in {name}:0 or {name}:{first}")
    return views[0]


def pick_view(views: Sequence[View], which: str, source: str) -> View:
    """Return the view with this name, else the one with this index, else the one with this file name or stem.

    For example, ``a.png`` and ``a`` select ``images/a.png`` if no other view matches.

    Args:
        views: at least one view.
        which: name, index from 0, file name or stem.
        source: description of ``views``, for error messages.

    Raises:
        InvalidViewsError: no view matches, or several do.
    """
    found = [view for view in views if view.name == which]
    if not found and which.isascii() and which.isdigit() and len(which) < 10:
        if int(which) >= len(views):
            raise InvalidViewsError(f"there is no view {which} in {source}; numbers go from 0 to {len(views) - 1}")
        return views[int(which)]
    if not found:
        found = [view for view in views if composed(which) in _names(view)]
    if len(found) == 1:
        return found[0]
    if found:
        raise InvalidViewsError(f"{len(found)} views in {source} have the name {quoted(which)}; give the number of one")
    first, last = views[0].name, views[-1].name
    raise InvalidViewsError(f"there is no view {quoted(which)} in {source}; the first is {first}, the last {last}")


def _names(view: View) -> tuple[str, str, str]:
    path = PurePosixPath(composed(view.name))
    return str(path), path.name, path.stem


def _split(which: str) -> tuple[str, str] | None:
    if which.lower().endswith(".json"):
        return which, ""
    at = which.lower().rfind(".json:")
    return None if at < 0 else (which[: at + 5], which[at + 6 :])
