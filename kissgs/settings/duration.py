"""``Duration``: a time in seconds, which may be written with a unit."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

UNITS = {"": 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}

DURATION = re.compile(r"(\d+|\d*\.\d+)\s*([a-z]*)", re.IGNORECASE)


def _in_seconds(duration: object) -> object:
    if not isinstance(duration, str):
        return duration
    found = DURATION.fullmatch(duration.strip())
    if found is None or found[2].lower() not in UNITS:
        raise PydanticCustomError("duration", "Write 30s, 2min, 1h or a number of seconds")
    return float(found[1]) * UNITS[found[2].lower()]


Duration = Annotated[float, BeforeValidator(_in_seconds)]
