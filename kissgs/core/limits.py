"""How large the images of a container may be: what encoders keep to and decoders refuse."""

from __future__ import annotations

MAX_GRID_SIDE = 13_376
"""Pillow refuses larger images (a guard against decompression bombs); WebP itself ends at 16383."""

MAX_CODEBOOK_SIDE = 256
"""Labels have two 8-bit coordinates."""
