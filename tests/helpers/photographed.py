"""Small captures with photographs, and settings with which a goal is served quickly."""

import numpy as np
from PIL import Image

from helpers.training_scenes import around
from kissgs import Settings
from kissgs.cameras.views import View, Views, black
from kissgs.rendering.rasterizer import render

FEW_VIEWS = {"sensitivity_views": 16, "sensitivity_view_size": 96}


def photographs(scene, folder, train=12, held_out=3, brightness=2 / 3):
    """Return a capture whose photographs are renderings of ``scene``, darker: training can learn that."""

    def view(name, around_view):
        image = np.clip(render(scene, around_view.camera)[0] * 255 + 0.5, 0, 255).astype(np.uint8)
        Image.fromarray(np.uint8(image * brightness)).save(folder / f"{name}.png")
        return View(name, around_view.camera, folder / f"{name}.png")

    views = [view(f"photo{n}", each) for n, each in enumerate(around(train + held_out))]
    return Views(tuple(views[held_out:]), tuple(views[:held_out]), black(), "a capture")


QUICK = {
    "max_compactions": 4,
    "sparsify_steps": 42,
    "refine_steps": 20,
    "prune_rounds": 2,
    "min_keep_per_scoring": 0.0,
    "view_size": 40,
}


def with_photographs(finetune=None, **goal):
    tuning = {"steps": 20, "view_size": 40, **(finetune or {})}
    return Settings.research("balanced", compact=QUICK, finetune=tuning, **FEW_VIEWS, **goal)
