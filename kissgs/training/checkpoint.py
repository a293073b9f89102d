"""Work that takes minutes, kept in a file now and then, so that it can be taken up where it was left."""

from __future__ import annotations

import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.errors import OutputError
from kissgs.io.atomic import atomic_file, reason_of

SECONDS = 30.0
"""Between two savings: what is lost at most."""


class Checkpoint:
    """A file ``.npz`` that holds the state of one piece of work; without a path, nothing is kept.

    Attributes:
        key: of the work: its input, settings and version. What was kept under another is not taken up.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path, self.key = path, key
        self._saved = time.monotonic()

    def load(self) -> dict[str, np.ndarray] | None:
        """What was kept; None if nothing was.

        Raises:
            OutputError: the file is of other work, or no such file, and must not be written over.
        """
        if self._path is None or not self._path.exists():
            return None
        try:
            with self._path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                key, state = str(kept["key"]), {name: kept[name] for name in kept.files if name != "key"}
        except OSError as error:
            raise OutputError(f"cannot read {self._path}: {reason_of(error)}") from error
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise OutputError(f"{self._path} is no checkpoint of kissgs; move it away or delete it") from error
        if key != self.key:
            raise OutputError(
                f"{self._path} is the checkpoint of other work: another scene, other views or settings, or another "
                "version of kissgs; delete it to begin anew"
            )
        return state

    @property
    def due(self) -> bool:
        """Whether it is time to save again."""
        return self._path is not None and time.monotonic() - self._saved >= SECONDS

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        """Keep it, whole or not at all, in place of what was kept before.

        Raises:
            OutputError: the file system refuses.
        """
        if self._path is None:
            return
        with atomic_file(self._path, overwrite=True) as file:
            arrays: dict[str, Any] = {"key": np.asarray(self.key), **state}
            np.savez(file, **arrays)
        self._saved = time.monotonic()
