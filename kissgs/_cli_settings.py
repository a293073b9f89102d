"""From what a user types to settings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kissgs.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.settings import Settings


def chosen(preset: str, changes: list[str] | None, seed: int | None) -> Settings:
    """A preset with ``NAME=VALUE`` changes; the seed overrides the one among them.

    Raises:
        UnsupportedError: no such preset or setting, or a value that is not possible.
    """
    from kissgs.settings import Settings

    values: dict[str, Any] = {}
    for change in changes or []:
        name, equals, value = change.partition("=")
        if not equals:
            raise UnsupportedError(f"--set {change!r}: write NAME=VALUE, for example --set means_bits=16")
        values[name.strip()] = None if value.strip() == "auto" else value.strip()
    if seed is not None:
        values["seed"] = seed
    return Settings.from_preset(preset, **values)
