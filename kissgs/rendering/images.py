"""Pictures as files: 8 bits per channel, as PNG or WebP, alone or as a film."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from PIL import Image

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import BLACK, Colour, Device, render

LOSSLESS = 100
"""The quality of WebP that keeps every pixel."""

MAX_WEBP_SIDE = 16_383
"""Pixels; the format has 14 bits for a side."""

MAX_FILM_BYTES = 4 << 30
"""Of a film's pixels, which are all in memory at once."""


def render_all(
    splats: Splats,
    cameras: Sequence[Camera],
    *,
    background: Colour = BLACK,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Take pictures as a screen shows them; of a camera that comes again, it is the same array.

    Args:
        splats: finite (:func:`kissgs.clean`).
        cameras: from where.
        background: RGB from 0 to 1.
        threads: of the processor; 0 means one each.
        device: ``"cuda"`` needs the extra ``kissgs[cuda]``.
        progress: receives the stage ``"render"``.

    Raises:
        UnsupportedError: the pictures would take too much memory; no CUDA here.
    """
    if 3 * sum(camera.width * camera.height for camera in cameras) > MAX_FILM_BYTES:
        raise UnsupportedError(f"{len(cameras)} pictures of this size would take too much memory; make them smaller")
    taken: dict[int, UInt8[np.ndarray, "H W 3"]] = {}
    for done, camera in enumerate(cameras):
        progress("render", done / len(cameras))
        if id(camera) not in taken:
            image, _ = render(splats, camera, background=background, threads=threads, device=device)
            taken[id(camera)] = to_bytes(image)
    progress("render", 1.0)
    return [taken[id(camera)] for camera in cameras]


def to_bytes(image: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """0 to 1 as 0 to 255, rounded; what is beyond is clamped."""
    return np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)


def reframed(camera: Camera, width: int, height: int) -> Camera:
    """The same place and direction in a picture of another size; in another shape, more is seen, never less."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * scale
    K[2, 2] = 1
    K[0, 2] += 0.5 * (width - scale * camera.width)
    K[1, 2] += 0.5 * (height - scale * camera.height)
    return Camera(camera.viewmat, K, width, height)


def png(pixels: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """As a PNG file."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def film(frames: Sequence[UInt8[np.ndarray, "H W 3"]], *, fps: float, quality: int) -> bytes:
    """As an animated WebP that repeats for ever; a plain one if it has a single frame.

    Args:
        frames: one or more, all of one size.
        fps: frames per second; each is shown for a whole number of milliseconds, so that the film takes the right time.
        quality: 0 to 100, which is lossless.

    Raises:
        UnsupportedError: a side is too long for the format.
    """
    height, width = frames[0].shape[:2]
    if max(width, height) > MAX_WEBP_SIDE:
        raise UnsupportedError(
            f"a WebP has at most {MAX_WEBP_SIDE:,} pixels a side, not {width}x{height}; write a .png or make it smaller"
        )
    times = np.rint(np.arange(len(frames) + 1) * (1000 / fps)).astype(int)
    first, *others = (Image.fromarray(frame) for frame in frames)
    options = {"lossless": True} if quality == LOSSLESS else {"quality": quality, "method": 4}
    if others:
        options |= {"save_all": True, "append_images": others, "duration": np.diff(times).tolist(), "loop": 0}
    stream = io.BytesIO()
    first.save(stream, "WEBP", **options)
    return stream.getvalue()
