"""Processor time of the rasteriser forward and backward, of training steps and of removal scores.

    python bench/rendering.py fox.ply --views fox --gaussians 20000 79451 300000 1000000

Milliseconds per image, all threads together: medians over views and five repeats.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench.common import head, parser_with_views, positive, row, run
from kissgs import CompactSettings, Splats, load, virtual_views
from kissgs.core.context import Pace, Workers, keep_free_memory, load_kernels
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.rasterizer import removal_scores, render
from kissgs.training.loop import TrainingPlan, torch_threads, train
from kissgs.training.model import GaussianModel
from kissgs.training.supervision import TrainingTargets

REPEATS = 5
NO_RATES = dict.fromkeys(ATTRIBUTES, 0.0)
"""Learning rates of 0, so that every repeat finds the same scene."""

NAMES = "forward", "forward + backward", "forward + scores", "training step"


def main() -> None:
    """Print a row for each number of Gaussians."""
    parser = parser_with_views(__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--size", type=positive, help="longer side of the images, pixels")
    parser.add_argument("--gaussians", nargs="+", type=positive, help="resample the scene to these numbers")
    given = parser.parse_args()
    scene = load(given.scene)
    views = given.views or virtual_views(scene)
    cameras = [view.camera for view in views.test or views.train]
    if given.size:
        factors = [given.size / max(camera.width, camera.height) for camera in cameras]
        cameras = [c.resized(round(c.width * f), round(c.height * f)) for c, f in zip(cameras, factors, strict=True)]
    load_kernels()
    head("Gaussians", "touching the image", "image", *NAMES)
    for count in given.gaussians or [len(scene)]:
        splats = resampled(scene, count)
        model, found = GaussianModel(splats), []
        with keep_free_memory():
            found = [one_view(splats, model, camera) for camera in cameras]
        touching = round(float(np.mean([visible for visible, _ in found])))
        medians = [float(np.median([times[name] for _, times in found])) for name in NAMES]
        row(count, touching, f"{cameras[0].width}x{cameras[0].height}", *(f"{each:.1f}" for each in medians))


def one_view(splats: Splats, model: GaussianModel, camera: Camera) -> tuple[int, dict[str, list[float]]]:
    """Return the number of Gaussians that touch the image, and the milliseconds of each repeat by name."""
    viewmats, Ks = torch.from_numpy(camera.viewmat[None]), torch.from_numpy(camera.K[None])
    weights = torch.rand((1, camera.height, camera.width, 3), generator=torch.Generator().manual_seed(0))

    def differentiate() -> None:
        images, _ = rasterize(
            model.gaussians(),
            viewmats=viewmats,
            Ks=Ks,
            width=camera.width,
            height=camera.height,
            dilation=camera.dilation,
            antialiased=splats.antialiased,
            threads=0,
            receive=lambda gradients: None,
        )
        torch.autograd.backward(images, weights)

    operations: tuple[Callable[[], object], ...] = (
        lambda: render(splats, camera),
        differentiate,
        lambda: removal_scores(splats, [camera]),
    )
    with torch_threads(0):
        times = [[cpu_milliseconds(operation) for _ in range(REPEATS)] for operation in operations]
    times.append(training_steps(model, camera))
    with Workers(0) as pool:
        frame = draw(splats, camera, np.zeros(3, np.float32), pool)
    return len(frame.rows()), dict(zip(NAMES, times, strict=True))


def training_steps(model: GaussianModel, camera: Camera) -> list[float]:
    """Return the milliseconds of steps of training, after a first one that does not count."""
    grey, settings = np.full((camera.height, camera.width, 3), 0.5, np.float16), CompactSettings()
    targets = TrainingTargets((camera,), (grey,), (np.zeros(3, np.float32),), "renderings")
    plan = TrainingPlan(
        "measure",
        Pace(REPEATS + 1),
        lambda done: NO_RATES,
        ssim_weight=settings.ssim_weight,
        mse_weight=settings.mse_weight,
        seed=(0,),
    )
    ends: list[float] = []
    train(model, targets, plan, after=lambda done: ends.append(time.process_time()))
    return [1e3 * float(each) for each in np.diff(ends)]


def cpu_milliseconds(operation: Callable[[], object]) -> float:
    """Return the processor time of one call, all threads."""
    begin = time.process_time()
    operation()
    return 1e3 * (time.process_time() - begin)


def resampled(splats: Splats, count: int) -> Splats:
    """Return a similar scene of ``count`` Gaussians, whose surfaces stay covered.

    For fewer, Gaussians are removed at even intervals and the others enlarged. For more, each is replaced by several
    smaller ones at random positions within it.
    """
    growth = np.float32(np.log(len(splats) / count) / 2)
    if count <= len(splats):
        kept = splats.select(np.linspace(0, len(splats), count, endpoint=False).astype(np.int64))
        return replace(kept, scales=kept.scales + growth)
    many = splats.select(np.sort(np.arange(count) % len(splats)))
    w, axis = many.quats[:, :1], many.quats[:, 1:]
    random = np.random.Generator(np.random.PCG64(0))
    steps = random.standard_normal((count, 3), np.float32) * np.exp(many.scales) * np.float32(0.7)
    rotated = steps + 2 * np.cross(axis, np.cross(axis, steps) + w * steps)
    return replace(many, means=many.means + rotated, scales=many.scales + growth)


if __name__ == "__main__":
    run(main)
