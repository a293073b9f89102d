"""Degenerate scenes, unlike any result of training."""

import numpy as np

import kissgs
from helpers.training_scenes import cloud
from kissgs.core.splats import ATTRIBUTES


def changed(scene, **arrays):
    given = {name: np.asarray(value, np.float32) for name, value in arrays.items()}
    return kissgs.clean(kissgs.Splats(**{**{name: getattr(scene, name) for name in ATTRIBUTES}, **given}))[0]


def needles():
    return changed(cloud(60), scales=np.tile([0.5, -30, -30], (60, 1)))


def pancakes():
    return changed(cloud(60), scales=np.tile([-1, -1, -30], (60, 1)))


def sky():
    scene = cloud(60)
    means, scales = scene.means.copy(), scene.scales.copy()
    means[:10] *= 1e4
    scales[:10] = 9
    scales[10:12] = 30
    return changed(scene, means=means, scales=scales)


def duplicates():
    return cloud(60).select(np.repeat(np.arange(6), 10))


def transparent():
    return changed(cloud(60), opacities=np.full(60, -13.0))


def opaque():
    return changed(cloud(60), opacities=np.full(60, np.inf), scales=np.full((60, 3), 1.0))


def points():
    return changed(cloud(60), scales=np.full((60, 3), -30.0))


def one_place():
    return changed(cloud(60), means=np.zeros((60, 3)))


def loud():
    return changed(cloud(60), sh0=cloud(60).sh0 * 1e6, shN=cloud(60).shN * 1e6)


SCENES = [needles, pancakes, sky, duplicates, transparent, opaque, points, one_place, loud]
