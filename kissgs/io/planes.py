"""Compression of all planes of a container, in parallel."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from kissgs.core.array_types import UInt8
from kissgs.core.threads import Workers
from kissgs.io.webp import encode_plane
from kissgs.settings import EncodeSettings

HIGHEST_EFFORT = (100, 6)
"""Quality and method of libwebp for the smallest files."""


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
        slow = settings.codebook_max_effort and name == codebook
        quality, method = HIGHEST_EFFORT if slow else (settings.webp_quality, settings.webp_method)
        return encode_plane(images[name], quality=quality, method=method)

    names = sorted(images, key=lambda name: (name != codebook, -images[name].size))
    files = dict(zip(names, pool.map(work, names, report), strict=True))
    return {name: files[name] for name in images}
