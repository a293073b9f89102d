"""How types and array shapes are checked while the tests run: an int will do where a float is asked for."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def typechecker(function: Callable[..., Any]) -> Callable[..., Any]:
    """Functions within functions are left alone: they are made anew at every call, and so would their checks be."""
    return function if "<locals>" in getattr(function, "__qualname__", "") else _check(function)
