"""``Camera``: a pinhole camera with a pose, in the conventions of COLMAP and gsplat."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float64
from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.constants import DILATION

MAX_SIDE = 1 << 16  # largest side of an image, pixels; a square of this size already takes 50 GB
MAX_FOCAL = 1e15  # largest focal length, pixels


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera: x right, y down, z forward; the centre of the first pixel is at (0.5, 0.5).

    Matrices may have any dtype and layout; they are copied.

    Attributes:
        viewmat: ``(4, 4)`` float64, rigid transform from world to camera.
        K: ``(3, 3)`` float64, intrinsics in pixels: fx, fy, cx, cy; no skew.
        width: of the image, pixels, 1 to :data:`MAX_SIDE`.
        height: of the image, pixels, 1 to :data:`MAX_SIDE`.
        dilation: variance added to both axes of a footprint, pixels², above 0; smaller where pixels are samples of a
            larger image, see :meth:`sampled`.

    Raises:
        InvalidViewsError: a matrix is not finite or not of this kind; a focal length, a side or the dilation is outside
            its limits.
    """

    viewmat: Float64[np.ndarray, "4 4"]
    K: Float64[np.ndarray, "3 3"]
    width: int
    height: int
    dilation: float = DILATION

    def __post_init__(self) -> None:
        for name, side in (("width", self.width), ("height", self.height)):
            if not isinstance(side, int | np.integer) or not 1 <= side <= MAX_SIDE:
                raise InvalidViewsError(
                    f"a camera's {name} must be a whole number from 1 to {MAX_SIDE:,}, not {side!r}"
                )
        for name, shape in (("viewmat", (4, 4)), ("K", (3, 3))):
            matrix = np.array(getattr(self, name), dtype=np.float64, order="C")  # kernels read no other layout
            if matrix.shape != shape or not np.isfinite(matrix).all():
                raise InvalidViewsError(f"a camera's {name} must be {shape[0]}x{shape[1]} finite numbers")
            object.__setattr__(self, name, matrix)
        rotation, K = self.viewmat[:3, :3], self.K
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise InvalidViewsError("a camera's viewmat must hold a rotation: orthonormal rows, no mirroring, no scale")
        if np.abs(self.viewmat[3] - (0, 0, 0, 1)).max() > 1e-6:
            raise InvalidViewsError("a camera's viewmat must end in the row 0 0 0 1")
        if not (0 < K[0, 0] <= MAX_FOCAL and 0 < K[1, 1] <= MAX_FOCAL):
            raise InvalidViewsError(f"a camera's focal lengths must be positive, and at most {MAX_FOCAL:.0e} pixels")
        if not 0 < self.dilation < np.inf:
            raise InvalidViewsError("a camera's dilation must be positive and finite")
        if K[0, 1] or K[1, 0] or np.abs(K[2] - (0, 0, 1)).max() > 1e-6:
            raise InvalidViewsError("a camera's K must be fx 0 cx, 0 fy cy, 0 0 1: a pinhole without skew")

    @property
    def position(self) -> Float64[np.ndarray, "3"]:
        """Centre of projection, ``(3,)``, world units."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])

    def relative_to(self, origin: tuple[float, float, float]) -> Camera:
        """Return the same camera in coordinates relative to ``origin``, world units."""
        viewmat = self.viewmat.copy()
        viewmat[:3, 3] += viewmat[:3, :3] @ origin
        return replace(self, viewmat=viewmat)

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view with another number of pixels; the aspect ratio of pixels may change.

        Footprints are dilated to the new pixels, also where those of this camera are samples.
        """
        scale = np.array([[width / self.width], [height / self.height], [1.0]])
        return Camera(self.viewmat, self.K * scale, width, height)

    def at_most(self, size: int) -> Camera:
        """Return the same view, resized to at most ``size`` pixels on the longer side."""
        shrink = size / max(self.width, self.height)
        if shrink >= 1:
            return self
        return self.resized(max(1, round(self.width * shrink)), max(1, round(self.height * shrink)))

    def sampled(self, stride: int, first: tuple[int, int] = (0, 0)) -> Camera:
        """Return the camera whose image is every ``stride``-th pixel of every ``stride``-th row of this one's image.

        It renders those pixels, except for Gaussians so far beyond the image that the projection's derivative is
        clamped. A smaller image of the same view is dilated to its larger pixels instead.

        Args:
            stride: 1 or more.
            first: column and row of the first pixel, inside the image.
        """
        column, row = first
        K = self.K / np.array([[stride], [stride], [1.0]])
        K[:2, 2] = (self.K[:2, 2] - 0.5 - (column, row)) / stride + 0.5
        width, height = -(-(self.width - column) // stride), -(-(self.height - row) // stride)
        return Camera(self.viewmat, K, width, height, self.dilation / stride**2)

    def sampled_at_most(self, size: int) -> Camera:
        """Return the same view with at most ``size`` pixels on the longer side, which are samples of this one's image.

        In contrast to :meth:`sampled`, they need not be at the centres of pixels.
        """
        small = self.at_most(size)
        shrink = max(small.width, small.height) / max(self.width, self.height)
        return self if small is self else replace(small, dilation=self.dilation * shrink**2)


def look_at(
    position: Float64[np.ndarray, "3"],
    target: Float64[np.ndarray, "3"],
    up: Float64[np.ndarray, "3"],
    *,
    fov: float,
    width: int,
    height: int,
) -> Camera:
    """Return a camera with ``target`` in the middle of its image; ``fov`` in radians, along the longer side. ``up``, of
    any length, points up in the image; the roll is arbitrary if it is zero or along the line of sight."""
    forward = target - position
    forward = forward / max(float(np.linalg.norm(forward)), 1e-30)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * np.linalg.norm(up) or not np.any(up):
        right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ position
    return Camera(viewmat, pinhole(fov, width, height), width, height)


def pinhole(fov: float, width: int, height: int) -> Float64[np.ndarray, "3 3"]:
    """Return intrinsics with the principal point in the middle of the image; ``fov`` as for :func:`look_at`."""
    focal = 0.5 * max(width, height) / np.tan(0.5 * fov)
    return np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
