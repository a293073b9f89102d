"""Options and output that the measurements of ``kissgs bench`` share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from kissgs.core.errors import KissgsError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from kissgs.cameras.views import Views
    from kissgs.core.progress import Progress

Row = TypeVar("Row")


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOptions:
    """Options of the command line; those of other measurements have their defaults."""

    scenes: list[Path]
    presets: list[str] = field(default_factory=list)
    changes: list[str] | None = None
    external_codecs: list[str] = field(default_factory=list)
    splat_transform: str = "splat-transform"
    sog_iterations: int | None = None
    repeats: int = 1
    evaluate: bool = False
    quality_offsets: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    strategies: list[str] = field(default_factory=list)
    supervision: str = "photos"
    plot: Path | None = None
    gaussians: list[int] = field(default_factory=list)
    views: Views | None = None
    threads: int = 0

    @property
    def preset(self) -> str:
        """The first preset, by default "balanced", for measurements that take one."""
        return self.presets[0] if self.presets else "balanced"


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchOutput:
    """Output of a measurement.

    Attributes:
        rows: results for JSON.
        table: results for the terminal.
        draw: writes a plot to a file; None if there is no plot.
        failures: an error message for each part that failed.
    """

    rows: list[dict[str, Any]]
    table: RenderableType
    draw: Callable[[Path], None] | None = None
    failures: list[str] = field(default_factory=list)


def each_scene(
    options: BenchOptions, measure: Callable[[Path, Progress], list[Row]]
) -> tuple[list[tuple[str, Row]], list[str]]:
    """Return the results of ``measure`` on each scene with the scene's name, and the error messages of failed scenes.

    Raises:
        KissgsError: there is one scene, and it failed.
    """
    from kissgs.cli.console import progress_bar

    rows, failures = list[tuple[str, Row]](), list[str]()
    with progress_bar(False) as progress:
        for scene, name in zip(options.scenes, _names(options.scenes), strict=True):
            try:
                rows += [(name, row) for row in measure(scene, progress)]
            except KissgsError as error:
                if len(options.scenes) == 1:
                    raise
                failures.append(str(error))  # the results of other scenes may have taken hours
    return rows, failures


def _names(scenes: list[Path]) -> list[str]:
    """Return the shortest ends of the paths that are all different: many captures have a ``point_cloud.ply``."""
    longest = max(len(scene.parts) for scene in scenes)
    for depth in range(1, longest + 1):
        names = [str(Path(*scene.parts[-depth:])) for scene in scenes]
        if len(set(names)) == len(scenes):
            break
    return names
