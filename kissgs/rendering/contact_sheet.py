"""Contact sheets: many images on one, with or without labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kissgs.core.array_types import UInt8
from kissgs.core.errors import UnsupportedError

PAGE_COLOUR, TEXT_COLOUR, MARKED_COLOUR = (24, 24, 26), (225, 225, 225), (255, 190, 60)
"""Colours of the background, of labels and of marked labels, 8-bit RGB."""

GAP = 4
"""Space between images and around all of them, pixels."""

MAX_PIXELS = 1 << 28
"""Largest number of pixels of a contact sheet; many programs refuse to open more."""


@dataclass(frozen=True, slots=True)
class Label:
    """Text under an image; ``marked`` gives it another colour."""

    text: str
    marked: bool = False


def contact_sheet(
    images: Sequence[UInt8[np.ndarray, "_ _ 3"]], labels: Sequence[Label] = (), *, columns: int | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Return the images on a contact sheet, in rows from left to right, each in the middle of its cell.

    Args:
        images: one or more. Cells have the size of the largest.
        labels: one for each image, or none.
        columns: number of images per row; by default such that the contact sheet is about 3 to 2.

    Raises:
        UnsupportedError: the contact sheet would have more than :data:`MAX_PIXELS`.
    """
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
