"""Compression of all planes of a container, in parallel."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.resources import Workers
from kissgs.io.images import encode_plane
from kissgs.settings import EncodeSettings

HIGHEST_EFFORT, HIGH_EFFORT = (100, 6), (100, 5)
"""Quality and method of libwebp for the codebook, and at least for small images that gain from more effort."""

NO_GAIN = ("mask", "means", "labels")  # parts of the names of images that no effort makes smaller
USUAL_EFFORT = (75, 4)  # quality and method up to which large images take less effort
LARGE = 500_000  # pixels from which an image is large: more effort than effort_of gives saves 0.1 % in twice the time


def compress_images(
    images: Mapping[str, UInt8[np.ndarray, "_ _ _"]],
    settings: EncodeSettings,
    pool: Workers,
    report: Callable[[float], None],
    *,
    codebook: str = "f_rest_centroids.webp",
) -> dict[str, bytes]:
    """Compress all images of a container in parallel, the slowest first: the one called ``codebook``."""

    def work(name: str) -> bytes:
        height, width, _ = shape = images[name].shape
        quality, method = effort_of(shape, settings.webp_quality, settings.webp_method)
        gains = not any(part in name for part in NO_GAIN)
        if settings.codebook_max_effort and name == codebook:
            quality, method = HIGHEST_EFFORT
        elif gains and height * width <= settings.high_effort_pixels:
            quality, method = max(quality, HIGH_EFFORT[0]), max(method, HIGH_EFFORT[1])
        return encode_plane(images[name], quality=quality, method=method)

    names = sorted(images, key=lambda name: (name != codebook, -images[name].size))
    files = dict(zip(names, pool.map(work, names, report), strict=True))
    return {name: files[name] for name in images}


def effort_of(shape: tuple[int, ...], quality: int, method: int) -> tuple[int, int]:
    """Return libwebp's quality and method for an image, given those of the settings.

    Large images take less effort where it saves next to nothing (docs/benchmarks.md), unless the settings ask for more
    than :data:`USUAL_EFFORT`. Those of one channel even become smaller with a lower quality.
    """
    height, width, channels = shape
    if height * width < LARGE or quality > USUAL_EFFORT[0] or method > USUAL_EFFORT[1]:
        return quality, method
    return (min(quality, 25), method) if channels == 1 else (min(quality, 50), min(method, 2))
