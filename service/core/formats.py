"""Formats of the container that a job makes, and their files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

Format = Literal["sogxt", "sog"]
"""Names of the library's containers."""

DEFAULT: Format = "sogxt"


@dataclass(frozen=True, slots=True)
class ContainerFile:
    """Ending and media type of a container.

    Attributes:
        ending: ending of the file's name.
        media_type: type of the response. A ``.sog`` is a zip as well, but some browsers unpack what is called a zip, or
            change the ending of its name; SOG has no registered type of its own.
    """

    ending: str
    media_type: str

    @property
    def name(self) -> str:
        """Name of the file in the folder of a result."""
        return f"scene{self.ending}"


CONTAINER_FILES: dict[Format, ContainerFile] = {
    "sogxt": ContainerFile(".zip", "application/zip"),
    "sog": ContainerFile(".sog", "application/octet-stream"),
}


def container_file(options: dict[str, Any]) -> ContainerFile:
    """Return the container's file for the stored options of a job; jobs without a format made SOG-XT."""
    return CONTAINER_FILES[options.get("format", DEFAULT)]
