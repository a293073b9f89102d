"""Largest sizes of scenes and of a container's images; encoders respect them and decoders refuse more."""

from __future__ import annotations

MAX_GRID_SIDE = 13_376
"""Largest side of the grid, pixels: Pillow refuses larger images as decompression bombs; WebP's limit is 16383."""

MAX_CODEBOOK_SIDE = 256
"""Largest side of the codebook's tiles, pixels: labels have two 8-bit coordinates."""

MAX_GAUSSIANS = 20_000_000
"""Default limit: 5 GB of arrays. A compressed file of some kilobytes can declare more than any memory holds."""
