"""Opening of camera files, with errors as one sentence."""

from __future__ import annotations

import contextlib
import io
import unicodedata
from collections.abc import Iterator
from pathlib import Path

from kissgs.core.errors import InvalidViewsError


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[tuple[io.BufferedReader, int]]:
    """Open a regular file for reading; yield it and its size in bytes.

    Raises:
        InvalidViewsError: it is missing or no regular file, or it cannot be read.
    """
    try:
        if not path.is_file():  # opening a named pipe would wait for its writer
            reason = "it is a folder or a device" if path.exists() else "there is no such file"
            raise InvalidViewsError(f"cannot read {path}: {reason}")
        with path.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            yield file, size
    except OSError as error:
        raise InvalidViewsError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from error


def quoted(text: str) -> str:
    """Return ``text`` in quotes, with unprintable characters escaped, of at most 80 characters."""
    return repr(text if len(text) <= 80 else text[:79] + "…")


def composed(name: str) -> str:
    """Return a name in the composed Unicode form (NFC), to compare it: archives of macOS have decomposed names."""
    return unicodedata.normalize("NFC", name)
