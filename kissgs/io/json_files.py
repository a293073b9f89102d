"""JSON of files from elsewhere."""

from __future__ import annotations

import json
from typing import Any, NoReturn

from kissgs.core.errors import InvalidContainerError


def parse_json(data: bytes, name: str) -> Any:  # noqa: ANN401
    """Parse JSON; NaN and Infinity are refused, as browsers refuse them.

    Raises:
        InvalidContainerError: it is not JSON.
    """
    try:
        return json.loads(data.decode("utf-8-sig"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InvalidContainerError(f"{name} is not readable JSON; export the scene again") from error


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
