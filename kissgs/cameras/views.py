"""``View`` and ``Views``: cameras with their photographs; and the geometry of cameras drawn at random."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs.core.array_types import Float32, Float64, UInt8
from kissgs.core.errors import InvalidViewsError
from kissgs.core.positions import WORLD, Origin
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR

if TYPE_CHECKING:
    from kissgs.cameras.photographs import Window

# Geometry of cameras that are drawn at random, of the encoder's and of the evaluation's.

Vec3 = Float64[np.ndarray, "3"]  # (3,) float64, a point or a direction in world space
UP = np.array([0.0, -1.0, 0.0])  # up direction in the images of cameras whose roll does not matter

MIN_DISTANCE = 5 * NEAR
"""Smallest distance of a camera to its target, world units. Nearer, the near plane would cut the target off; such a
camera stands at this distance with a longer lens, which shows the same part of the scene."""

MIN_FIELD_OF_VIEW = 1e-9  # smallest angle of view of such a lens, radians


def check_images(count: int, width: int, height: int) -> None:
    """Check the number of images to be rendered, and their size in pixels."""
    if min(count, width, height) < 1:
        found = f"{count} of {width}x{height}"
        raise InvalidViewsError(f"there must be at least 1 image of at least 1x1 pixels, not {found}")


def random_direction(rng: np.random.Generator) -> Vec3:
    """Return a unit vector, uniformly distributed over the sphere."""
    direction = rng.standard_normal(3)
    return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def camera_facing(target: Vec3, direction: Vec3, distance: float, fov: float, size: tuple[int, int]) -> Camera:
    """Return a camera with ``target`` in the centre of its image, seen from ``direction``; ``size``: width, height."""
    possible = max(distance, MIN_DISTANCE)
    narrow = max(2 * float(np.arctan(np.tan(fov / 2) * distance / possible)), MIN_FIELD_OF_VIEW)
    return look_at(target + possible * direction, target, UP, fov=narrow, width=size[0], height=size[1])


def camera_at(position: Vec3, target: Vec3, fov: float, size: tuple[int, int]) -> Camera:
    """Return a camera at ``position``, or farther away with a longer lens, that looks at ``target``."""
    distance = float(np.linalg.norm(position - target))
    if distance >= MIN_DISTANCE:
        return look_at(position, target, UP, fov=fov, width=size[0], height=size[1])
    return camera_facing(target, (position - target) / distance if distance > 0 else -UP, distance, fov, size)


def rotation_matrices(quats: Float64[np.ndarray, "*n 4"]) -> Float64[np.ndarray, "*n 3 3"]:
    """Return the rotations of unit quaternions w, x, y, z."""
    w, x, y, z = np.moveaxis(quats, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


# ``View`` and ``Views``: cameras with their photographs, for training and for evaluation.


def black() -> Float32[np.ndarray, "3"]:
    """Return black, the default background."""
    return np.zeros(3, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Sampling:
    """The pixels of a whole image that a view has."""

    width: int
    """Width of the whole image, the photograph after undistortion, pixels."""
    height: int
    stride: int
    """Distance of neighbouring pixels of the view in the whole image, in columns and in rows."""
    first: tuple[int, int]
    """Column and row of the view's first pixel."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera with a name and perhaps a photograph.

    Attributes:
        name: name of the view.
        camera: pinhole camera at the resolution to render, that of the photograph after undistortion and sampling.
        photo: file of the photograph; None if there is only a camera.
        background: ``(3,)`` float32 RGB, 0 to 1, behind transparent pixels of the photograph and behind renderings in
            comparisons; None: black for the photograph, that of ``Views`` for renderings.
        undistortion: part of the undistorted photograph that is the image; None if the lens does not distort.
        target: ``(3,)`` float64 point, world units, that the camera looks at in the centre of its image; None if
            unknown.
        sampling: the pixels of the whole image that the view has; None for all.
        added: whether an evaluation added it for an overlooked part of the scene.
    """

    name: str
    camera: Camera
    photo: Path | None = None
    background: Float32[np.ndarray, "3"] | None = None
    undistortion: Window | None = None
    target: Float64[np.ndarray, "3"] | None = None
    sampling: Sampling | None = None
    added: bool = False

    def sampled(self, stride: int, first: tuple[int, int]) -> View:
        """Return the view of every ``stride``-th pixel of every ``stride``-th row, from column and row ``first``."""
        before = self._sampling
        column, row = (start + before.stride * more for start, more in zip(before.first, first, strict=True))
        sampling = replace(before, stride=before.stride * stride, first=(column, row))
        return replace(self, camera=self.camera.sampled(stride, first), sampling=sampling)

    def relative_to(self, origin: Origin) -> View:
        """Return the view in coordinates relative to ``origin``, world units."""
        if origin == WORLD:
            return self
        target = None if self.target is None else self.target - origin
        return replace(self, camera=self.camera.relative_to(origin), target=target)

    @property
    def _sampling(self) -> Sampling:
        return self.sampling or Sampling(self.camera.width, self.camera.height, 1, (0, 0))

    def load_photo(self) -> UInt8[np.ndarray, "H W 3"]:
        """Read the photograph from its file and return it at the camera's size, uint8 ``(height, width, 3)``.

        Raises:
            InvalidViewsError: there is none, or it cannot be read.
            UnsupportedError: it has 32 bits per channel.
        """
        if self.photo is None:
            remedy = "add the photographs of the capture"
            raise InvalidViewsError(f"view {self.name} has no photograph, only a camera; {remedy}")
        from kissgs.cameras.photographs import read_photo, undistort

        background = black() if self.background is None else self.background
        sampling = self._sampling
        stride, (column, row) = sampling.stride, sampling.first
        if self.undistortion is None:
            whole = read_photo(self.photo, sampling.width, sampling.height, background)
            return np.ascontiguousarray(whole[row::stride, column::stride])
        lens = self.undistortion.lens
        whole = read_photo(self.photo, lens.width, lens.height, background)
        return undistort(whole, self.undistortion, stride, (column, row))


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """A change of world coordinates that keeps shapes: a rotation, a translation and a scale."""

    source: str
    """The file or field that has it, for messages."""
    matrix: Float64[np.ndarray, "4 4"]
    """Transform from the old coordinates to the new ones."""

    def moved(self, view: View) -> View:
        """Return the view in the new coordinates; lengths along its camera's axes change by the scale."""
        scale = np.cbrt(np.linalg.det(self.matrix[:3, :3]))
        viewmat = view.camera.viewmat @ np.linalg.inv(self.matrix)
        viewmat[:3] *= scale
        target = None if view.target is None else self.matrix[:3, :3] @ view.target + self.matrix[:3, 3]
        return replace(view, camera=replace(view.camera, viewmat=viewmat), target=target)


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Views for training and evaluation, each sorted by name.

    Attributes:
        train: training views.
        test: held-out views, for evaluation only; may be empty.
        background: ``(3,)`` float32 RGB, 0 to 1, behind renderings.
        source: description of the files that were read, for messages.
        note: clause about an unexpected property of the capture, for messages; empty if there is none.
        similarities: from the cameras' coordinates to others that the scene may have, according to the capture's files;
            which of them are the scene's, its renderings tell (:func:`kissgs.evaluation.evaluate.in_scene_frame`).
        origin: point of the world at which the cameras' coordinates are zero, as for :class:`kissgs.Splats`.
        points: points of the COLMAP model, in the cameras' coordinates, from which gsplat's normalisation of the world
            follows; None if there are none.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    background: Float32[np.ndarray, "3"]
    source: str
    note: str = ""
    similarities: tuple[Similarity, ...] = ()
    origin: Origin = WORLD
    points: Path | None = None

    @property
    def all(self) -> tuple[View, ...]:
        """Training and held-out views, sorted by name."""
        return tuple(sorted(self.train + self.test, key=lambda view: view.name))

    @property
    def has_photographs(self) -> bool:
        """Whether there are photographs to train on, and others to evaluate the result."""
        return bool(self.test) and any(view.photo for view in self.train) and all(view.photo for view in self.test)
