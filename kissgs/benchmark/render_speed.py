"""What pictures cost: processor time of the rasteriser, its gradients, the loss, a step of Adam, and removal scores."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera
from kissgs.rendering.rasterizer import load_kernels, removal_scores, render

if TYPE_CHECKING:
    from torch import Tensor
    from torch.optim import Optimizer

REPEATS = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class RenderingCost:
    """Milliseconds of processor time over all threads, for one picture; medians over views and repeats."""

    gaussians: int
    visible: int
    """that touch the picture; mean over the views"""
    width: int
    height: int
    views: int
    draw: float
    draw_and_backward: float
    loss: float
    """L1 + SSIM, forward and backward"""
    adam: float
    """one step over all parameters of all Gaussians"""
    score: float
    """the picture and the removal scores of all Gaussians"""

    def as_dict(self) -> dict[str, Any]:
        """All numbers by name."""
        return asdict(self)


def rendering_cost(
    splats: Splats, cameras: Sequence[Camera], *, threads: int = 0, progress: Progress = silent
) -> RenderingCost:
    """Measure on a scene from these cameras, all of one size.

    Raises:
        UnsupportedError: torch is not installed.
    """
    from kissgs.rendering.tensors import tensors_of

    load_kernels(progress)
    tensors = {name: tensor.clone().requires_grad_() for name, tensor in tensors_of(splats).items()}
    adam = _adam(tensors)
    measured = []
    for number, camera in enumerate(cameras):
        progress("measure", number / len(cameras))
        measured.append(_one_view(splats, tensors, adam, camera, threads))
    return RenderingCost(
        gaussians=len(splats),
        visible=round(float(np.mean([visible for visible, _ in measured]))),
        width=cameras[0].width,
        height=cameras[0].height,
        views=len(cameras),
        **{name: float(np.median([taken[name] for _, taken in measured])) for name in measured[0][1]},
    )


def _adam(tensors: dict[str, Tensor]) -> Optimizer:
    """That changes nothing: every repeat finds the same scene."""
    from torch.optim import Adam

    return Adam([{"params": [tensor]} for tensor in tensors.values()], lr=0.0, eps=1e-15, fused=True)


def _one_view(
    splats: Splats, tensors: dict[str, Tensor], adam: Optimizer, camera: Camera, threads: int
) -> tuple[int, dict[str, list[float]]]:
    """How many Gaussians it sees, and milliseconds of each repeat, by what was done."""
    import torch

    from kissgs.rendering.cpu.frame import draw
    from kissgs.rendering.differentiable import rasterize
    from kissgs.rendering.losses import photometric_loss

    viewmats, Ks = torch.from_numpy(camera.viewmat[None]), torch.from_numpy(camera.K[None])
    weights = torch.rand((1, camera.height, camera.width, 3), generator=torch.Generator().manual_seed(0))

    def step() -> Tensor:
        for tensor in tensors.values():
            tensor.grad = None
        images, _ = rasterize(
            **tensors, viewmats=viewmats, Ks=Ks, width=camera.width, height=camera.height, threads=threads
        )
        torch.autograd.backward(images, weights)
        return images.detach()

    images = step().requires_grad_()
    works: dict[str, Callable[[], object]] = {
        "draw": lambda: render(splats, camera, threads=threads),
        "draw_and_backward": step,
        "loss": lambda: torch.autograd.backward(photometric_loss(images, weights, threads=threads)),
        "adam": adam.step,
        "score": lambda: removal_scores(splats, [camera], threads=threads),
    }
    taken = {name: [_cpu(work) for _ in range(REPEATS)] for name, work in works.items()}
    with Workers(threads) as pool:
        frame = draw(splats, camera, np.zeros(3, np.float32), pool)
    return len(frame.footprints.visible), taken


def resampled(splats: Splats, count: int, *, seed: int = 0) -> Splats:
    """A scene of another size that looks much the same, to see how costs grow.

    Surfaces stay covered. Fewer: evenly many are left out and the rest enlarged. More: Gaussians are replaced by
    several smaller ones within their own shape.
    """
    if not len(splats):
        return splats
    if count <= len(splats):
        keep = np.linspace(0, len(splats), count, endpoint=False).astype(np.int64)
        thinned = splats.select(keep)
        return _rescaled(thinned, thinned.means, np.log(len(splats) / max(count, 1)) / 2)
    rng = np.random.Generator(np.random.PCG64(seed))
    many = splats.select(np.sort(np.arange(count) % len(splats)))
    w, x, y, z = many.quats.T
    steps = rng.standard_normal((count, 3), np.float32) * np.exp(many.scales) * np.float32(0.7)
    axis = np.stack([x, y, z], axis=1)
    turned = steps + 2 * np.cross(axis, np.cross(axis, steps) + w[:, None] * steps)
    return _rescaled(many, many.means + turned, -np.log(count / len(splats)) / 2)


def _rescaled(splats: Splats, means: np.ndarray, growth: float) -> Splats:
    return Splats(
        means=np.ascontiguousarray(means),
        quats=splats.quats,
        scales=splats.scales + np.float32(growth),
        opacities=splats.opacities,
        sh0=splats.sh0,
        shN=splats.shN,
    )


def _cpu(work: Callable[[], object]) -> float:
    begin = time.process_time()
    work()
    return 1e3 * (time.process_time() - begin)
