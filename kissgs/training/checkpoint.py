"""Work that takes minutes, kept in a file now and then, so that it can be taken up where it was left."""

from __future__ import annotations

import contextlib
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.errors import OutputError
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing

SECONDS = 30.0
"""Between two savings: what is lost at most."""


class Checkpoint:
    """A file ``.npz`` that holds the state of one piece of work; without a path, nothing is kept.

    Args:
        path: of the file.
        key: of the work: its input, settings and version. What was kept under another is not taken up.

    Raises:
        OutputError: the file is of other work, or no such file, and must not be written over; or it could not be
            written.
    """

    def __init__(self, path: Path | None, key: str) -> None:
        self._path, self._key = path, key
        self._saved, self._took = time.monotonic(), 0.0
        if path is not None:
            refuse_existing(path, overwrite=True)
            if path.exists() and self._read(path) is None:
                raise OutputError(
                    f"{path} is the checkpoint of other work: another scene, other views or settings, or another "
                    "version of kissgs; delete it to begin anew"
                )

    def load(self) -> dict[str, np.ndarray] | None:
        """What was kept; None if nothing was."""
        return self._read(self._path) if self._path is not None and self._path.exists() else None

    def _read(self, path: Path) -> dict[str, np.ndarray] | None:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                if str(kept["key"]) != self._key:
                    return None
                return {name: kept[name] for name in kept.files if name != "key"}
        except OSError as error:
            raise OutputError(f"cannot read {path}: {reason_of(error)}") from error
        except (ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
            raise OutputError(f"{path} is no checkpoint of kissgs; move it away or delete it") from error

    @property
    def due(self) -> bool:
        """Whether it is time to save again: half a minute has gone, and saving takes no more than a twentieth of it."""
        return self._path is not None and time.monotonic() - self._saved >= max(SECONDS, 20 * self._took)

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        """Keep it, whole or not at all, in place of what was kept before.

        Raises:
            OutputError: the file system refuses.
        """
        if self._path is None:
            return
        begun = time.monotonic()
        arrays: dict[str, Any] = {"key": np.asarray(self._key), **state}
        with atomic_file(self._path, overwrite=True) as file:
            np.savez(file, **arrays)
        self._saved = time.monotonic()
        self._took = self._saved - begun

    def remove(self) -> None:
        """What it led to is kept elsewhere."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def forget(*checkpoints: Path | None) -> None:
    """Delete them, now that what they led to is kept elsewhere."""
    for path in checkpoints:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def beside(checkpoint: Path) -> Path:
    """Where fine-tuning keeps its state if compaction keeps its own in this file.

    Raises:
        OutputError: it is a folder.
    """
    refuse_existing(checkpoint, overwrite=True)
    return checkpoint.with_name(f"{checkpoint.stem}-finetune{checkpoint.suffix}")
