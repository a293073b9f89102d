"""``Facts``: what the metadata of a container or a streamed scene states, for ``kissgs info``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from kissgs.core.errors import InvalidContainerError
from kissgs.io.containers import Source


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """Facts of a container, as the fields of :class:`kissgs.pipeline.inspect.Info` of the same names."""

    count: int
    sh_degree: int
    parts: dict[str, int]
    ranges: dict[str, tuple[float, float]]
    details: dict[str, Any]
    changed: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def stored_size(files: Source, name: str) -> int:
    """Return the size of a file, bytes.

    Raises:
        InvalidContainerError: there is no such file.
    """
    try:
        return files.size(name)
    except (KeyError, OSError, ValueError) as error:
        raise InvalidContainerError(f"the container has no file {name!r}; export or download it again") from error
