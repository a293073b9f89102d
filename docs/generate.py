"""Write what is generated in docs/: tables of settings and problems, JSON Schema, OpenAPI."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from pydantic import ByteSize

from kissgs.settings import PRESETS, CompactSettings, EncodeSettings, FinetuneSettings, Preset
from kissgs.settings.compact import BUDGETS
from kissgs.sogxt.metadata import ContainerMeta
from service.core.problems import PROBLEM_TYPES
from service.core.settings import ServiceSettings
from service.http.app import create_app

HERE = Path(__file__).parent

INTRODUCTION = """# Settings

Made by `make docs` from `kissgs/settings/`. A preset sets all of them. No decoder needs to know any.
"""

GROUPS = {
    "encode": (
        EncodeSettings,
        'How Gaussians become images. `kissgs compress --set NAME=VALUE`, or `Settings.from_preset("balanced", '
        "NAME=VALUE)` in Python, changes one.",
    ),
    "compact": (
        CompactSettings,
        "How a scene comes to have fewer Gaussians ([compaction.md](compaction.md)). "
        "`kissgs compact --set NAME=VALUE`, "
        '`kissgs compress --set compact.NAME=VALUE`, or `Settings.from_preset("balanced", compact={"NAME": VALUE})` '
        "in Python, changes one.",
    ),
    "finetune": (
        FinetuneSettings,
        "How levels become better once all else is chosen ([finetuning.md](finetuning.md)). "
        "`kissgs compress --finetune --set finetune.NAME=VALUE`, or "
        '`Settings.from_preset("balanced", finetune={"enabled": True, "NAME": VALUE})` in Python, changes one.',
    ),
}


def settings_page() -> str:
    """Every setting, what it trades, and its value in each preset."""
    page = INTRODUCTION
    for group, (model, about) in GROUPS.items():
        lines = [f"| setting | {' | '.join(Preset)} | what it trades |", "|---" * (len(Preset) + 2) + "|"]
        for name, field in model.model_fields.items():
            values = [PRESETS[preset][group].get(name, field.default) for preset in Preset]
            unset = "" if group == "compact" and name in BUDGETS else "auto"
            cells = " | ".join(unset if value is None else str(value) for value in values)
            lines.append(f"| `{name}` | {cells} | {field.description} |")
        page += f"\n## {group}\n\n{about}\n\n" + "\n".join(lines) + "\n"
    return page


def container_schema() -> str:
    """JSON Schema of ``container_meta.yaml``."""
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **ContainerMeta.model_json_schema()}
    return json.dumps(schema, indent=2) + "\n"


SERVICE_INTRODUCTION = """# The service: settings and problems

Made by `make docs` from `service/core/settings.py` and `service/core/problems.py`; for its use see
[service.md](service.md).

## Settings

Environment variables. A name that is none of these stops the service at its start, and so does a value that is not
possible; all of them are told at once. Sizes may be written as `2GB` or `512MiB`, lists with spaces or commas.

| variable | default | what it is |
|---|---|---|
"""


def service_page() -> str:
    """Every setting of the service, and every code of a problem document."""
    page = SERVICE_INTRODUCTION
    for name, field in ServiceSettings.model_fields.items():
        default = "" if field.default in (None, ()) else f"`{_spelled(name, field.default)}`"
        page += f"| `KISSGS_{name.upper()}` | {default} | {field.description} |\n"
    page += "\n## Problems\n\nThe `code` of a problem document. Codes never change their meaning.\n\n"
    page += "| code | status | what | try again |\n|---|---|---|---|\n"
    for code, kind in PROBLEM_TYPES.items():
        page += f"| `{code}` | {kind.status} | {kind.title} | {'yes' if kind.retryable else ''} |\n"
    return page


def _spelled(name: str, value: object) -> str:
    if name.endswith(("bytes", "memory", "rate")) and isinstance(value, ByteSize):
        return value.human_readable()
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


def openapi_document() -> str:
    """What a service without keys serves at ``/openapi.json``."""
    with tempfile.TemporaryDirectory() as folder:
        app = create_app(ServiceSettings(data_dir=Path(folder)))
        app.state.context.store.close()
        app.state.context.storage.close()
    return json.dumps(app.openapi(), indent=1) + "\n"


PAGES = {
    "settings.md": settings_page,
    "container_meta.schema.json": container_schema,
    "service-reference.md": service_page,
    "openapi.json": openapi_document,
}


def main() -> None:
    """Write every page."""
    for name, make in PAGES.items():
        (HERE / name).write_text(make(), encoding="utf-8")


if __name__ == "__main__":
    main()
