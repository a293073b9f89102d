"""``View`` and ``Views``: from where a scene was looked at, and what was seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from kissgs.cameras.pixels import read_photo
from kissgs.cameras.undistort import Lens, Window, full_window, undistort
from kissgs.core.array_types import Float32, Float64, UInt8
from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.camera import Camera


def black() -> Float32[np.ndarray, "3"]:
    """The background of photographs, which have none."""
    return np.zeros(3, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class UndistortionSpec:
    """How a photograph becomes its view's picture: reduced to the lens' size, undistorted, cropped to the window."""

    lens: Lens
    window: Window


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera, at the resolution to render, and the photograph taken with it.

    Attributes:
        name: of the view.
        camera: an undistorted pinhole of the photograph's size after all reduction and cropping.
        photo: the photograph's file; None where there are only cameras.
        background: ``(3,)`` red, green, blue from 0 to 1: what transparent pixels of the photograph show, and over
            which to render when scenes are compared; None: black, and that of all views.
        bend: how to undistort the photograph; None if it is a pinhole's.
        target: ``(3,)`` the point in the middle of the picture that the camera looks at; None where none is known.
        added: whether it was put beside drawn ones for a part of the scene that those overlook.
    """

    name: str
    camera: Camera
    photo: Path | None = None
    background: Float32[np.ndarray, "3"] | None = None
    bend: UndistortionSpec | None = None
    target: Float64[np.ndarray, "3"] | None = None
    added: bool = False

    def at_most(self, size: int) -> View:
        """The same with at most so many pixels on the longer side; the photograph is reduced when it is loaded."""
        camera = self.camera.at_most(size)
        if self.bend is None or camera is self.camera:
            return replace(self, camera=camera)
        lens, shrink = self.bend.lens, size / max(self.camera.width, self.camera.height)
        small = lens.resized(max(1, int(lens.width * shrink)), max(1, int(lens.height * shrink)))
        window = full_window(small)
        camera = Camera(self.camera.viewmat, window.K(small), window.width, window.height)
        return replace(self, camera=camera, bend=UndistortionSpec(small, window))

    def load_photo(self) -> UInt8[np.ndarray, "H W 3"]:
        """The photograph at exactly the camera's size; read anew at every call.

        It is reduced first and then undistorted, which is several times cheaper than the other way round.

        Raises:
            InvalidViewsError: there is none, or it cannot be read.
            UnsupportedError: its pixels are numbers of 32 bits.
        """
        if self.photo is None:
            raise InvalidViewsError(f"view {self.name} has no photograph, only a camera")
        background = black() if self.background is None else self.background
        if self.bend is None:
            return read_photo(self.photo, self.camera.width, self.camera.height, background)
        lens = self.bend.lens
        return undistort(read_photo(self.photo, lens.width, lens.height, background), lens, self.bend.window)


Source = Literal["photos", "cameras", "scene"]
"""What to learn from: a capture's photographs; its cameras alone, with pictures of the scene as it was; or the scene
alone, from virtual cameras."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """The views of a capture, each part sorted by name.

    Attributes:
        train: to learn from.
        test: held out, to judge by; may be empty.
        background: ``(3,)`` red, green, blue from 0 to 1, over which to render.
        source: what was read, for people.
        note: a sentence for people about what they may not have expected, without a capital and a full stop; or none.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    background: Float32[np.ndarray, "3"]
    source: str
    note: str = ""

    @property
    def all(self) -> tuple[View, ...]:
        """Both parts, sorted by name."""
        return tuple(sorted(self.train + self.test, key=lambda view: view.name))

    def to_learn(self, source: Source) -> Views:
        """With so much of the capture to learn from; what is held out, or all where nothing is, still judges."""
        if source == "photos":
            return self
        bare = tuple(replace(view, photo=None) for view in self.train) if source == "cameras" else ()
        return replace(self, train=bare, test=self.test or self.train)
