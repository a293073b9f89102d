"""Names of the containers that ``compress`` writes, and the endings of their files."""

from __future__ import annotations

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

FILE_ENDINGS = (
    *SCENE_ENDINGS,
    ".json",
    ".yaml",
    ".yml",
    ".webp",
    ".png",
    ".jpg",
    ".html",
    ".txt",
    ".npz",
    ".gz",
    ".tar",
)
"""Endings of files that are no containers: a folder of such a name would not be what was meant."""


def ending_of(container: ContainerName) -> str:
    """Return the ending of a container's files."""
    return next(ending for ending, name in ENDINGS.items() if name == container)


def named_container(requested: str | None, destination: Path | None) -> ContainerName:
    """Return the container to write: the requested one, else that of the destination's ending, else SOG-XT.

    Raises:
        UnsupportedError: there is no such container, or the destination has the name of another one, of another format
            or of a streamed scene.
    """
    ending = "" if destination is None else destination.suffix.lower()
    if destination is not None and (ending in FILE_ENDINGS or named_manifest(destination) is not None):
        remedy = "end it in .zip or .sog"
        if ending in SCENE_ENDINGS:
            remedy += " (kissgs convert writes other formats)"
        elif ending in (".json", LEVELS_ENDING):
            remedy += (
                f"; levels of detail, which kissgs compress and kissgs.compress_streamed write, are FOLDER/{LOD_NAME}, "
                f"FOLDER/{LEVELS_NAME} or NAME{LEVELS_ENDING}"
            )
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
