"""``Capture``: the content of a camera file, before its photographs are searched for."""

from __future__ import annotations

import codecs
import contextlib
import io
import math
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import ValidationError

from kissgs.cameras.photographs import NO_DISTORTION, Distortion, Lens
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError

MAX_JSON_BYTES = 1 << 28
"""Maximum bytes of a JSON file; ten thousand cameras take about 10 MB."""


@contextlib.contextmanager
def open_file(path: Path) -> Iterator[tuple[io.BufferedReader, int]]:
    """Open a regular file for reading; yield it and its size in bytes."""
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


def read_json(path: Path) -> bytes:
    """Return the bytes of a JSON file without a byte order mark, at most :data:`MAX_JSON_BYTES`."""
    with open_file(path) as (file, size):
        if size > MAX_JSON_BYTES:
            raise InvalidViewsError(
                f"{path} has {size:,} bytes; at most {MAX_JSON_BYTES:,} are read; is it a camera file?"
            )
        return file.read().removeprefix(codecs.BOM_UTF8)


def invalid(where: str, error: ValidationError) -> InvalidViewsError:
    """Return the first problem of a document as an error of one sentence."""
    problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
    field = "".join(f"[{step}]" if isinstance(step, int) else f".{step}" for step in problem["loc"]).lstrip(".")
    message = f"{problem['msg'][0].lower()}{problem['msg'][1:]}"
    return InvalidViewsError(f"{where}, {field}: {message}" if field else f"{where}: {message}")


def quoted(text: str) -> str:
    """Return ``text`` in quotes, with unprintable characters escaped, of at most 80 characters."""
    return repr(text if len(text) <= 80 else text[:79] + "…")


def composed(name: str) -> str:
    """Return a name in the composed Unicode form (NFC), to compare it: archives of macOS have decomposed names."""
    return unicodedata.normalize("NFC", name)


MAX_SIDE = 1_000_000
"""Maximum side of a photograph, pixels; the largest stitched panoramas have a few hundred thousand."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Intrinsics from a camera file; lengths in pixels of a photograph of ``width`` x ``height``.

    Defaults of values that are None: the size of the photograph; for a focal length the angle of view (radians) or the
    other focal length; for the principal point the centre of the image.
    """

    width: int | None = None
    height: int | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    angle_x: float | None = None
    angle_y: float | None = None
    distortion: Distortion = NO_DISTORTION

    def lens(self, nominal: tuple[int, int], size: tuple[int, int]) -> Lens:
        """Return the lens for a photograph of another size, with all defaults filled in."""
        across, down = size[0] / nominal[0], size[1] / nominal[1]
        fx, fy = _focal(self.fx, self.angle_x, nominal[0]), _focal(self.fy, self.angle_y, nominal[1])
        fx = fy if fx is None else fx
        fy = fx if fy is None else fy
        if fx is None or fy is None:
            raise InvalidViewsError("the camera has no focal length; give fl_x or camera_angle_x")
        cx = nominal[0] / 2 if self.cx is None else self.cx
        cy = nominal[1] / 2 if self.cy is None else self.cy
        return Lens(fx * across, fy * down, cx * across, cy * down, size[0], size[1], self.distortion)


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A photograph with its pose and intrinsics."""

    name: str
    """Unique in most captures."""
    photo: str
    """According to the camera file; absolute, or relative to the capture's root."""
    where: str
    """Camera file and entry, for error messages."""
    viewmat: Float64[np.ndarray, "4 4"]
    """Rigid transform from world to camera, with the axes of ``Camera``."""
    intrinsics: Intrinsics
    split: Literal["train", "test"] | None = None
    """None if the capture does not define it."""


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """All posed images of a capture, in the order of its camera file."""

    images: tuple[PosedImage, ...]
    """One or more."""
    root: Path
    """Folder that paths of photographs are relative to."""
    source: str
    """Description of the files that were read, for messages."""
    white: bool = False
    """Whether transparent pixels are composited over white."""
    applied: Float64[np.ndarray, "4 4"] | None = None
    """Rotation and translation from the coordinates of a former model to those of the poses, if there was one."""


def _focal(length: float | None, angle: float | None, side: int) -> float | None:
    if length is not None or angle is None:
        return length
    return 0.5 * side / math.tan(0.5 * angle)
