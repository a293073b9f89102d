"""``StageSettings``: the values of one stage, few of which are settings; the others belong to the preset."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler
from pydantic_core import CoreSchema

Share = Annotated[float, Field(ge=0, le=1)]
Weight = Annotated[float, Field(ge=0, le=1000)]
Rate = Annotated[float, Field(gt=0, le=100)]
Steps = Annotated[int, Field(ge=0, le=1_000_000)]
Count = Annotated[int, Field(ge=1, le=1000)]
Pixels = Annotated[int, Field(ge=16, le=8192)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]

_OF_PRESET = {"of_preset": True}


def of_preset(default: object, meaning: str) -> Any:  # noqa: ANN401  as Field
    """Declare a value that belongs to the preset: only :meth:`kissgs.Settings.research` changes it."""
    return Field(default, description=meaning, json_schema_extra=dict(_OF_PRESET))


class StageSettings(BaseModel):
    """Base class of the groups of settings, and of all of them together."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @classmethod
    def public(cls) -> list[str]:
        """Return the names of the settings: fields that do not belong to the preset."""
        return [name for name, field in cls.model_fields.items() if field.json_schema_extra != _OF_PRESET]

    @classmethod
    def __get_pydantic_json_schema__(cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Leave out what belongs to the preset; answers of the service contain it, so that other names are open."""
        reference = handler(core_schema)
        schema = handler.resolve_ref_schema(reference)
        names = set(cls.public())
        if not names.issuperset(cls.model_fields):
            schema["properties"] = {name: found for name, found in schema["properties"].items() if name in names}
            del schema["additionalProperties"]
        return reference
