"""More cameras from few: around each good one some that stand, look and zoom a little differently.

What is fitted to few pictures falls apart between them. On fox, whose own pictures taught it from 96 virtual cameras, a
fifth of its Gaussians were 31.1 dB from the original where photographs had been taken; from four times as many,
scattered about these, 34.1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from kissgs.rendering.camera import look_at
from kissgs.views.view import View

STROLL = 0.5
"""How far from its place a camera moves, radii of the scene: root mean square."""

GLANCE = 0.3
"""By how much its line of sight turns, radians: root mean square."""

FIELDS_OF_VIEW = np.radians((50, 90))
"""Angles along the longer side: from phones' to wide angle."""


def wander(views: Sequence[View], each: int, radius: float, seed: int) -> Iterator[View]:
    """``each`` views about every one of these, the first from its very place.

    Args:
        views: good ones.
        each: at least 1.
        radius: of the scene (:class:`kissgs.views.anatomy.Anatomy`).
        seed: another one, other views.
    """
    rng = np.random.default_rng(seed)
    for view in views:
        camera = view.camera
        _, down, forward = camera.viewmat[:3, :3]
        for n in range(each):
            step, turn = rng.normal(size=(2, 3)) / np.sqrt(3)
            place = camera.position + (STROLL * radius * step if n else 0.0)
            look = forward + GLANCE * turn
            fov = float(rng.uniform(*FIELDS_OF_VIEW))
            moved = look_at(place, place + look, -down, fov=fov, width=camera.width, height=camera.height)
            yield replace(view, name=f"{view.name}_{n}", camera=moved)
