"""``train``: fit a scene to target images by gradient descent."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np

from kissgs.core.context import DEFAULT_CONTEXT, TORCH_MISSING, Context, Pace, keep_free_memory
from kissgs.core.errors import UnsupportedError
from kissgs.rendering.cpu.frame import Gradients
from kissgs.rendering.differentiable import Parameters, photometric_loss, rasterize
from kissgs.training.supervision import TrainingTargets

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError(f"training needs {TORCH_MISSING}") from error

SMOOTHING = 0.98  # weight of the former value in the running means of loss and squared error
BASE_LR = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}  # of 3DGS
LrSchedule = Callable[[float], Mapping[str, float]]  # learning rates by parameter, from the fraction of steps


class TrainableScene(Protocol):
    """A scene that can be fitted to images."""

    def gaussians(self) -> dict[str, Tensor]:
        """Return the current :data:`Parameters`, differentiable."""

    @property
    def antialiased(self) -> bool:
        """See :class:`kissgs.Splats`."""

    @property
    def receive(self) -> Callable[[Gradients], None] | None:
        """Receiver of the gradients of images, see :func:`kissgs.rendering.differentiable.rasterize`."""

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an optimiser step with the accumulated gradients at these learning rates, and clear the gradients."""

    def __len__(self) -> int:
        """Number of Gaussians."""


class Regularizer(Protocol):
    """A loss term beside the photometric loss."""

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the term to add to the loss of ``step``, a scalar; None for nothing. It is asked once for each."""


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """Settings of a training."""

    stage: str  # in progress events
    pace: Pace
    rates: LrSchedule
    ssim_weight: float  # of 1 - SSIM, 0 to 1; the mean absolute difference has the rest
    mse_weight: float  # of the mean squared difference, added to both
    seed: Sequence[int]  # of the order of the images
    regularizers: tuple[Regularizer, ...] = ()
    batch: int = 1  # images in each step


def train(
    scene: TrainableScene,
    targets: TrainingTargets,
    plan: TrainingPlan,
    context: Context = DEFAULT_CONTEXT,
    *,
    first: int = 0,
    after: Callable[[int], None] = lambda done: None,
) -> None:
    """Fit a scene to target images, from step ``first`` on; ``after`` receives the number of steps done. On the CPU,
    the result depends on the seed but not on the number of threads; on a GPU it is not reproducible. If the receiver of
    progress raises, the scene is in the state after the last completed step."""
    order, running = targets.order(plan.seed, first * plan.batch), RunningMeans()
    with torch_threads(context.threads), keep_free_memory():
        step, pace = first, plan.pace
        pace.update(step)
        while step < pace.steps:
            context.progress(plan.stage, step / pace.steps, running.text(len(scene)))
            parameters = scene.gaussians()
            losses, errors = [], []
            for n in islice(order, plan.batch):
                loss, error = image_loss(
                    parameters,
                    targets,
                    n,
                    ssim_weight=plan.ssim_weight,
                    mse_weight=plan.mse_weight,
                    antialiased=scene.antialiased,
                    threads=context.threads,
                    receive=scene.receive,
                )
                losses.append(loss)
                errors.append(error)
            loss = torch.stack(losses).mean()
            running.add(float(loss.detach()), sum(errors) / plan.batch)
            for regularizer in plan.regularizers:
                penalty = regularizer.penalty(step, parameters)
                loss = loss if penalty is None else loss + penalty
            loss.backward()  # type: ignore[no-untyped-call]
            scene.step(plan.rates(step / pace.steps))
            step += 1
            after(step)
            pace.update(step)
    context.progress(plan.stage, 1.0, running.text(len(scene)))


def image_loss(
    parameters: Parameters,
    targets: TrainingTargets,
    n: int,
    *,
    ssim_weight: float,
    mse_weight: float,
    antialiased: bool,
    threads: int,
    receive: Callable[[Gradients], None] | None = None,
) -> tuple[Tensor, float]:
    """Render target ``n``; return the photometric loss, differentiable, and the mean squared error. ``antialiased`` and
    ``receive`` are as in :func:`kissgs.rendering.differentiable.rasterize`."""
    camera, target = targets.cameras[n], targets.image(n)
    image, _ = rasterize(
        parameters,
        viewmats=torch.from_numpy(camera.viewmat)[None],  # float64: poses far from the origin need it
        Ks=torch.from_numpy(camera.K)[None],
        width=camera.width,
        height=camera.height,
        backgrounds=torch.from_numpy(targets.backgrounds[n])[None],
        dilation=camera.dilation,
        antialiased=antialiased,
        threads=threads,
        receive=receive,
    )
    targets_there = torch.from_numpy(target)[None].to(image.device)
    loss = photometric_loss(image, targets_there, ssim_weight=ssim_weight, mse_weight=mse_weight, threads=threads)
    return loss, float(np.square(image[0].detach().cpu().numpy() - target).mean())


@dataclass(slots=True)
class RunningMeans:
    """Exponentially weighted means of loss and squared error; NaN before the first step."""

    loss: float = math.nan
    error: float = math.nan

    def add(self, loss: float, error: float) -> None:
        """Add the values of a step."""
        first = math.isnan(self.loss)
        self.loss = loss if first else SMOOTHING * self.loss + (1 - SMOOTHING) * loss
        self.error = error if first else SMOOTHING * self.error + (1 - SMOOTHING) * error

    def text(self, count: int) -> str:
        """Return number of Gaussians, loss and PSNR as text."""
        if math.isnan(self.loss):
            return f"{count:,} Gaussians"
        psnr = math.inf if self.error == 0 else -10 * math.log10(self.error)
        return f"{count:,} Gaussians, loss {self.loss:.4f}, PSNR {psnr:.2f}"


@contextlib.contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set the number of threads of torch to that of the rasteriser for a ``with`` block; 0 changes nothing."""
    before = torch.get_num_threads()
    if threads > 0:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def exponential_lr(base: Mapping[str, float], begin: Mapping[str, float], end: Mapping[str, float]) -> LrSchedule:
    """Return learning rates that change exponentially from ``base · begin`` to ``base · end``, as in 3DGS for means."""

    def rates(done: float) -> dict[str, float]:
        return {name: rate * begin[name] * (end[name] / begin[name]) ** done for name, rate in base.items()}

    return rates


def continued_lr(base: Mapping[str, float], first: int, steps: int) -> LrSchedule:
    """Return the learning rates that 3DGS would have in ``steps`` after its step ``first``: that of positions falls to
    1 % within 30,000 steps, and further after them; the others are constant."""

    def rates(done: float) -> dict[str, float]:
        return {**base, "means": base["means"] * 0.01 ** ((first + done * steps) / 30_000)}

    return rates
