"""Sensitivity in a file, a cache for later encodings of a scene with equal cameras."""

from __future__ import annotations

import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.errors import OutputError
from kissgs.core.sensitivity import Sensitivity
from kissgs.io.files import atomic_file, reason_of, refuse_existing


def read_sensitivity(path: Path, key: str) -> Sensitivity | None:
    """Read what :func:`write_sensitivity` has written with ``key``; None if the file is missing or has another key.

    Any other file is refused, because it would be replaced.
    """
    refuse_existing(path, overwrite=True)  # before the measurement, whose result is written there
    try:
        if not path.exists():
            return None
        with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
            if str(kept["key"]) != key:
                return None
            arrays = {field.name: kept[field.name] for field in fields(Sensitivity)}
    except OSError as error:
        raise OutputError(f"cannot read {path}: {reason_of(error)}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise OutputError(
            f"{path} is not a sensitivity file of kissgs; move it away, delete it or choose another path"
        ) from error
    return Sensitivity(**{**arrays, "view_uncertainty": float(arrays["view_uncertainty"])})


def write_sensitivity(path: Path, sensitivity: Sensitivity, key: str) -> None:
    """Write sensitivity and ``key`` to an ``.npz``, atomically; an existing file is replaced."""
    arrays: dict[str, Any] = {field.name: getattr(sensitivity, field.name) for field in fields(Sensitivity)}
    with atomic_file(path, overwrite=True) as file:
        np.savez(file, key=np.asarray(key), **arrays)
