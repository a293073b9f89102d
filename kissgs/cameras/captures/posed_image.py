"""What a file of cameras says of each photograph, before the photograph itself is looked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from kissgs.cameras.undistort import NO_DISTORTION, Distortion, Lens
from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError

MAX_SIDE = 1_000_000
"""Pixels; the largest stitched panoramas have some hundred thousand."""


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """Of a camera, as far as its file tells; lengths in pixels of a photograph of ``width`` x ``height``.

    What is None follows from the rest: sides from the photograph, a focal length from the angle of view (radians) or
    the other focal length, the principal point from the middle.
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
        """For a photograph of ``size`` pixels, the camera's own size being ``nominal``; both (width, height).

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
    """One posed photograph.

    Attributes:
        name: of the view, unique in most captures.
        photo: where its file of cameras says the photograph is, with forward slashes; relative to the capture's root.
        where: file and entry, for messages.
        viewmat: ``(4, 4)`` rigid transform from the world to the camera, axes as those of ``Camera``.
        intrinsics: of its camera.
        split: to which part it belongs; None where the capture does not say.
    """

    name: str
    photo: str
    where: str
    viewmat: Float64[np.ndarray, "4 4"]
    intrinsics: Intrinsics
    split: Literal["train", "test"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """All shots of a capture, in the order of its file.

    Attributes:
        shots: at least one.
        root: the folder to which photographs are relative.
        source: what was read, for people.
        white: whether transparent pixels of its photographs stand for white.
    """

    shots: tuple[PosedImage, ...]
    root: Path
    source: str
    white: bool = False


def _focal(length: float | None, angle: float | None, side: int) -> float | None:
    if length is not None or angle is None:
        return length
    return 0.5 * side / math.tan(0.5 * angle)
