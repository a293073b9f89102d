"""Contact sheets: many pictures on one, with or without something written under them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from kissgs.core.array_types import UInt8
from kissgs.core.errors import UnsupportedError

PAGE, INK, MARK = (24, 24, 26), (225, 225, 225), (255, 190, 60)
"""Colours of the page, of what is written, and of what is marked."""

GAP = 4
"""Pixels between pictures, and around them all."""

MAX_PIXELS = 1 << 28
"""Of a sheet; what opens pictures refuses more."""


@dataclass(frozen=True, slots=True)
class Label:
    """What stands under a picture; ``marked`` in another colour."""

    text: str
    marked: bool = False


def contact_sheet(
    pictures: Sequence[UInt8[np.ndarray, "_ _ 3"]], labels: Sequence[Label] = (), *, columns: int | None = None
) -> UInt8[np.ndarray, "H W 3"]:
    """Pictures in rows from left to right, each in the middle of its cell.

    Args:
        pictures: one or more. The cells are as large as the largest.
        labels: one for each picture, or none at all.
        columns: by default as many as make the sheet some 3 to 2.

    Raises:
        UnsupportedError: the sheet would be too large.
    """
    width, height = max(p.shape[1] for p in pictures), max(p.shape[0] for p in pictures)
    font = ImageFont.load_default(size=max(11, min(width // 20, 28)))
    strip = round(1.6 * sum(_metrics(font))) if labels else 0
    across, down = width + GAP, height + strip + GAP
    if columns is None:
        columns = even_columns(len(pictures), across / down)
    rows = -(-len(pictures) // columns)
    size = columns * across + GAP, rows * down + GAP
    if size[0] * size[1] > MAX_PIXELS:
        raise UnsupportedError(f"a sheet of {size[0]:,}x{size[1]:,} pixels is too large; make its pictures smaller")
    sheet = Image.new("RGB", size, PAGE)
    pen = ImageDraw.Draw(sheet)
    for number, picture in enumerate(pictures):
        left, top = GAP + number % columns * across, GAP + number // columns * down
        place = left + (width - picture.shape[1]) // 2, top + (height - picture.shape[0]) // 2
        sheet.paste(Image.fromarray(picture), place)
        if labels:
            label, middle = labels[number], (left + width // 2, top + height + strip // 2)
            text = _fitted(label.text, font, width)
            pen.text(middle, text, fill=MARK if label.marked else INK, font=font, anchor="mm")
    return np.asarray(sheet)


def even_columns(count: int, shape: float) -> int:
    """How many cells of ``shape``, width by height, to a row: near 3 to 2 in all, and few places empty."""

    def badness(columns: int) -> tuple[float, int]:
        rows = -(-count // columns)
        empty = 5 * (rows * columns - count) / count
        return abs(float(np.log(columns * shape / rows / 1.5))) + empty, columns

    return min(range(1, count + 1), key=badness)


Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


def _metrics(font: Font) -> tuple[int, int]:
    """Above and below the line; without FreeType, Pillow has a font of one size only."""
    return font.getmetrics() if isinstance(font, ImageFont.FreeTypeFont) else (10, 2)


def _fitted(text: str, font: Font, width: int) -> str:
    """Its end, which tells file names apart, if the whole is too long; no line breaks."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    start = 0
    while start < len(text) and font.getlength(("…" if start else "") + text[start:]) > width:
        start += 1
    return ("…" if start else "") + text[start:]
