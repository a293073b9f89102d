"""``Checkpoint``: the state of long work in a file, saved regularly, to resume the work after an interruption."""

from __future__ import annotations

import contextlib
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.errors import OutputError
from kissgs.io.files import atomic_file, reason_of, refuse_existing

SAVE_INTERVAL = 30.0  # shortest time between two saves, seconds


class Checkpoint:
    """An ``.npz`` file with the state of one piece of work."""

    def __init__(self, path: Path | None, key: str) -> None:
        self._path, self._key = path, key
        self._saved_at, self._save_seconds = time.monotonic(), 0.0
        if path is not None:
            refuse_existing(path, overwrite=True)
            if path.exists() and self._read(path) is None:
                raise OutputError(
                    f"{path} is a checkpoint of other work: another scene, other views or settings, or another version "
                    "of kissgs; delete it to start again"
                )

    def load(self) -> dict[str, np.ndarray] | None:
        """Return the saved state; None if there is none."""
        return self._read(self._path) if self._path is not None and self._path.exists() else None

    def _read(self, path: Path) -> dict[str, np.ndarray] | None:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as saved:
                if str(saved["key"]) != self._key:
                    return None
                return {name: saved[name] for name in saved.files if name != "key"}
        except OSError as error:
            raise OutputError(f"cannot read {path}: {reason_of(error)}") from error
        except (ValueError, KeyError, TypeError, EOFError, RuntimeError, zipfile.BadZipFile) as error:
            raise OutputError(f"{path} is no checkpoint of kissgs; move or delete it, or name another file") from error

    @property
    def due(self) -> bool:
        """Whether to save again: :data:`SAVE_INTERVAL` has passed, and saving takes at most 5 % of the time."""
        wait = max(SAVE_INTERVAL, 20 * self._save_seconds)
        return self._path is not None and time.monotonic() - self._saved_at >= wait

    def save(self, state: Mapping[str, np.ndarray]) -> None:
        """Save a state in place of the former one, completely or not at all."""
        if self._path is None:
            return
        started = time.monotonic()
        arrays: dict[str, Any] = {"key": np.asarray(self._key), **state}
        with atomic_file(self._path, overwrite=True) as file:
            np.savez(file, **arrays)
        self._saved_at = time.monotonic()
        self._save_seconds = self._saved_at - started


def delete_checkpoints(*checkpoints: Path | None) -> None:
    """Delete checkpoints whose results are saved; files that cannot be deleted stay."""
    for path in filter(None, checkpoints):
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


def finetune_checkpoint_path(checkpoint: Path) -> Path:
    """Return the path of fine-tuning's checkpoint, given that of compaction."""
    refuse_existing(checkpoint, overwrite=True)
    return checkpoint.with_name(f"{checkpoint.stem}-finetune{checkpoint.suffix}")
