"""Scenes of surfaces."""

import numpy as np

from kissgs.core.splats import SH_C0, Splats


def surface(points, normals_along, size, thin=0.1, colour=0.5):
    """Return flat opaque Gaussians at ``points``, with normals along the axes ``normals_along`` (0 to 2)."""
    count = len(points)
    scales = np.full((count, 3), np.log(size))
    scales[np.arange(count), normals_along] += np.log(thin)
    return Splats(
        means=points.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=scales.astype(np.float32),
        opacities=np.full(count, 3, np.float32),
        sh0=np.full((count, 3), (colour - 0.5) / SH_C0, np.float32),
        shN=np.empty((count, 0, 3), np.float32),
    )


def box(half, count=20_000, size=0.06, seed=0):
    """Return the six faces of a box around the origin."""
    rng = np.random.default_rng(seed)
    axis = rng.integers(0, 3, count)
    points = rng.uniform(-1, 1, (count, 3)) * half
    points[np.arange(count), axis] = rng.choice([-1, 1], count) * np.array(half)[axis]
    return surface(points, axis, size)
