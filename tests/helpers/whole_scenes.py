"""Scenes with parts that are easily overlooked, and cameras, independent of kissgs's own, that see all parts."""

from dataclasses import replace

import numpy as np

from kissgs import Camera, Splats, render, sample_scene
from kissgs.core.splats import concatenate

KINDS = ("all around", "close up", "farther off", "across")
BACKGROUNDS = (0.0, 0.5, 1.0)


def moved(splats, *, by=(0, 0, 0), scale=1.0):
    """Return a copy, scaled about the origin and then translated."""
    means = (splats.means.astype(np.float64) * scale + by).astype(np.float32)
    return replace(splats, means=means, scales=splats.scales + np.float32(np.log(scale)))


def joined(*parts):
    """Return all parts in one scene, in random order."""
    whole = concatenate(parts)
    return whole.select(np.random.default_rng(5).permutation(len(whole)))


def surface(points, normals, size, seed):
    """Return flat, nearly opaque Gaussians on a surface, with varying colours."""
    rng = np.random.default_rng(seed)
    n = len(points)
    axis = np.cross(np.array([0.0, 0.0, 1.0]), normals)
    w = 1 + normals[:, 2]
    flipped = w < 1e-6
    quats = np.concatenate([w[:, None], axis], axis=1)
    quats[flipped] = (0, 1, 0, 0)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.log(size) + rng.normal(0, (0.3, 0.3, 0.3), (n, 3)) - (0, 0, 2)
    waves = np.sin(points @ rng.normal(0, 2 / np.ptp(points).clip(1e-9), (3, 9)) * 6).reshape(n, 3, 3).mean(axis=2)
    return Splats(
        means=points.astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=rng.normal(3, 1.5, n).astype(np.float32),
        sh0=(1.2 * waves + rng.normal(0, 0.1, (n, 3))).astype(np.float32),
        shN=rng.normal(0, 0.03, (n, 15, 3)).astype(np.float32),
    )


def two(distance, scale=1.0, count=6000):
    """Return two objects of ``count`` Gaussians."""
    return joined(sample_scene(count), moved(sample_scene(count, seed=1), by=(distance, 0, 0), scale=scale))


def five():
    """Return five objects of 600 to 9,600 Gaussians."""
    places = ((0, 0, 0), (150, 0, 0), (0, 0, 150), (-150, 20, 0), (300, 0, 300))
    counts = (9600, 4800, 2400, 1200, 600)
    return joined(
        *(moved(sample_scene(count, seed=n), by=at) for n, (count, at) in enumerate(zip(counts, places, strict=True)))
    )


def small_detail():
    """Return a detailed object of 4,000 Gaussians at 0.03 of the size, in front of a surface."""
    return joined(sample_scene(12_000), moved(sample_scene(4000, seed=2), by=(0.6, -1.9, -1.2), scale=0.03))


def nested():
    """Return a scene in the middle of one fifty times as large."""
    return joined(moved(sample_scene(6000), scale=50), moved(sample_scene(6000, seed=3), by=(20, -70, -30)))


def wall():
    """Return a plane that is seen from both sides."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-5, 5, (8000, 2)), rng.normal(0, 0.01, (8000, 1))], axis=1)
    return surface(points, np.tile([0.0, 0, 1], (8000, 1)), 10 / np.sqrt(8000), 1)


def huge_opaque():
    """Return a scene with an enormous opaque Gaussian beside it."""
    giant = replace(
        sample_scene(1),
        means=np.array([[150, 0, 0]], np.float32),
        scales=np.full((1, 3), np.log(40), np.float32),
        opacities=np.full(1, 8, np.float32),
        sh0=np.full((1, 3), 0.4, np.float32),
        shN=np.zeros((1, 15, 3), np.float32),
    )
    return joined(sample_scene(8000), giant)


def enormous_sh():
    """Return a scene with an SH coefficient of 1e5 in five Gaussians."""
    scene = sample_scene(10_000)
    shN = scene.shN.copy()
    shN[::2000, 4, 1] = 1e5
    return replace(scene, shN=shN)


def hollow_room():
    """Return six walls seen from inside, with nothing in the middle."""
    rng = np.random.default_rng(2)
    points, normals = rng.uniform(-1, 1, (10_000, 3)), np.zeros((10_000, 3))
    axis, side = rng.integers(0, 3, 10_000), rng.choice([-1.0, 1.0], 10_000)
    rows = np.arange(10_000)
    points[rows, axis], normals[rows, axis] = side, -side
    return surface(points * (3, 1.5, 4), normals, 0.05, 3)


def far_sky():
    """Return a scene under 3,000 large Gaussians at a hundred times the distance."""
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return joined(sample_scene(8000), surface(400 * directions, -directions, 20.0, 5))


SCENES = {
    "two, 50 apart": lambda: two(50, count=2000),
    "two, 200 apart": lambda: two(200),
    "two, 1000 apart": lambda: two(1000),
    "two, 10000 apart": lambda: two(10_000),
    "two, one at 1/50": lambda: two(12, 1 / 50),
    "five of different density": five,
    "small detailed object": small_detail,
    "nested, 1:50": nested,
    "wall": wall,
    "huge opaque": huge_opaque,
    "enormous SH": enormous_sh,
    "hollow room": hollow_room,
    "far sky": far_sky,
}


def camera_at(place, target, rng, size):
    """Return a camera with a field of view of 60 degrees and random roll."""
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, rng.normal(size=3))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = -pose[:3, :3] @ place
    focal = 0.5 * size[0] / np.tan(np.pi / 6)
    return Camera(pose, np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]]), *size)


def cameras(splats, count=32, seed=11, size=(160, 120)):
    """Return ``count`` random cameras of each kind: all around; around a random Gaussian; across the scene."""
    rng = np.random.default_rng(seed)
    means = splats.means.astype(np.float64)
    middle = np.median(means, axis=0)
    extent = np.quantile(np.linalg.norm(means - middle, axis=1), 0.95)

    sizes = np.exp(splats.scales.max(axis=1).astype(np.float64))

    def steady(draw):
        """Return the next camera that is not in a Gaussian, nor next to one that is close to the near plane."""
        while True:
            camera = draw()
            away = np.linalg.norm(means - camera.position, axis=1)
            depth = means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
            if (away > sizes).all() and not ((np.abs(depth - 0.01) < 0.015) & (away < 10 * sizes)).any():
                return camera

    def direction():
        vector = rng.normal(size=3)
        return vector / np.linalg.norm(vector)

    def beside(target, rank):
        distances = np.partition(np.linalg.norm(means - target, axis=1), min(rank, len(means) - 1))
        return target + distances[min(rank, len(means) - 1)] * direction()

    def around(rank):
        target = means[rng.integers(len(means))]
        return camera_at(beside(target, rank), target, rng, size)

    def across():
        here, there = means[rng.choice(len(means), 2, replace=False)]
        return camera_at(beside(here, 200), there, rng, size)

    def all_around():
        return camera_at(middle + 1.5 * extent * direction(), middle + 0.2 * extent * rng.normal(size=3), rng, size)

    kinds = {
        "all around": all_around,
        "close up": lambda: around(200),
        "farther off": lambda: around(2000),
        "across": across,
    }
    return {kind: [steady(draw) for _ in range(count)] for kind, draw in kinds.items()}


def rendered(splats, camera):
    """Yield the rendering over each of :data:`BACKGROUNDS`."""
    image, alpha = render(splats, camera, threads=1)
    for background in BACKGROUNDS:
        yield np.clip(image + background * (1 - alpha.reshape(*image.shape[:2], 1)), 0, 1)


def psnrs(reference, candidate, views):
    """``(views, backgrounds)`` decibels, at most 100."""
    found = []
    for camera in views:
        pairs = zip(rendered(reference, camera), rendered(candidate, camera), strict=True)
        found.append([-10 * np.log10(max(float(np.mean((a - b) ** 2)), 1e-10)) for a, b in pairs])
    return np.array(found)
