"""Metrics as text, apart from the evaluation, so that a command prints its report without loading it."""

from __future__ import annotations

import math


def format_metric(value: float, digits: int, *, signed: bool = False) -> str:
    """Return a value as text with this number of digits: ∞ for equal images, NaN for a failed rendering."""
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    if math.isnan(value):
        return "NaN"
    return f"{round(value, digits) + 0.0:{'+' if signed else ''}.{digits}f}"  # -0.0 + 0.0 is 0.0
