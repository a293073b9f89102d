"""Rendered images with 8 bits per channel, as PNG, WebP or animated WebP, and sheets of many."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.context import DEFAULT_CONTEXT, Context
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import BLACK, Colour, render

LOSSLESS = 100  # value of quality that means lossless WebP
MAX_WEBP_SIDE = 16_383  # largest side of a WebP image, pixels: the format has 14 bits for it
MAX_PIXEL_BYTES = 4 << 30  # largest size of the pixels of all images together, bytes: they are all in memory at once


def render_all(
    splats: Splats, cameras: Sequence[Camera], context: Context = DEFAULT_CONTEXT, *, background: Colour = BLACK
) -> list[UInt8[np.ndarray, "H W 3"]]:
    """Render an image for each camera, with 8 bits per channel; a repeated camera object gives the same array."""
    if 3 * sum(camera.width * camera.height for camera in cameras) > MAX_PIXEL_BYTES:
        raise UnsupportedError(
            f"{len(cameras)} images of this size would take too much memory, more than {MAX_PIXEL_BYTES >> 30} GiB; "
            "make them smaller"
        )
    rendered: dict[int, UInt8[np.ndarray, "H W 3"]] = {}
    for done, camera in enumerate(cameras):
        context.progress("render", done / len(cameras))
        if id(camera) not in rendered:
            image, _ = render(splats, camera, background=background, threads=context.threads, device=context.device)
            rendered[id(camera)] = to_bytes(image)
    context.progress("render", 1.0)
    return [rendered[id(camera)] for camera in cameras]


def to_bytes(image: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Return values from 0 to 1 as 0 to 255, rounded; values outside are clamped, NaN becomes 0."""
    return np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)


def reframed(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera with another image size; with another aspect ratio it sees more on two sides, never less."""
    scale = min(width / camera.width, height / camera.height)
    K = camera.K * scale
    K[2, 2] = 1
    K[0, 2] += 0.5 * (width - scale * camera.width)
    K[1, 2] += 0.5 * (height - scale * camera.height)
    return Camera(camera.viewmat, K, width, height)


def png(pixels: UInt8[np.ndarray, "H W 3"]) -> bytes:
    """Return the image as a PNG file."""
    stream = io.BytesIO()
    Image.fromarray(pixels).save(stream, "PNG")
    return stream.getvalue()


def animated_webp(frames: Sequence[UInt8[np.ndarray, "H W 3"]], *, fps: float, quality: int) -> bytes:
    """Return the frames as an animated WebP file that repeats for ever, or a single frame as a still one. Durations are
    whole milliseconds such that the total duration is right. ``quality``: 0 to :data:`LOSSLESS`."""
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


# Contact sheets: many images on one, with or without labels.

PAGE_COLOUR, TEXT_COLOUR, MARKED_COLOUR = (24, 24, 26), (225, 225, 225), (255, 190, 60)
"""Colours of the background, of labels and of marked labels, 8-bit RGB."""

GAP = 4  # space between images and around all of them, pixels
MAX_PIXELS = 1 << 28  # largest number of pixels of a contact sheet; many programs refuse to open more


@dataclass(frozen=True, slots=True)
class Label:
    """Text under an image; ``marked`` gives it another colour."""

    text: str
    marked: bool = False


def contact_sheet(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]], labels: Sequence[Label] = (), *, columns: int | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Return the images on a contact sheet, in rows from left to right, each in the middle of its cell. Cells have the
    size of the largest image. By default there are so many ``columns`` that the sheet is about 3 to 2."""
    width, height = max(p.shape[1] for p in images), max(p.shape[0] for p in images)
    font = ImageFont.load_default(size=max(11, min(width // 20, 28)))
    label_height = round(1.6 * sum(_metrics(font))) if labels else 0
    across, down = width + GAP, height + label_height + GAP
    if columns is None:
        columns = balanced_columns(len(images), across / down)
    rows = -(-len(images) // columns)
    size = columns * across + GAP, rows * down + GAP
    if size[0] * size[1] > MAX_PIXELS:
        raise UnsupportedError(
            f"a contact sheet has at most {MAX_PIXELS:,} pixels, not {size[0]:,}x{size[1]:,}; make its images smaller"
        )
    sheet = Image.new("RGB", size, PAGE_COLOUR)
    drawing = ImageDraw.Draw(sheet)
    for number, image in enumerate(images):
        left, top = GAP + number % columns * across, GAP + number // columns * down
        position = left + (width - image.shape[1]) // 2, top + (height - image.shape[0]) // 2
        sheet.paste(Image.fromarray(image), position)
        if labels:
            label, middle = labels[number], (left + width // 2, top + height + label_height // 2)
            text = _fitted(label.text, font, width)
            drawing.text(middle, text, fill=MARKED_COLOUR if label.marked else TEXT_COLOUR, font=font, anchor="mm")
    return np.asarray(sheet)


def balanced_columns(count: int, aspect: float) -> int:
    """Return the number of columns for ``count`` cells of this aspect ratio: about 3 to 2 in total, few cells empty."""

    def badness(columns: int) -> tuple[float, int]:
        rows = -(-count // columns)
        empty = 5 * (rows * columns - count) / count
        return abs(float(np.log(columns * aspect / rows / 1.5))) + empty, columns

    return min(range(1, count + 1), key=badness)


Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


def _metrics(font: Font) -> tuple[int, int]:
    """Return ascent and descent, pixels; without FreeType, Pillow has a font of one size only."""
    return font.getmetrics() if isinstance(font, ImageFont.FreeTypeFont) else (10, 2)


def _fitted(text: str, font: Font, width: int) -> str:
    """Return the text on one line, or only its end, which distinguishes file names, if it is wider than ``width``."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    start = 0
    while start < len(text) and font.getlength(("…" if start else "") + text[start:]) > width:
        start += 1
    return ("…" if start else "") + text[start:]
