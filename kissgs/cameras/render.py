"""What ``kissgs render`` does once it knows what is wanted: a picture, a way around the scene, or all its views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.cameras.captures.select_view import is_camera_file, pick_view, view_of_file
from kissgs.cameras.views import View, Views
from kissgs.cameras.virtual.orbit import find_orbit
from kissgs.cameras.virtual.select import best_view, virtual_views
from kissgs.core.array_types import UInt8
from kissgs.core.errors import InvalidViewsError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.contact_sheet import Label, contact_sheet
from kissgs.rendering.images import reframed, render_all
from kissgs.rendering.rasterizer import BLACK, Colour, Device, load_kernels

PICTURE, FRAME, CELL = (1280, 960), (640, 480), (320, 240)
"""Width and height if none is asked for: of a picture, of a film's frames, and of the pictures on a sheet."""

FILM_FRAMES, SHEET_FRAMES = 48, 24
HELD_OUT = " · held out"


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImages:
    """Pictures that were taken.

    Attributes:
        pictures: to write: one, or the frames of a film.
        views: from where; on a sheet, one for each of its pictures.
        what: in words.
    """

    pictures: Sequence[UInt8[np.ndarray, "H W 3"]]
    views: Sequence[View]
    what: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderJob:
    """Takes pictures of a scene; all its methods raise what their parts do.

    Attributes:
        splats: finite (:func:`kissgs.clean`).
        size: (width, height) of each picture; None for the camera's own, or what is usual.
        background: RGB from 0 to 1; None for that of the capture, else black.
        device: as for :func:`kissgs.render`.
        threads: of the processor; 0 means one each.
        progress: receives the stages ``"kernels"``, ``"cameras"`` and ``"render"``.
    """

    splats: Splats
    size: tuple[int, int] | None = None
    background: Colour | None = None
    device: Device = "cpu"
    threads: int = 0
    progress: Progress = silent

    def single(self, capture: Views | None, which: str | None) -> RenderedImages:
        """One picture, of a camera in its own shape and size if it has any.

        ``which`` is a file of cameras, or a number or a name in the capture, else among virtual views. By default it is
        the capture's first view or the best virtual one.
        """
        load_kernels(self.progress)
        if which is not None and is_camera_file(which):
            view, source = view_of_file(which), "camera file"
        elif capture is not None:
            view, source = pick_view(capture.all, which or "0", capture.source), capture.source
        elif which is None:
            width, height = self.size or PICTURE
            view = best_view(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
            source = "best of the virtual cameras"
        else:
            virtual = self._virtual(self.size or PICTURE)
            view, source = pick_view(virtual.all, which, virtual.source), virtual.source
        if self.size is not None:
            view = View(view.name, reframed(view.camera, *self.size))
        return RenderedImages(self._take([view.camera], capture), [view], f"{view.name} ({source})")

    def film(self, frames: int | None = None) -> RenderedImages:
        """The way around the scene, as frames that can be repeated."""
        load_kernels(self.progress)
        width, height = self.size or FRAME
        orbit = find_orbit(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
        cameras = orbit.loop(frames or FILM_FRAMES, width, height)
        return RenderedImages(self._take(cameras, None), _numbered(cameras), f"{len(cameras)} frames, {orbit.in_words}")

    def strip(self, frames: int | None = None) -> RenderedImages:
        """The way around the scene, as one sheet of pictures."""
        load_kernels(self.progress)
        width, height = self.size or CELL
        orbit = find_orbit(self.splats, width=width, height=height, threads=self.threads, progress=self.progress)
        cameras = orbit.stops(frames or SHEET_FRAMES, width, height)
        sheet = contact_sheet(self._take(cameras, None))
        return RenderedImages([sheet], _numbered(cameras), f"{len(cameras)} pictures, {orbit.in_words}")

    def sheet(self, capture: Views | None) -> RenderedImages:
        """All views of the capture, else the virtual ones, with their names; held-out ones are marked."""
        load_kernels(self.progress)
        width, height = self.size or CELL
        views = self._virtual((width, height)) if capture is None else capture
        if not views.all:
            raise InvalidViewsError(f"{views.source} has no view to show")
        shown = [View(view.name, _within(view.camera, width, height)) for view in views.all]
        held_out = {view.name for view in views.test}
        labels = [Label(f"{view.name}{HELD_OUT * (view.name in held_out)}", view.name in held_out) for view in shown]
        sheet = contact_sheet(self._take([view.camera for view in shown], capture), labels)
        return RenderedImages([sheet], shown, f"{len(shown)} views, {len(views.test)} held out ({views.source})")

    def _virtual(self, size: tuple[int, int]) -> Views:
        return virtual_views(self.splats, width=size[0], height=size[1], threads=self.threads, progress=self.progress)

    def _take(self, cameras: Sequence[Camera], capture: Views | None) -> list[UInt8[np.ndarray, "H W 3"]]:
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
    """The same picture, as large as fits."""
    scale = min(width / camera.width, height / camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
