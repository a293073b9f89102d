"""Names of the containers that ``compress`` writes, and the endings of their files."""

from __future__ import annotations

import os
from os import PathLike
from pathlib import Path
from typing import Literal, get_args

from kissgs.core.errors import UnsupportedError

ContainerName = Literal["sogxt", "sog"]
"""SOG-XT, the default, or SOG of version 2, which other viewers open."""

CONTAINERS: tuple[ContainerName, ...] = get_args(ContainerName)

ENDINGS: dict[str, ContainerName] = {".zip": "sogxt", ".sog": "sog"}
"""Container of a file by its ending."""

LOD_NAME, LEVELS_NAME = "lod-meta.json", "levels.json"

MANIFESTS: dict[str, ContainerName] = {LOD_NAME: "sog", LEVELS_NAME: "sogxt"}
"""Containers of a streamed scene by the name of its manifest."""

LEVELS_ENDING = ".sogxt"
"""Ending of a folder for ``levels.json``."""

SCENE_ENDINGS = (".ply", ".spz", ".splat", ".ksplat", ".glb", ".gltf")
"""Endings of scenes that are no containers."""

FOLDER_ENDING = ".container"
"""Ending of folders that the command line names after their scenes."""

_SLASHES = tuple({"/", os.sep})


def ending_of(container: ContainerName) -> str:
    """Return the ending of a container's files."""
    return next(ending for ending, name in ENDINGS.items() if name == container)


def names_folder(destination: str | PathLike[str]) -> bool:
    """Whether a name is that of a folder: one that exists, or ends in a slash or in ``.container``.

    A Path keeps no slash: one without an ending is a folder.
    """
    name = os.fspath(destination)
    ending = Path(f"_{Path(name).name.rstrip('.')}").suffix  # also of ".zip" and "a.zip."
    return (
        name.endswith(_SLASHES)
        or ending == FOLDER_ENDING
        or (not ending and not isinstance(destination, str))
        or os.path.isdir(name)  # noqa: PTH112  Path.is_dir raises where a name is too long
    )


def named_container(requested: str | None, destination: str | PathLike[str] | None) -> ContainerName:
    """Return the container to write: the requested one, else that of the destination's ending, else SOG-XT.

    A destination that ends in neither ``.zip`` nor ``.sog`` is a folder, and must look like one (:func:`names_folder`).

    Raises:
        UnsupportedError: there is no such container, or the destination has the name of another one, of another format
            or of a streamed scene.
    """
    path = None if destination is None else Path(destination)
    ending = "" if path is None else path.suffix.lower()
    manifest = path is not None and named_manifest(path) is not None
    if manifest or (destination is not None and ending not in ENDINGS and not names_folder(destination)):
        remedy = "end it in .zip or .sog"
        if ending in SCENE_ENDINGS:
            remedy += " (kissgs convert writes other formats)"
        elif ending in (".json", LEVELS_ENDING):
            remedy += (
                f"; levels of detail, which kissgs compress and kissgs.compress_streamed write, are FOLDER/{LOD_NAME}, "
                f"FOLDER/{LEVELS_NAME} or NAME{LEVELS_ENDING}"
            )
        else:
            remedy += ", or if it is a folder, in a slash"
        raise UnsupportedError(f"{destination!s:.100} is not the name of a container: {remedy}")
    by_ending = ENDINGS.get(ending)
    if requested is None:
        return by_ending or "sogxt"
    for name in CONTAINERS:
        if requested == name:
            if by_ending not in (None, name):
                raise UnsupportedError(
                    f"{destination} is not the name of a {name} container: end it in {ending_of(name)}"
                )
            return name
    raise UnsupportedError(f"there is no container {requested!r}; choose one of {', '.join(CONTAINERS)}")


def named_manifest(destination: Path) -> Path | None:
    """Return the manifest of the streamed scene that a destination names; None if it names something else.

    It is the destination itself, or ``levels.json`` in a folder that ends in ``.sogxt``.
    """
    if destination.name in MANIFESTS:
        return destination
    return destination / LEVELS_NAME if destination.suffix.lower() == LEVELS_ENDING else None
