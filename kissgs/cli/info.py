"""``kissgs info``: describe the contents of scene files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kissgs.cli.files import for_each_input, show
from kissgs.cli.options import FilesArgument, JsonOption, SceneOptions, reads_scenes


@reads_scenes
def info(
    files: FilesArgument,
    as_json: JsonOption = False,
    *,
    common: SceneOptions,
) -> None:
    """Describe scenes of any format and containers: Gaussians, SH degree, bytes per file, value ranges."""
    from kissgs.cli.tables import info_table
    from kissgs.pipeline.inspect import describe

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file), common.reading())
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    for_each_input(files, Path("-"), "", as_json, work, writes=False)
