"""From what a user types to settings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from kissgs.errors import UnsupportedError

if TYPE_CHECKING:
    from kissgs.settings import Settings


def chosen(preset: str, changes: list[str] | None, **options: float | str | None) -> Settings:
    """A preset with ``NAME=VALUE`` changes; options of their own, where they are given, override these.

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
    values.update({name: value for name, value in options.items() if value is not None})
    return Settings.from_preset(preset, **values)
