"""``kissgs info``: describe the contents of scene files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kissgs.cli.files import for_each_input, show
from kissgs.cli.options import FilesArgument, JsonOption, LevelOption, MaxGaussiansOption, RawAxesOption


def info(
    files: FilesArgument,
    max_gaussians: MaxGaussiansOption = None,
    level: LevelOption = 0,
    raw_axes: RawAxesOption = False,
    as_json: JsonOption = False,
) -> None:
    """Describe scenes of any format and containers: Gaussians, SH degree, bytes per file, value ranges."""
    from kissgs.cli.tables import info_table
    from kissgs.io.scene_format import ReadOptions
    from kissgs.pipeline.inspect import describe

    reading = ReadOptions(max_gaussians=max_gaussians, level=level, raw_axes=raw_axes)

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file), reading)
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    for_each_input(files, Path("-"), "", as_json, work, writes=False)
