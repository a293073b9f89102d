"""``kissgs info``: what files hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from kissgs.cli.arguments import (
    FilesArgument,
    JsonOption,
)
from kissgs.cli.files import each, show


def info(files: FilesArgument, as_json: JsonOption = False) -> None:
    """Show what .ply files and containers hold."""
    from kissgs.cli.tables import info_table
    from kissgs.pipeline.inspect import describe

    def work(file: str, target: Path) -> dict[str, Any]:
        found = describe(Path(file))
        if not as_json:
            show(info_table(found))
        return found.as_dict()

    each(files, Path("-"), "", as_json, work, writes=False)
