"""Small extreme scenes, as float64 arrays by attribute, and cameras."""

import numpy as np

from helpers import render_scenes
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.rendering.camera import Camera, look_at

Arrays = dict[str, np.ndarray]


def cloud(count=12, degree=1, seed=5):
    """Return coloured Gaussians around the origin, not opaque enough to terminate a pixel."""
    rng = np.random.default_rng([seed, count, degree])
    quats = rng.normal(size=(count, 4))
    return {
        "means": rng.normal(0, 0.6, (count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": rng.normal(-1.8, 0.5, (count, 3)),
        "opacities": rng.normal(0.0, 1.0, count),
        "sh0": rng.normal(0, 0.8, (count, 3)),
        "shN": rng.normal(0, 0.15, (count, SH_REST_COUNTS[degree], 3)),
    }


def changed(**arrays):
    """Return the cloud with other values, broadcast to its shapes."""
    before = cloud()
    return before | {name: np.broadcast_to(value, before[name].shape).astype(float) for name, value in arrays.items()}


def with_values(attribute, *values):
    """Return the cloud with the first numbers of an attribute's first Gaussians replaced."""
    arrays = cloud()
    for n, value in enumerate(values):
        arrays[attribute].reshape(12, -1)[n, 0] = value  # a view
    return arrays


def camera():
    """Return a camera that sees the cloud."""
    return render_scenes.camera(48, 32)


def small():
    """Return a camera that sees the cloud in fewer pixels."""
    return render_scenes.camera(24, 16)


def straight():
    """Return a camera with the axes of the world, so that equal z are bit-identical depths."""
    pose = np.eye(4)
    pose[2, 3] = 3
    return Camera(pose, np.array([[60.0, 0, 24], [0, 60.0, 16], [0, 0, 1]]), 48, 32)


def seen_from(place, target, fov):
    return look_at(np.array(place), np.array(target), np.array([0.0, -1, 0]), fov=fov, width=48, height=32)


def sized(size):
    before = cloud()
    return before | {"means": before["means"] * size, "scales": before["scales"] + np.log(size)}


def microscope():
    """Return a camera at a distance of 0.02 with a narrow field of view: nothing nearer than 0.01 is drawn."""
    return seen_from([0, 0, -0.02], [0, 0, 0], 1.2e-4)


def long_scan():
    arrays = cloud()
    arrays["means"][:, 0] = np.linspace(0, 3000, 12)
    return arrays


def up_to_1e15():
    arrays = cloud()
    arrays["means"][6:] *= 10.0 ** np.array([-6, -3, 2, 6, 9, 14])[:, None]
    arrays["means"][0] = 1e15, -1e15, 1e15
    return arrays


def needles():
    scales = np.array([[30, -30, -30], [0, -30, -30], [15, -15, -15]] * 4)
    return changed(scales=scales, opacities=1)


def no_rotation():
    arrays = cloud()
    arrays["quats"][3], arrays["quats"][7] = 0.0, [-0.0, 0, -0.0, 0]
    return arrays


def no_numbers():
    """Return 26 Gaussians with NaN in one number of each attribute, and with infinities where these are invalid."""
    arrays, n = cloud(26), 0
    for name, values in arrays.items():
        infinite = () if name in ("scales", "opacities") else (np.inf, -np.inf)
        for value in (np.nan, *infinite):
            values.reshape(26, -1)[n, -1] = value  # a view of these arrays
            n += 1
    return arrays


def beyond_float32():
    arrays = cloud()
    arrays["means"][1, 2], arrays["sh0"][4, 0] = 1e39, -1e300
    arrays["opacities"][6], arrays["scales"][8, 1] = 1e200, -1e39
    return arrays


def loud():
    before = cloud()
    return before | {"sh0": before["sh0"] * 4e5, "shN": before["shN"] * 1e6}


def denormal_sh():
    before = cloud()
    return before | {"sh0": before["sh0"] * 1e-42, "shN": before["shN"] * 1e-42}


def cauchy():
    """Return Cauchy-distributed values, with opacities too low to terminate a pixel."""
    rng, before = np.random.default_rng(3), cloud(40)
    wide = {name: rng.standard_cauchy(values.shape) for name, values in before.items()}
    wide["scales"] = (wide["scales"] * 0.3 - 2).clip(-30, 30)
    wide["opacities"] = (wide["opacities"] - 2).clip(-13, 0)
    wide["quats"] /= np.linalg.norm(wide["quats"], axis=1, keepdims=True)
    return wide | {"means": wide["means"] * 0.5, "shN": wide["shN"] * 0.1}


def outliers():
    arrays = cloud(40)
    for n, (name, value) in enumerate({"means": 1e6, "scales": -29, "sh0": 500, "shN": 500}.items()):
        arrays[name][n].flat[0] = value
    arrays["opacities"][4] = 13.8
    arrays["quats"][5] = -1, 0, 0, 0
    return arrays


def two_heaps():
    rng = np.random.default_rng(8)
    heap = {name: values[2:3] for name, values in cloud().items()}
    return {name: values + 1e-6 * rng.integers(0, 2, (24, *values.shape[1:])) for name, values in heap.items()}


def near_ties():
    """Return Gaussians with depths within half an ulp of 3, not stored in order of depth."""
    depths = 1e-8 * np.random.default_rng(2).permutation(12)
    return changed(means=np.column_stack([cloud()["means"][:, :2], depths]))


def layers():
    arrays = cloud(300, seed=6)
    depths = np.linspace(-1, 5, 300)
    direction = -camera().position / 3
    return arrays | {
        "means": depths[:, None] * direction + arrays["means"] * 0.1,
        "scales": np.full((300, 3), -0.5),
        "opacities": np.full(300, -3.0),
    }


def near_plane():
    """Return Gaussians along the line of sight, from behind the camera to 0.1 in front of it."""
    view, depths = camera(), np.array([-1, -1e-3, 0, 1e-9, 5e-3, 9.9e-3, 0.0101, 0.012, 0.02, 0.04, 0.07, 0.1])
    side = np.linspace(-0.2, 0.2, 12) * np.abs(depths)
    means = view.position + depths[:, None] * view.viewmat[2, :3] + side[:, None] * view.viewmat[0, :3]
    return changed(means=means, scales=cloud()["scales"] - 3.5, opacities=cloud()["opacities"] - 1)
