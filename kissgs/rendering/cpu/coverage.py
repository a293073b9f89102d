"""Numba kernel of coverage: how well an image shows each Gaussian, by visibility and resolution."""

from __future__ import annotations

import numpy as np
from numba import float32, float64, int32, int64, void

from kissgs.core.numba_kernels import compiled
from kissgs.rendering.cpu.records import GAUSSIANS, PROJECTION, Gaussians, Projection


@compiled(void(GAUSSIANS, PROJECTION, float32[::1], int32[::1], int64, int64, float32[::1], float64[::1], float32[::1]))
def raise_coverage(
    gaussians: Gaussians,
    projection: Projection,
    local_scale: np.ndarray,
    visible: np.ndarray,
    first: int,
    last: int,
    seen: np.ndarray,
    limits: np.ndarray,
    share: np.ndarray,
) -> None:
    """Raise the coverage, ``share``, of the Gaussians of footprints ``first`` to ``last`` (exclusive) by one image.

    ``seen`` is the sum of (alpha T)² over the pixels of each footprint. ``limits``: share of the squared alpha from
    which a Gaussian counts as seen; length in the image of the local scale from which it counts as resolved, pixels;
    area of a squared Gaussian that is a dilated point, pixels.
    """
    means, scales, K, eye = gaussians.means, gaussians.scales, projection.K, projection.eye
    seen_share, resolved_length, dilated_area = limits[0], limits[1], limits[2]
    focal, pixels = np.sqrt(K[0, 0] * K[1, 1]), np.float64(projection.width * projection.height)
    for row in range(first, last):
        n = visible[row]
        x, y, z = means[n, 0] - eye[0], means[n, 1] - eye[1], means[n, 2] - eye[2]
        per_unit = focal / max(np.sqrt(x * x + y * y + z * z), projection.near)
        a, b, c = np.float64(scales[n, 0]), np.float64(scales[n, 1]), np.float64(scales[n, 2])
        across = a + b + c - min(a, b, c)  # of the two largest
        area = np.pi * np.exp(across) * per_unit * per_unit + dilated_area  # of a squared Gaussian
        opacity = 1.0 / (1.0 + np.exp(-np.float64(gaussians.opacities[n])))
        if projection.antialiased:
            opacity *= (area - dilated_area) / area
        shown = max(opacity * opacity * min(area, pixels), 1e-300)
        visibility = min(seen[row] / (seen_share * shown), 1.0)
        resolution = min(np.float64(local_scale[n]) * per_unit / resolved_length, 1.0)
        share[n] = max(share[n], np.float32(visibility * resolution * resolution))
