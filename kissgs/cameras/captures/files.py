"""Opening files of cameras: what can go wrong becomes one sentence."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path

from kissgs.core.errors import InvalidViewsError


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[tuple[io.BufferedReader, int]]:
    """Open a regular file to read bytes; gives it and its size.

    Raises:
        InvalidViewsError: it cannot be opened or read.
    """
    try:
        if not path.is_file():  # asked first, because opening a named pipe would wait for its writer
            reason = "it is a folder or a device" if path.exists() else "there is no such file"
            raise InvalidViewsError(f"cannot read {path}: {reason}")
        with path.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            yield file, size
    except OSError as error:
        raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error


def quoted(text: str) -> str:
    """``text`` in quotes, unprintable characters escaped, cut to what fits a sentence."""
    return repr(text if len(text) <= 80 else text[:79] + "…")
