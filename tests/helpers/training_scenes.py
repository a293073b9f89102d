"""Small scenes and their training targets."""

import numpy as np

import kissgs
from kissgs.cameras.views import View, black
from kissgs.rendering.camera import look_at
from kissgs.training.supervision import SupervisionViews, training_targets


def cloud(count=60, degree=1, seed=0):
    """Return coloured Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    k = (0, 3, 8, 15)[degree]
    f32 = np.float32
    return kissgs.clean(
        kissgs.Splats(
            means=rng.normal(0, 0.6, (count, 3)).astype(f32),
            quats=rng.normal(size=(count, 4)).astype(f32),
            scales=rng.normal(-2, 0.4, (count, 3)).astype(f32),
            opacities=rng.normal(0.5, 1.5, count).astype(f32),
            sh0=rng.normal(0, 1, (count, 3)).astype(f32),
            shN=rng.normal(0, 0.1, (count, k, 3)).astype(f32),
        )
    )[0]


def around(count=4, size=40):
    """Return views on a circle around the origin."""
    views = []
    for n in range(count):
        angle = 2 * np.pi * n / count
        place = np.array([3 * np.cos(angle), 0.5, 3 * np.sin(angle)])
        camera = look_at(place, np.zeros(3), np.array([0.0, -1, 0]), fov=0.9, width=size, height=size - 8)
        views.append(View(f"view{n}", camera))
    return tuple(views)


def targets_of(scene, views=None, background=None, **changes):
    background = black() if background is None else background
    return training_targets(scene, SupervisionViews(views or around(), (), (), background, "views", **changes))


def same(one, other):
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in kissgs.core.splats.ATTRIBUTES)
