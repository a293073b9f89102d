"""``kissgs info``: describe the contents of scene files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kissgs.cli.arguments import (
    FilesArgument,
    JsonOption,
)
from kissgs.cli.files import for_each_input, show


def info(files: FilesArgument, as_json: JsonOption = False) -> None:
    """Describe scenes of any format and containers: Gaussians, SH degree, bytes per file, value ranges."""
    from kissgs.cli.tables import info_table
    from kissgs.pipeline.inspect import describe

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file))
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    for_each_input(files, Path("-"), "", as_json, work, writes=False)
