"""What the measurements of ``kissgs bench`` share: what was asked for, and what came of it."""

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
class Asked:
    """The options, as the command line has them; those of other measurements are empty."""

    scenes: list[Path]
    presets: list[str] = field(default_factory=list)
    changes: list[str] | None = None
    peers: list[str] = field(default_factory=list)
    splat_transform: str = "splat-transform"
    sog_iterations: int | None = None
    repeats: int = 1
    pictures: bool = False
    fidelities: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    ways: list[str] = field(default_factory=list)
    learn_from: str = "photos"
    plot: Path | None = None
    gaussians: list[int] = field(default_factory=list)
    views: Views | None = None
    threads: int = 0

    @property
    def preset(self) -> str:
        """Where a measurement is of one."""
        return self.presets[0] if self.presets else "balanced"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """For machines, for people, how it is drawn, if it is, and a sentence for each part that failed."""

    rows: list[dict[str, Any]]
    table: RenderableType
    draw: Callable[[Path], None] | None = None
    failures: list[str] = field(default_factory=list)


def each_scene(asked: Asked, measure: Callable[[Path, Progress], list[Row]]) -> tuple[list[tuple[str, Row]], list[str]]:
    """What ``measure`` finds of every scene, beside its name; and a sentence for each of several that failed.

    Raises:
        KissgsError: there is one scene, and it failed.
    """
    from kissgs.cli.console import progress_bar

    rows, failures = list[tuple[str, Row]](), list[str]()
    with progress_bar(False) as progress:
        for scene, name in zip(asked.scenes, _names(asked.scenes), strict=True):
            try:
                rows += [(name, row) for row in measure(scene, progress)]
            except KissgsError as error:
                if len(asked.scenes) == 1:
                    raise
                failures.append(str(error))  # what the others took an hour to find is not lost
    return rows, failures


def _names(scenes: list[Path]) -> list[str]:
    """As much of the end of each path as tells it from the others: many captures have a ``point_cloud.ply``."""
    longest = max(len(scene.parts) for scene in scenes)
    for depth in range(1, longest + 1):
        names = [str(Path(*scene.parts[-depth:])) for scene in scenes]
        if len(set(names)) == len(scenes):
            break
    return names
