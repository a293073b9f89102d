"""The work of ``kissgs render``: an image, a path around the scene, or a sheet of all views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from kissgs.cameras.captures.transforms_json import is_camera_file, pick_view, view_of_file
from kissgs.cameras.views import Vec3, View, Views, check_images
from kissgs.cameras.virtual.select import (
    FIELD_OF_VIEW,
    SCORE_MARGIN,
    SceneBounds,
    ScoredCandidates,
    best_view,
    direction_at,
    horizontal_axes,
    opacity,
    overview_bonus,
    score_candidates,
    virtual_views,
    weighted_quantiles,
)
from kissgs.core.array_types import Bool, Float64, Int, UInt8
from kissgs.core.context import DEFAULT_CONTEXT, Context, Workers, load_kernels
from kissgs.core.errors import InvalidViewsError
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.constants import NEAR
from kissgs.rendering.images import Label, contact_sheet, reframed, render_all
from kissgs.rendering.rasterizer import BLACK, Colour


@dataclass(frozen=True, slots=True)
class Orbit:
    """A horizontal circle around a look-at target, and the arc of it from which the scene looks good."""

    target: Vec3  # point that all cameras look at, world units
    radius: float  # distance of the cameras from the target, world units; 0 to look around from the target itself
    elevation: float  # elevation of the cameras as seen from the target, radians
    up: Vec3
    mid_azimuth: float = 0.0  # of the middle of the arc; on a full circle, that of the best view; radians
    sweep: float = 2 * np.pi  # length of the arc, radians; 2 pi for a full circle

    @property
    def full(self) -> bool:
        """Whether the path is a full circle."""
        return self.sweep >= 2 * np.pi

    @property
    def description(self) -> str:
        """Short description for messages."""
        return "a full circle" if self.full else f"{np.degrees(self.sweep):.0f}° to and fro"

    def camera(self, azimuth: float, width: int, height: int) -> Camera:
        """Return the camera at ``azimuth``, radians; at radius 0, it looks from the target as on a larger circle."""
        direction = direction_at(self.up, self.elevation, azimuth)
        position = self.target + self.radius * direction
        return look_at(position, position - direction, self.up, fov=FIELD_OF_VIEW, width=width, height=height)

    def loop_cameras(self, frames: int, width: int, height: int) -> list[Camera]:
        """Return the cameras of an animation that loops without a jump. On an arc, the azimuth is a sine of time, slow
        at the ends. Frames that show the same view share one camera object, so that a caller can render it once."""
        check_images(frames, width, height)
        if self.full:
            azimuths = self.mid_azimuth + np.arange(frames) * (2 * np.pi / frames)
            return [self.camera(float(azimuth), width, height) for azimuth in azimuths]
        phases = [_swing_phase(frame, frames) for frame in range(frames)]
        swings = {phase: 0.5 * self.sweep * float(np.sin(np.pi * phase / frames)) for phase in sorted(set(phases))}
        by_phase = {phase: self.camera(self.mid_azimuth + swing, width, height) for phase, swing in swings.items()}
        return [by_phase[phase] for phase in phases]

    def sheet_cameras(self, frames: int, width: int, height: int) -> list[Camera]:
        """Return the cameras of a contact sheet: evenly spaced, once along the path."""
        check_images(frames, width, height)
        if self.full or frames == 1:
            return self.loop_cameras(frames, width, height)
        azimuths = self.mid_azimuth + np.linspace(-0.5, 0.5, frames) * self.sweep
        return [self.camera(float(azimuth), width, height) for azimuth in azimuths]


def _swing_phase(frame: int, frames: int) -> int:
    """Return the phase of a swing, -``frames``/2 to ``frames``/2, equal for frames at the same azimuth. It goes from
    the middle to one end, back through the middle to the other end, and to the middle again. Integers, so that phases
    of the way there and of the way back are exactly equal."""
    if 4 * frame <= frames:
        return 2 * frame
    if 4 * frame <= 3 * frames:
        return frames - 2 * frame
    return 2 * frame - 2 * frames


# The orbit with the longest arc of good views.
#
# Horizontal circles of several radii and elevations are scored by thumbnails all along them, like virtual cameras. A
# scene that was captured from one side dissolves towards the ends of the arc, where the path turns back.

COARSE_STEPS = 24  # number of thumbnails along each circle
FINE_STEPS = 72  # number of thumbnails along the circle that is selected
FULL_CIRCLE_TOLERANCE = 0.15  # of scores on a full circle: to pass a weak view is better than to turn back
MIN_SWEEP = float(np.radians(30))  # shortest arc, radians; on a shorter one the motion would hardly be noticed
RADII = (1.1, 1.5, 2.0, 2.6)  # radii of circles around the centre of a scene with a background, in radii of the scene
ELEVATIONS = (5, 15, 28)  # elevations of circles as seen from the centre, degrees
OBJECT_MARGIN = 1.1  # size of the frame around an object that stands alone, relative to the object
LOOK_AROUND_PITCH = 6  # downward pitch of cameras that look around from one position, degrees


def find_orbit(splats: Splats, context: Context = DEFAULT_CONTEXT, *, width: int = 640, height: int = 480) -> Orbit:
    """Return the orbit with the longest arc of good views; only the images' aspect ratio matters."""
    with Workers(context.threads) as pool:
        candidates = score_candidates(splats, (width, height), pool, context.progress)
        bounds = candidates.bounds
        min_score = candidates.scores.max() - SCORE_MARGIN
        if candidates.kind == "object":
            circles = list(_circles_around_object(splats, bounds, width / height))
        else:
            circles = list(_circles_in_scene(bounds, enclosed=candidates.kind == "enclosed"))
        scores = _scores(circles, COARSE_STEPS, candidates)
        ranks = [
            _rank(score - min_score, each.radius / bounds.radius) for each, score in zip(circles, scores, strict=True)
        ]
        best = circles[max(range(len(circles)), key=lambda n: ranks[n])]
        fine_scores = _scores([best], FINE_STEPS, candidates)[0]
    context.progress("cameras", 1.0)
    return _with_arc(best, fine_scores, min_score)


def _scores(circles: list[Orbit], steps: int, candidates: ScoredCandidates) -> Float64[np.ndarray, "circles steps"]:
    """Return the view scores at even steps along each circle."""
    width, height = candidates.cameras[0].width, candidates.cameras[0].height
    cameras = [camera for circle in circles for camera in circle.loop_cameras(steps, width, height)]
    return candidates.scores_of(cameras).reshape(len(circles), steps)


def _circles_in_scene(bounds: SceneBounds, *, enclosed: bool) -> Iterator[Orbit]:
    """Yield circles around the centre; if the scene encloses the cameras, also orbits of radius 0 that look around."""
    for radius in RADII:
        for elevation in ELEVATIONS:
            yield Orbit(bounds.centre, radius * bounds.radius, float(np.radians(elevation)), bounds.up)
    if enclosed:
        for rise in (0.0, 0.4):
            position = bounds.centre + rise * bounds.radius * bounds.up
            yield Orbit(position, 0.0, float(np.radians(LOOK_AROUND_PITCH)), bounds.up)


def _circles_around_object(splats: Splats, bounds: SceneBounds, aspect: float) -> Iterator[Orbit]:
    """Yield circles from which an upright cylinder around the object fits into every image of this width to height."""
    weights = opacity(splats)
    axes = np.stack([*horizontal_axes(bounds.up), bounds.up])
    offsets = (splats.means.astype(np.float64) - bounds.centre) @ axes.T
    low, high = np.transpose([weighted_quantiles(values, weights, 0.01, 0.99) for values in offsets.T])
    middle, half_extents = 0.5 * (high + low), 0.5 * (high - low)
    from_axis = np.linalg.norm((offsets - middle)[:, :2], axis=1)
    min_size = 0.1 * bounds.radius
    radius = max(*weighted_quantiles(from_axis, weights, 0.98), min_size)
    half_height = max(half_extents[2], min_size)
    target = bounds.centre + middle @ axes
    slopes = np.tan(0.5 * FIELD_OF_VIEW) * np.array([min(1.0, aspect), min(1.0, 1 / aspect)])
    for elevation in np.radians(ELEVATIONS):
        half_extent_up = half_height * np.cos(elevation) + radius * np.sin(elevation)
        half_depth = radius * np.cos(elevation) + half_height * np.sin(elevation)
        distance = max(OBJECT_MARGIN * max(radius / slopes[0], half_extent_up / slopes[1]), 2 * NEAR) + half_depth
        yield Orbit(target, float(distance), float(elevation), bounds.up)


def _rank(surplus: Float64[np.ndarray, " steps"], radii: float) -> tuple[bool, float]:
    """Return the sort key of a circle: full circles first, then by the scores along the longest arc. The sum of scores
    is divided by the square root of the length, so that an arc four times as long ranks like scores twice as high: the
    ends of a long arc are seldom its best views."""
    good = _acceptable(surplus)
    steps = _longest_run(good)
    total = (surplus + overview_bonus(radii)).take(steps, mode="wrap").sum()
    return bool(good.all()), float(total / max(len(steps), 1) ** 0.5)


def _acceptable(surplus: Float64[np.ndarray, " steps"]) -> Bool[np.ndarray, " steps"]:
    """Return which steps show good views; slightly worse ones are accepted if the whole circle is then."""
    full_circle = (surplus >= -FULL_CIRCLE_TOLERANCE).all()
    return np.asarray(surplus >= (-FULL_CIRCLE_TOLERANCE if full_circle else 0))


def _longest_run(good: Bool[np.ndarray, " steps"]) -> Int[np.ndarray, " run"]:
    """Return the steps of the longest run of good ones on a circle, in order. A run that passes the last step continues
    with indices from ``len(good)`` on."""
    count = len(good)
    if good.all():
        return np.arange(count)
    begin = int(np.flatnonzero(~good)[0])  # no run is cut in two if the circle is opened at a bad step
    rolled = np.roll(good, -begin)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], rolled, [False]]).astype(np.int8)))
    if not len(edges):
        return np.empty(0, np.int64)
    starts, ends = edges[::2], edges[1::2]
    longest = int((ends - starts).argmax())
    return np.arange(begin + starts[longest], begin + ends[longest])


def _with_arc(circle: Orbit, scores: Float64[np.ndarray, " steps"], min_score: float) -> Orbit:
    """Return the circle with the longest arc of good views, at least :data:`MIN_SWEEP` long."""
    step = 2 * np.pi / len(scores)
    steps = _longest_run(_acceptable(scores - min_score))
    if len(steps) == len(scores):
        return replace(circle, mid_azimuth=step * int(scores.argmax()))
    if len(steps) == 0:
        return replace(circle, mid_azimuth=step * int(scores.argmax()), sweep=MIN_SWEEP)
    sweep = max(step * (len(steps) - 1), MIN_SWEEP)
    return replace(circle, mid_azimuth=0.5 * step * float(steps[0] + steps[-1]), sweep=sweep)


IMAGE_SIZE, FRAME_SIZE, CELL_SIZE = (1280, 960), (640, 480), (320, 240)
"""Default (width, height), pixels: of a single image, of an animation's frames, of the images on a contact sheet."""

ANIMATION_FRAMES, SHEET_FRAMES = 48, 24  # default number of images of an orbit, in an animation and on a contact sheet

HELD_OUT = " · held out"


@dataclass(frozen=True, slots=True, eq=False)
class RenderedImages:
    """Result of a render job."""

    images: Sequence[UInt8[np.ndarray, "H W 3"]]  # one image or contact sheet, or the frames of an animation
    views: Sequence[View]  # in the world's coordinates; of a contact sheet, those of all its cells
    description: str  # description of the views, for people


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderJob:
    """Renderer of a scene with the choices of ``kissgs render``."""

    splats: Splats  # without non-finite values (clean)
    size: tuple[int, int] | None = None  # of each image, pixels; None: the camera's size, else the default
    background: Colour | None = None  # RGB, 0 to 1; None for that of the capture, else black
    context: Context = DEFAULT_CONTEXT

    def single(self, capture: Views | None, which: str | None) -> RenderedImages:
        """Render a single image, by default at the camera's size."""
        load_kernels(self.context.progress)
        if which is not None and is_camera_file(which):
            view, source = view_of_file(which).relative_to(self.splats.origin), "camera file"
        elif capture is not None:
            view, source = pick_view(capture.all, which or "0", capture.source), capture.source
        elif which is None:
            width, height = self.size or IMAGE_SIZE
            view = best_view(self.splats, self.context, width=width, height=height)
            source = "best of the virtual cameras"
        else:
            virtual = self._virtual(self.size or IMAGE_SIZE)
            view, source = pick_view(virtual.all, which, virtual.source), virtual.source
        if self.size is not None:
            view = View(view.name, reframed(view.camera, *self.size))
        return RenderedImages(self._render([view.camera], capture), self._in_world([view]), f"{view.name} ({source})")

    def animation(self, frames: int | None = None) -> RenderedImages:
        """Render an orbit around the scene, as the frames of an animation that loops."""
        size = self.size or FRAME_SIZE
        orbit = self._orbit(size)
        cameras = orbit.loop_cameras(frames or ANIMATION_FRAMES, *size)
        views = self._in_world(_numbered(cameras))
        return RenderedImages(self._render(cameras, None), views, f"{len(cameras)} frames, {orbit.description}")

    def orbit_sheet(self, frames: int | None = None) -> RenderedImages:
        """Render an orbit around the scene, as one contact sheet."""
        size = self.size or CELL_SIZE
        orbit = self._orbit(size)
        cameras = orbit.sheet_cameras(frames or SHEET_FRAMES, *size)
        views = self._in_world(_numbered(cameras))
        sheet = contact_sheet(self._render(cameras, None))
        return RenderedImages([sheet], views, f"{len(cameras)} images, {orbit.description}")

    def view_sheet(self, capture: Views | None) -> RenderedImages:
        """Render a contact sheet of the capture's views, else of the virtual views, with names and held-out marks."""
        load_kernels(self.context.progress)
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

    def _orbit(self, size: tuple[int, int]) -> Orbit:
        load_kernels(self.context.progress)
        return find_orbit(self.splats, self.context, width=size[0], height=size[1])

    def _virtual(self, size: tuple[int, int]) -> Views:
        threads, progress = self.context.threads, self.context.progress
        return virtual_views(self.splats, width=size[0], height=size[1], threads=threads, progress=progress)

    def _render(self, cameras: Sequence[Camera], capture: Views | None) -> list[UInt8[np.ndarray, "H W 3"]]:
        background = self.background
        if background is None:
            background = BLACK if capture is None else capture.background.tolist()
        return render_all(self.splats, cameras, self.context, background=background)


def _numbered(cameras: Sequence[Camera]) -> list[View]:
    digits = len(str(len(cameras) - 1))
    return [View(f"orbit_{n:0{digits}}", camera) for n, camera in enumerate(cameras)]


def _within(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera resized to the largest image that fits into ``width`` x ``height``."""
    scale = min(width / camera.width, height / camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
