"""Sensitivity in a file, for the next time that the same scene is looked at from the same places."""

from __future__ import annotations

import zipfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.errors import OutputError
from kissgs.core.sensitivity import Sensitivity
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing


def read_sensitivity(path: Path, key: str) -> Sensitivity | None:
    """What :func:`write_sensitivity` kept under ``key``; None where there is no file, or one with another key.

    Raises:
        OutputError: there is something else, which must not be written over, or nothing can be kept there.
    """
    refuse_existing(path, overwrite=True)  # rather now than after what is kept there has been measured
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
            f"{path} is not a file in which kissgs keeps sensitivity; move it away or delete it"
        ) from error
    return Sensitivity(**{**arrays, "view_uncertainty": float(arrays["view_uncertainty"])})


def write_sensitivity(path: Path, sensitivity: Sensitivity, key: str) -> None:
    """Keep it in an ``.npz``, whole or not at all; what was kept there before is replaced.

    Raises:
        OutputError: the file system refuses.
    """
    arrays: dict[str, Any] = {field.name: getattr(sensitivity, field.name) for field in fields(Sensitivity)}
    with atomic_file(path, overwrite=True) as file:
        np.savez(file, key=np.asarray(key), **arrays)
