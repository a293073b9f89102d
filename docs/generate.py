"""Write what is generated in docs/: the settings table and the JSON Schemas of the container's metadata."""

from __future__ import annotations

import json
from pathlib import Path

from kissgs.settings import PRESETS, EncodeSettings, Preset
from kissgs.sogxt.metadata import ContainerMeta

HERE = Path(__file__).parent

INTRODUCTION = """# Settings

Made by `make docs` from `kissgs/settings.py`. A preset sets all of them; `--set NAME=VALUE` on the command line, or
`Settings.from_preset("balanced", NAME=VALUE)` in Python, changes one. No decoder needs to know any.

"""


def settings_page() -> str:
    """Every setting, what it trades, and its value in each preset."""
    lines = [f"| setting | {' | '.join(Preset)} | what it trades |", "|---" * (len(Preset) + 2) + "|"]
    for name, field in EncodeSettings.model_fields.items():
        values = [PRESETS[preset].get(name, field.default) for preset in Preset]
        cells = " | ".join("auto" if value is None else str(value) for value in values)
        lines.append(f"| `{name}` | {cells} | {field.description} |")
    return INTRODUCTION + "\n".join(lines) + "\n"


def container_schema() -> str:
    """JSON Schema of ``container_meta.yaml``."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ContainerMeta.model_json_schema()}
    return json.dumps(schema, indent=2) + "\n"


PAGES = {"settings.md": settings_page, "container_meta.schema.json": container_schema}


def main() -> None:
    """Write every page."""
    for name, make in PAGES.items():
        (HERE / name).write_text(make(), encoding="utf-8")


if __name__ == "__main__":
    main()
