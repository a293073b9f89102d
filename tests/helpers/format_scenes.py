"""Scenes to write in other formats, and how alike two readings of one are."""

import numpy as np

from kissgs.core.splats import ATTRIBUTES, Splats

COEFFICIENTS = (0, 3, 8, 15)


def made_scene(count, degree, *, extremes=True):
    """Return a scene of random values; with ``extremes``, its first rows have the ends of every attribute."""
    rng = np.random.default_rng([count, degree])

    def normal(*shape, scale=1.0):
        return (rng.normal(size=shape) * scale).astype(np.float32)

    quats = normal(count, 4)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    splats = Splats(
        means=normal(count, 3, scale=5),
        quats=quats,
        scales=normal(count, 3) - np.float32(4),
        opacities=normal(count, scale=3),
        sh0=normal(count, 3),
        shN=normal(count, COEFFICIENTS[degree], 3, scale=0.3),
    )
    if extremes and count >= 8:
        splats.means[:4] = [[0, 0, 0], [-2000, 2000, 1e-4], [-0.0, 1e-6, -1e-6], [1, -1, 1]]
        splats.quats[:4] = [[1, 0, 0, 0], [0, 0, 0, -1], [0, -1, 0, 0], [0.5, -0.5, 0.5, -0.5]]
        splats.scales[:3] = [[-10, 5, -4], [-9.99, -30, 3], [0, 0, 0]]
        splats.opacities[:4] = [-40, 40, 0, -5.6]
        splats.sh0[:3] = [[-4, 4, 0], [1.77, -1.77, 0.01], [-1.78, 1.78, 3]]
        splats.shN[:2] = 2
        splats.shN[2:4] = -2
    return splats


def assert_alike(found, wanted, *, rtol=0.0, atol=0.0, opacities=0.015):
    """Assert that scenes are equal within the tolerances, whatever the sign of quaternions and logits beyond 13.8."""
    assert len(found) == len(wanted)
    assert found.sh_degree == wanted.sh_degree
    for name in ATTRIBUTES:
        a, b = getattr(found, name), getattr(wanted, name)
        if name == "quats":
            b = np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b)
        extra = opacities if name == "opacities" else 0
        np.testing.assert_allclose(a, b, rtol=rtol, atol=max(atol, extra), err_msg=name)
