"""JSON of files from elsewhere."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NoReturn

from kissgs.core.errors import InvalidContainerError, KissgsError

MAX_VALUES = 1 << 18
"""Largest number of values in a document: each takes up to 240 bytes of memory. A primitive of glTF has some 400, the
metadata of a container a thousand."""


def parse_json(
    data: bytes,
    name: str,
    *,
    most: int = MAX_VALUES,
    parse_int: Callable[[str], Any] = int,
    error: type[KissgsError] = InvalidContainerError,
) -> Any:  # noqa: ANN401
    """Parse JSON; NaN and Infinity are refused, as browsers refuse them.

    Args:
        data: the document, UTF-8.
        name: name of the file, for messages.
        most: largest number of values, lists and objects, checked before any is built. Commas and brackets in texts
            count as well.
        parse_int: converts whole numbers.
        error: class of the errors.

    Raises:
        KissgsError: it is not JSON, or has too many values.
    """
    if 1 + data.count(b",") + data.count(b"[") + data.count(b"{") > most:
        raise error(f"{name} has more than {most:,} values, which is the limit; export the scene again")
    try:
        return json.loads(data.decode("utf-8-sig"), parse_int=parse_int, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as problem:
        raise error(f"{name} is not readable JSON; export the scene again") from problem


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not JSON")
