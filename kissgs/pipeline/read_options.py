"""Options for reading a scene from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from kissgs.core.limits import MAX_GAUSSIANS
from kissgs.core.splats import Splats


@dataclass(frozen=True, slots=True, kw_only=True)
class ReadOptions:
    """Options for reading a scene, of which each format heeds those that concern it.

    Attributes:
        max_gaussians: largest number of Gaussians; more are refused before memory is allocated. By default 20 million
            for formats whose scene can take far more memory than the file; no limit for ``.ply``, ``.splat`` and
            ``.ksplat``, whose scene takes at most four times the bytes of the file.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so, as some tools write it.
        origin: "auto" makes positions relative to the whole numbers nearest to the middle of the scene
            (:attr:`kissgs.Splats.origin`), where containers have the finest steps. By default the origin is that of the
            file, or the middle of the scene where float32 cannot hold its positions.
        antialiased: whether the scene was trained with antialiasing (:class:`kissgs.Splats`); None: as the file says.
    """

    max_gaussians: int | None = None
    level: int = 0
    raw_axes: bool = False
    origin: Literal["auto"] | None = None
    antialiased: bool | None = None

    @property
    def max_compressed(self) -> int:
        """Largest number of Gaussians of formats whose scene can take far more memory than the file."""
        return MAX_GAUSSIANS if self.max_gaussians is None else self.max_gaussians

    def marked(self, splats: Splats) -> Splats:
        """Return a scene that was read, antialiased or not as these options say."""
        return splats if self.antialiased is None else replace(splats, antialiased=self.antialiased)


DEFAULT_READ_OPTIONS = ReadOptions()
