"""Small scenes for rendering tests, and cameras that see them."""

import numpy as np

from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats
from kissgs.rendering.camera import look_at


def blobs(count, degree=1, seed=0, spread=0.8, log_scale=-1.5):
    """Return Gaussians around the origin with random shapes, rotations (not normalised), opacities and colours."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(0, spread, (count, 3)).astype(np.float32),
        quats=rng.normal(0, 1, (count, 4)).astype(np.float32),
        scales=rng.normal(log_scale, 0.8, (count, 3)).astype(np.float32),
        opacities=rng.normal(0, 2.5, count).astype(np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=rng.normal(0, 0.3, (count, SH_REST_COUNTS[degree], 3)).astype(np.float32),
    )


def one(mean=(0, 0, 0), quat=(1, 0, 0, 0), scale=(-2, -2, -2), opacity=2.0, sh0=(1, 1, 1), shN=()):
    """Return a single Gaussian."""
    return Splats(
        means=np.array([mean], np.float32),
        quats=np.array([quat], np.float32),
        scales=np.array([scale], np.float32),
        opacities=np.array([opacity], np.float32),
        sh0=np.array([sh0], np.float32),
        shN=np.array(shN, np.float32).reshape(1, -1, 3),
    )


def together(*scenes):
    return Splats(**{name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in ATTRIBUTES})


def in_float64(splats):
    return {name: getattr(splats, name).astype(np.float64) for name in ATTRIBUTES}


def camera(width=37, height=29, distance=3.0, fov=0.8, seed=None):
    """Return a camera at a distance from the origin that looks at it; from a random side if there is a seed."""
    direction = np.array([0.1, -0.13, -1.0])
    if seed is not None:
        direction = np.random.default_rng(seed).normal(0, 1, 3)
    direction *= distance / np.linalg.norm(direction)
    return look_at(direction, np.zeros(3), np.array([0.0, -1.0, 0.0]), fov=fov, width=width, height=height)
