"""``CompressOptions``: options of ``kissgs compress``, read and checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from pathlib import Path

    from kissgs.io.container_names import ContainerName
    from kissgs.pipeline.read_options import ReadOptions
    from kissgs.settings import Settings


@dataclass(frozen=True, kw_only=True)
class CompressOptions:
    """Options that apply to each scene of one ``kissgs compress``.

    Attributes:
        settings: the preset with all changes, budgets and goals.
        reading: how scene files are read.
        container: container to write.
        cache: whether the sensitivity is kept next to the scene.
        evaluate: whether the result is decoded and evaluated.
        views: path of the capture; None for virtual cameras.
        force_views: whether a capture whose photographs do not show the scene is accepted.
        checkpoint: whether the state of training is kept next to the scene.
        force: whether existing output files are overwritten.
        threads: number of threads; 0 for one per processor.
        device: device of training.
        quiet: whether neither progress nor tables are printed.
    """

    settings: Settings
    reading: ReadOptions
    container: ContainerName
    cache: bool
    evaluate: bool
    views: Path | None
    force_views: bool
    checkpoint: bool
    force: bool
    threads: int
    device: Literal["cpu", "cuda"]
    quiet: bool
