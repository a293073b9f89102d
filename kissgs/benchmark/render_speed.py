"""CPU time of rendering and training: rasteriser, its gradients, loss, Adam, whole steps, and removal scores."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.deadline import Pace
from kissgs.core.errors import UnsupportedError
from kissgs.core.free_memory import keep_free_memory
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import load_kernels, removal_scores, render
from kissgs.settings import CompactSettings

if TYPE_CHECKING:
    from torch import Tensor

    from kissgs.rendering.cpu.gradients import Gradients
    from kissgs.training.model import GaussianModel

REPEATS = 5
"""Number of measurements per view."""

NO_RATES = dict.fromkeys(ATTRIBUTES, 0.0)
"""Learning rates of 0, so that every repeat finds the same scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderingCost:
    """CPU time per rendered image: milliseconds over all threads, medians over views and repeats.

    Attributes:
        gaussians: number of Gaussians in the scene.
        visible: number of Gaussians that touch the image, mean over views.
        width: of the images, pixels.
        height: of the images, pixels.
        views: number of views.
        render: forward pass.
        render_and_backward: forward and backward pass.
        loss: L1 + SSIM, forward and backward.
        adam: one step over all parameters of all Gaussians.
        training_step: a whole step of compaction's training: all of the above once, and what is between them.
        removal_scores: forward pass and removal scores of all Gaussians.
    """

    gaussians: int
    visible: int
    width: int
    height: int
    views: int
    render: float
    render_and_backward: float
    loss: float
    adam: float
    training_step: float
    removal_scores: float

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def rendering_cost(
    splats: Splats, cameras: Sequence[Camera], *, threads: int = 0, progress: Progress = silent
) -> RenderingCost:
    """Measure CPU times on a scene.

    Args:
        splats: a clean scene.
        cameras: one or more cameras, all of one size.
        threads: number of threads; 0 means one per processor.
        progress: receives the stages "kernels" and "measure".

    Raises:
        UnsupportedError: torch is not installed.
    """
    from kissgs.training.model import GaussianModel

    load_kernels(progress)
    model, measured = GaussianModel(splats), []
    for number, camera in enumerate(cameras):
        progress("measure", number / len(cameras))
        with keep_free_memory():
            measured.append(_one_view(splats, model, camera, threads))
    return RenderingCost(
        gaussians=len(splats),
        visible=round(float(np.mean([visible for visible, _ in measured]))),
        width=cameras[0].width,
        height=cameras[0].height,
        views=len(cameras),
        **{name: float(np.median([times[name] for _, times in measured])) for name in measured[0][1]},
    )


def _one_view(splats: Splats, model: GaussianModel, camera: Camera, threads: int) -> tuple[int, dict[str, list[float]]]:
    """Return the number of visible Gaussians, and the milliseconds of each repeat by attribute of the cost."""
    import torch

    from kissgs.rendering.cpu.frame import draw
    from kissgs.rendering.differentiable import rasterize
    from kissgs.rendering.losses import photometric_loss
    from kissgs.training.loop import torch_threads

    viewmats, Ks = torch.from_numpy(camera.viewmat[None]), torch.from_numpy(camera.K[None])
    weights = torch.rand((1, camera.height, camera.width, 3), generator=torch.Generator().manual_seed(0))
    received: list[Gradients] = []

    def differentiate() -> Tensor:
        received.clear()
        images, _ = rasterize(
            model.gaussians(),
            viewmats=viewmats,
            Ks=Ks,
            width=camera.width,
            height=camera.height,
            dilation=camera.dilation,
            antialiased=splats.antialiased,
            threads=threads,
            receive=received.append,
        )
        torch.autograd.backward(images, weights)
        return images.detach()

    def adam() -> None:
        model.add_gradients(received[0])
        model.step(NO_RATES)

    images = differentiate().requires_grad_()
    operations: dict[str, Callable[[], object]] = {
        "render": lambda: render(splats, camera, threads=threads),
        "render_and_backward": differentiate,
        "loss": lambda: torch.autograd.backward(photometric_loss(images, weights, threads=threads)),
        "adam": adam,
        "removal_scores": lambda: removal_scores(splats, [camera], threads=threads),
    }
    with torch_threads(threads):
        times = {name: [_cpu_milliseconds(operation) for _ in range(REPEATS)] for name, operation in operations.items()}
    times["training_step"] = _training_steps(model, camera, threads)
    with Workers(threads) as pool:
        frame = draw(splats, camera, np.zeros(3, np.float32), pool)
    return frame.footprints.count, times


def _training_steps(model: GaussianModel, camera: Camera, threads: int) -> list[float]:
    """Return the milliseconds of steps of training, after a first one that does not count."""
    from kissgs.training.loop import TrainingPlan, train
    from kissgs.training.targets import TrainingTargets

    grey = np.full((camera.height, camera.width, 3), 0.5, np.float16)
    targets = TrainingTargets((camera,), (grey,), (np.zeros(3, np.float32),), "renderings")
    settings = CompactSettings()
    plan = TrainingPlan(
        "measure",
        Pace(REPEATS + 1),
        lambda done: NO_RATES,
        ssim_weight=settings.used_ssim_weight,
        mse_weight=settings.mse_weight,
        seed=(0,),
    )
    ends: list[float] = []
    train(model, targets, plan, after=lambda done: ends.append(time.process_time()), threads=threads)
    return (1e3 * np.diff(ends)).tolist()


def resampled(splats: Splats, count: int, *, seed: int = 0) -> Splats:
    """Return a similar scene with another number of Gaussians, to measure how costs scale.

    Surfaces stay covered. For fewer, Gaussians are removed at even intervals and the others enlarged. For more, each
    Gaussian is replaced by several smaller ones at random positions within it.

    Args:
        splats: a finite scene; an empty one is returned as it is.
        count: number of Gaussians of the result, 0 or more.
        seed: seed of the random positions.

    Raises:
        UnsupportedError: there is not enough memory.
    """
    if not len(splats):
        return splats
    if count <= len(splats):
        keep = np.linspace(0, len(splats), count, endpoint=False).astype(np.int64)
        thinned = splats.select(keep)
        return _rescaled(thinned, thinned.means, np.log(len(splats) / max(count, 1)) / 2)
    rng = np.random.Generator(np.random.PCG64(seed))
    try:
        many = splats.select(np.sort(np.arange(count) % len(splats)))
    except MemoryError as error:
        raise UnsupportedError(f"{count:,} Gaussians need more memory than there is; resample to fewer") from error
    w, x, y, z = many.quats.T
    steps = rng.standard_normal((count, 3), np.float32) * np.exp(many.scales) * np.float32(0.7)
    axis = np.stack([x, y, z], axis=1)
    rotated = steps + 2 * np.cross(axis, np.cross(axis, steps) + w[:, None] * steps)
    return _rescaled(many, many.means + rotated, -np.log(count / len(splats)) / 2)


def _rescaled(splats: Splats, means: np.ndarray, log_growth: float) -> Splats:
    return replace(splats, means=np.ascontiguousarray(means), scales=splats.scales + np.float32(log_growth))


def _cpu_milliseconds(operation: Callable[[], object]) -> float:
    begin = time.process_time()
    operation()
    return 1e3 * (time.process_time() - begin)
