"""A small scene, a damaged copy of it, and captures of it: cameras, with or without photographs on disk."""

import json

import numpy as np
from PIL import Image

import kissgs
from kissgs.cameras.views import View, Views
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.rendering.camera import look_at
from kissgs.rendering.rasterizer import render

SCENE = kissgs.sample_scene(1500, sh_degree=1, seed=4)
SIZE = (60, 40)


def damaged(scene=SCENE, amount=0.3, seed=0):
    """Return the scene with noise on its colours and scales."""
    rng = np.random.default_rng(seed)
    arrays = {name: getattr(scene, name).copy() for name in ATTRIBUTES}
    for name in ("sh0", "scales"):
        arrays[name] += rng.normal(0, amount, arrays[name].shape).astype(np.float32)
    return Splats(**arrays)


def camera(turn, size=SIZE):
    position = np.array([5 * np.sin(turn), -2.2, -5 * np.cos(turn)])
    return look_at(position, np.array([0, -0.8, 0]), np.array([0, -1.0, 0]), fov=1.0, width=size[0], height=size[1])


def cameras(test=3, train=2, background=(0, 0, 0), size=SIZE):
    views = [View(f"view_{i:02d}", camera(0.3 * i, size)) for i in range(test + train)]
    return Views(tuple(views[test:]), tuple(views[:test]), np.array(background, np.float32), "cameras by hand")


def rendered_view(scene, view, background=(0, 0, 0)):
    return np.clip(render(scene, view.camera, background=background)[0], 0, 1)


def write_capture(folder, names=("a.png", "b.png", "c.png"), noise=0.05, size=SIZE):
    """Write noisy photographs of the scene and their transforms.json; a.png is held out."""
    rng = np.random.default_rng(1)
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, name in enumerate(names):
        pose = camera(0.4 * i, size)
        image = render(SCENE, pose)[0] + rng.normal(0, noise, (size[1], size[0], 3))
        Image.fromarray(np.rint(255 * image.clip(0, 1)).astype(np.uint8)).save(folder / "images" / name)
        matrix = np.linalg.inv(pose.viewmat) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{name}", "transform_matrix": matrix.tolist()})
    focal = float(pose.K[0, 0])
    document = {"fl_x": focal, "w": size[0], "h": size[1], "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document))
    return folder
