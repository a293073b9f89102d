"""Run-time checks of types and array shapes during tests; an int is accepted for a float."""

import functools
import inspect
from collections import Counter

import jaxtyping
from beartype import BeartypeConf, beartype

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))
checked = Counter()
"""Calls of each function that were checked in this test; the first 30 are, as checks take longer than small arrays."""

_jaxtyped = jaxtyping.jaxtyped


def jaxtyped(*, typechecker):
    """Add checks to a function, except to local ones, whose checks would be rebuilt at every call."""

    def decorate(function):
        if "<locals>" in getattr(function, "__qualname__", ""):
            return function
        checking = _jaxtyped(function, typechecker=typechecker)
        if not inspect.isfunction(function):
            return checking

        @functools.wraps(function)
        def call(*args, **kwargs):
            checked[function] += 1
            return (checking if checked[function] <= 30 else function)(*args, **kwargs)

        return call

    return decorate


jaxtyping.jaxtyped = jaxtyped  # which the import hook puts before every function
