"""``RenderJob``: the work of ``kissgs render``, an image, an orbit around the scene, or a sheet of all views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.cameras.captures.camera_json import is_camera_file, pick_view, view_of_file
from kissgs.cameras.views import View, Views
from kissgs.cameras.virtual.orbit import find_orbit
from kissgs.cameras.virtual.select import best_view, virtual_views
from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, load_kernels, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.images import Label, contact_sheet, reframed, render_all
from kissgs.rendering.rasterizer import BLACK, Colour, Device

IMAGE_SIZE, FRAME_SIZE, CELL_SIZE = (1280, 960), (640, 480), (320, 240)
"""Default (width, height), pixels: of a single image, of an animation's frames, of the images on a contact sheet."""

ANIMATION_FRAMES, SHEET_FRAMES = 48, 24
"""Default number of images of an orbit, in an animation and on a contact sheet."""

HELD_OUT = " · held out"


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImages:
    """Result of a render job."""

    images: Sequence[UInt8[np.ndarray, "H W 3"]]
    """One image or contact sheet, or the frames of an animation."""
    views: Sequence[View]
    """The views that were rendered, in the world's coordinates; for a contact sheet, those of all its cells."""
    description: str
    """Description of the views, for people."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderJob:
    """Renderer of a scene with the choices of ``kissgs render``."""

    splats: Splats
    """Without non-finite values (:func:`kissgs.clean`)."""
    size: tuple[int, int] | None = None
    """(width, height) of each image, pixels; None for the camera's size, else for the default."""
    background: Colour | None = None
    """RGB, 0 to 1; None for that of the capture, else black."""
    device: Device = "cpu"
    threads: int = 0
    progress: Progress = silent

    def single(self, capture: Views | None, which: str | None) -> RenderedImages:
        """Render a single image, by default at the camera's size."""
        load_kernels(self.progress)
        if which is not None and is_camera_file(which):
            view, source = view_of_file(which).relative_to(self.splats.origin), "camera file"
        elif capture is not None:
            view, source = pick_view(capture.all, which or "0", capture.source), capture.source
        elif which is None:
            width, height = self.size or IMAGE_SIZE
            view = best_view(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
            source = "best of the virtual cameras"
        else:
            virtual = self._virtual(self.size or IMAGE_SIZE)
            view, source = pick_view(virtual.all, which, virtual.source), virtual.source
        if self.size is not None:
            view = View(view.name, reframed(view.camera, *self.size))
        return RenderedImages(self._render([view.camera], capture), self._in_world([view]), f"{view.name} ({source})")

    def animation(self, frames: int | None = None) -> RenderedImages:
        """Render an orbit around the scene, as the frames of an animation that loops."""
        load_kernels(self.progress)
        width, height = self.size or FRAME_SIZE
        orbit = find_orbit(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
        cameras = orbit.loop_cameras(frames or ANIMATION_FRAMES, width, height)
        views = self._in_world(_numbered(cameras))
        return RenderedImages(self._render(cameras, None), views, f"{len(cameras)} frames, {orbit.description}")

    def orbit_sheet(self, frames: int | None = None) -> RenderedImages:
        """Render an orbit around the scene, as one contact sheet."""
        load_kernels(self.progress)
        width, height = self.size or CELL_SIZE
        orbit = find_orbit(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
        cameras = orbit.sheet_cameras(frames or SHEET_FRAMES, width, height)
        sheet = contact_sheet(self._render(cameras, None))
        views = self._in_world(_numbered(cameras))
        return RenderedImages([sheet], views, f"{len(cameras)} images, {orbit.description}")

    def view_sheet(self, capture: Views | None) -> RenderedImages:
        """Render a contact sheet of the capture's views, else of the virtual views, with names and held-out marks."""
        load_kernels(self.progress)
        width, height = self.size or CELL_SIZE
        views = self._virtual((width, height)) if capture is None else capture
        if not views.all:
            raise InvalidViewsError(f"{views.source} has no view; name a capture with views")
        shown = [View(view.name, _within(view.camera, width, height)) for view in views.all]
        held_out = {view.name for view in views.test}
        labels = [Label(f"{view.name}{HELD_OUT * (view.name in held_out)}", view.name in held_out) for view in shown]
        sheet = contact_sheet(self._render([view.camera for view in shown], capture), labels)
        description = f"{len(shown)} views, {len(views.test)} held out ({views.source})"
        return RenderedImages([sheet], self._in_world(shown), description)

    def _in_world(self, views: Sequence[View]) -> list[View]:
        x, y, z = self.splats.origin
        return [view.relative_to((-x, -y, -z)) for view in views]

    def _virtual(self, size: tuple[int, int]) -> Views:
        return virtual_views(self.splats, width=size[0], height=size[1], threads=self.threads, progress=self.progress)

    def _render(self, cameras: Sequence[Camera], capture: Views | None) -> list[UInt8[np.ndarray, "H W 3"]]:
        background = self.background
        if background is None:
            background = BLACK if capture is None else capture.background.tolist()
        return render_all(
            self.splats,
            cameras,
            background=background,
            threads=self.threads,
            device=self.device,
            progress=self.progress,
        )


def _numbered(cameras: Sequence[Camera]) -> list[View]:
    digits = len(str(len(cameras) - 1))
    return [View(f"orbit_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]


def _within(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera resized to the largest image that fits into ``width`` x ``height``."""
    scale = min(width / camera.width, height / camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
