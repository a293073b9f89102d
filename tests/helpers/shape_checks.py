"""Run-time checks of types and array shapes during tests; an int is accepted for a float."""

import functools
import inspect
from collections import Counter

import jaxtyping
import numpy as np
from beartype import BeartypeConf, beartype

typechecker = beartype(conf=BeartypeConf(is_pep484_tower=True))
IN_A_TEST, ALIKE = 30, 5
checked: Counter = Counter()
"""Checked calls of each function in this test, up to ``IN_A_TEST``, as checks take longer than small arrays."""

alike: Counter = Counter()
"""Checked calls of a function with arguments of the same types, dtypes and shapes in this process, up to ``ALIKE``."""


def kind(value):
    """Return what a check of an argument depends on."""
    if isinstance(value, np.ndarray):
        return value.dtype.num, value.shape
    return (type(value), len(value)) if isinstance(value, (list, tuple, dict)) else type(value)


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
            if checked[function] == IN_A_TEST:
                return function(*args, **kwargs)
            called = hash((function, *map(kind, args), *map(kind, kwargs.values())))
            if alike[called] == ALIKE:
                return function(*args, **kwargs)
            checked[function] += 1
            alike[called] += 1
            return checking(*args, **kwargs)

        return call

    return decorate


jaxtyping.jaxtyped = jaxtyped  # which the import hook puts before every function
