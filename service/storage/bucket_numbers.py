"""``BucketNumbers``: the numbers of a bucket and of its database, and whether the bucket is still the same one."""

from __future__ import annotations

import re
import time

from ..core.settings import SettingsError
from .object_store import ObjectStore

HEALTH_SECONDS = 5.0
"""Seconds for which the health of the bucket is not asked for again."""


class BucketNumbers:
    """The keys ``identity``, the number of the storage, and ``database``, that of its database.

    Args:
        objects: the bucket.
    """

    def __init__(self, objects: ObjectStore) -> None:
        self._objects = objects
        self._identity: int | None = None
        self._checked, self._problem = -HEALTH_SECONDS, ""

    def read(self, name: str) -> int | None:
        """Return a number; None if there is none.

        Raises:
            SettingsError: it cannot be read or is not a number.
        """
        try:
            text = self._objects.get_bytes(name).strip()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SettingsError(f"KISSGS_STORAGE: {error}") from error
        if not re.fullmatch(rb"[0-9]{1,18}", text):
            raise SettingsError(
                f"KISSGS_STORAGE: {self._objects.url}/{name} is not a number; restore it, or use another prefix"
            )
        if name == "identity":
            self._identity = int(text)
        return int(text)

    def write(self, name: str, number: int) -> None:
        """Write a number.

        Raises:
            SettingsError: it cannot be written.
        """
        try:
            self._objects.put_bytes(b"%d\n" % number, name)
        except OSError as error:
            raise SettingsError(f"KISSGS_STORAGE: {error}") from error
        if name == "identity":
            self._identity = number

    def health_problem(self) -> str | None:
        """Return why the bucket cannot be used; None if it can. Asks it again after :data:`HEALTH_SECONDS`."""
        if time.monotonic() - self._checked >= HEALTH_SECONDS:
            self._problem = self._ask()
            self._checked = time.monotonic()
        return self._problem or None

    def _ask(self) -> str:
        try:
            same = self._identity is None or self._objects.get_bytes("identity", hasty=True) == b"%d\n" % self._identity
        except FileNotFoundError:
            same = False
        except OSError as error:
            return f"the storage cannot be used: {error}"
        return "" if same else f"the storage cannot be used: {self._objects.url} was emptied or replaced; restore it"
