"""Options for reading a scene from a file."""

from __future__ import annotations

from dataclasses import dataclass

from kissgs.core.limits import MAX_GAUSSIANS


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """Options for reading a scene, of which each format heeds those that concern it.

    Attributes:
        max_gaussians: largest number of Gaussians; more are refused before memory is allocated. By default 20 million
            for formats whose scene can take far more memory than the file; no limit for ``.ply``, ``.splat`` and
            ``.ksplat``, whose scene takes at most four times the bytes of the file.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so, as some tools write it.
    """

    max_gaussians: int | None = None
    level: int = 0
    raw_axes: bool = False

    @property
    def max_compressed(self) -> int:
        """Largest number of Gaussians of formats whose scene can take far more memory than the file."""
        return MAX_GAUSSIANS if self.max_gaussians is None else self.max_gaussians


DEFAULT_READ_OPTIONS = ReadOptions()
