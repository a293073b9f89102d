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


def ending_of(container: ContainerName) -> str:
    """Return the ending of a container's files."""
    return next(ending for ending, name in ENDINGS.items() if name == container)


def named_container(requested: str | None, destination: Path | None) -> ContainerName:
    """Return the container to write: the requested one, else that of the destination's ending, else SOG-XT.

    Raises:
        UnsupportedError: there is no such container, or the ending asks for another one.
    """
    by_ending = None if destination is None else ENDINGS.get(destination.suffix.lower())
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
