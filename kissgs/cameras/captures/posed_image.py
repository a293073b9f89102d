"""``Capture``: the content of a camera file, before its photographs are searched for."""

from __future__ import annotations

import contextlib
import io
import math
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from kissgs.cameras.photographs import NO_DISTORTION, Distortion, Lens
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError

# Opening of camera files, with errors as one sentence.


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
        """Return the lens for a photograph of another size, with all defaults filled in.

        Args:
            nominal: (width, height) that the intrinsics refer to, pixels.
            size: (width, height) of the photograph, pixels.

        Raises:
            InvalidViewsError: there is neither a focal length nor an angle of view.
        """
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
    """A photograph with its pose and intrinsics.

    Attributes:
        name: name of the view, unique in most captures.
        photo: path of the photograph according to the camera file; absolute, or relative to the capture's root.
        where: camera file and entry, for error messages.
        viewmat: ``(4, 4)`` float64, rigid transform from world to camera, with the axes of ``Camera``.
        intrinsics: intrinsics of its camera.
        split: whether it is for training or held out; None if the capture does not define it.
    """

    name: str
    photo: str
    where: str
    viewmat: Float64[np.ndarray, "4 4"]
    intrinsics: Intrinsics
    split: Literal["train", "test"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """All posed images of a capture, in the order of its camera file.

    Attributes:
        images: at least one.
        root: folder that paths of photographs are relative to.
        source: description of the files that were read, for messages.
        white: whether transparent pixels are composited over white.
        applied: ``(4, 4)`` transform, rotation and translation, from the coordinates of a former model to those of
            the poses; None if there was none.
    """

    images: tuple[PosedImage, ...]
    root: Path
    source: str
    white: bool = False
    applied: Float64[np.ndarray, "4 4"] | None = None


def _focal(length: float | None, angle: float | None, side: int) -> float | None:
    if length is not None or angle is None:
        return length
    return 0.5 * side / math.tan(0.5 * angle)
