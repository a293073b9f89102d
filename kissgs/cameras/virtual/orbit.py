"""``Orbit``: a camera path around a scene, a full circle or an arc that is travelled to and fro."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs.cameras.virtual.candidates import FIELD_OF_VIEW, horizontal_axes
from kissgs.cameras.virtual.scene_bounds import Vec3
from kissgs.core.errors import InvalidViewsError
from kissgs.rendering.camera import Camera, look_at


@dataclass(frozen=True, slots=True, kw_only=True)
class Orbit:
    """A horizontal circle around a look-at target, and the arc of it from which the scene looks good.

    Attributes:
        target: ``(3,)`` float64, point that all cameras look at, world units.
        radius: distance of the cameras from the target, world units; 0 to look around from the target itself.
        elevation: elevation of the cameras as seen from the target, radians.
        up: ``(3,)`` float64 unit vector.
        mid_azimuth: azimuth of the middle of the arc; of a full circle, the azimuth with the best view; radians.
        sweep: length of the arc, radians; 2 pi for a full circle.
    """

    target: Vec3
    radius: float
    elevation: float
    up: Vec3
    mid_azimuth: float = 0.0
    sweep: float = 2 * np.pi

    @property
    def full(self) -> bool:
        """Whether the path is a full circle."""
        return self.sweep >= 2 * np.pi

    @property
    def description(self) -> str:
        """Short description for messages."""
        return "a full circle" if self.full else f"{np.degrees(self.sweep):.0f}° to and fro"

    def camera(self, azimuth: float, width: int, height: int) -> Camera:
        """Return the camera at ``azimuth``, radians, with an image of ``width`` x ``height`` pixels.

        It looks at the target; at radius 0, from the target in the direction that it would have on a larger circle.
        """
        east, north = horizontal_axes(self.up)
        horizontal = np.cos(azimuth) * east + np.sin(azimuth) * north
        direction = np.cos(self.elevation) * horizontal + np.sin(self.elevation) * self.up
        position = self.target + self.radius * direction
        return look_at(position, position - direction, self.up, fov=FIELD_OF_VIEW, width=width, height=height)

    def loop_cameras(self, frames: int, width: int, height: int) -> list[Camera]:
        """Return the cameras of an animation that loops without a jump.

        On an arc, the azimuth is a sine of time, slow at the ends. Frames that show the same view share one camera
        object, so that a caller can render it once.

        Args:
            frames: number of frames, 1 or more.
            width: of the images, pixels.
            height: of the images, pixels.

        Raises:
            InvalidViewsError: an argument is less than 1.
        """
        _check(frames, width, height)
        if self.full:
            azimuths = self.mid_azimuth + np.arange(frames) * (2 * np.pi / frames)
            return [self.camera(float(azimuth), width, height) for azimuth in azimuths]
        phases = [_swing_phase(frame, frames) for frame in range(frames)]
        by_phase = {
            phase: self.camera(
                self.mid_azimuth + 0.5 * self.sweep * float(np.sin(np.pi * phase / frames)), width, height
            )
            for phase in sorted(set(phases))
        }
        return [by_phase[phase] for phase in phases]

    def sheet_cameras(self, frames: int, width: int, height: int) -> list[Camera]:
        """Return the cameras of a contact sheet: evenly spaced, once along the path.

        Args:
            frames: number of images, 1 or more.
            width: of the images, pixels.
            height: of the images, pixels.

        Raises:
            InvalidViewsError: an argument is less than 1.
        """
        _check(frames, width, height)
        if self.full or frames == 1:
            return self.loop_cameras(frames, width, height)
        azimuths = self.mid_azimuth + np.linspace(-0.5, 0.5, frames) * self.sweep
        return [self.camera(float(azimuth), width, height) for azimuth in azimuths]


def _swing_phase(frame: int, frames: int) -> int:
    """Return the phase of a swing, -``frames``/2 to ``frames``/2, equal for frames at the same azimuth.

    It goes from the middle to one end, back through the middle to the other end, and to the middle again. Integers, so
    that phases of the way there and of the way back are exactly equal.
    """
    if 4 * frame <= frames:
        return 2 * frame
    if 4 * frame <= 3 * frames:
        return frames - 2 * frame
    return 2 * frame - 2 * frames


def _check(frames: int, width: int, height: int) -> None:
    if min(frames, width, height) < 1:
        raise InvalidViewsError(
            f"there must be at least 1 frame of at least 1x1 pixels, not {frames} of {width}x{height}"
        )
