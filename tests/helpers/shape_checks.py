"""Run-time checks of types and array shapes during tests; an int is accepted for a float."""

from beartype import BeartypeConf, beartype

_check = beartype(conf=BeartypeConf(is_pep484_tower=True))


def typechecker(function):
    """Add checks to a function, except to local ones, whose checks would be rebuilt at every call."""
    return function if "<locals>" in getattr(function, "__qualname__", "") else _check(function)
