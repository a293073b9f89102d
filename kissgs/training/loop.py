"""The loop: take a picture, compare it with what it should be, move every Gaussian a little."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Protocol

import numpy as np

from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.losses import photometric_loss
from kissgs.training.targets import TrainingTargets

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("training is torch's, which is missing: pip install 'kissgs[train]'") from error

SMOOTH = 0.98
"""Of what is told of loss and PSNR: how much of the last figure stays in the next."""

Parameters = Mapping[str, Tensor]
Rates = Callable[[float], Mapping[str, float]]
"""Learning rates by parameter, given the share of the steps that are done."""


class TrainableScene(Protocol):
    """What is fitted to pictures."""

    def gaussians(self) -> dict[str, Tensor]:
        """Current parameters, by the names in :class:`kissgs.core.splats.Splats`; gradients flow back from there."""

    def step(self, rates: Mapping[str, float]) -> None:
        """Move against the gradients that have come, at these learning rates, and forget them."""

    def __len__(self) -> int:
        """Number of Gaussians."""


class Regularizer(Protocol):
    """What is wanted of the Gaussians beside the pictures."""

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """To be added to the loss of ``step``; None for nothing."""

    def update(self, step: int, learner: TrainableScene) -> None:
        """What is to be done after ``step``."""


@dataclass(frozen=True, slots=True)
class Plan:
    """How to train.

    Attributes:
        stage: its name, for progress.
        steps: how many.
        rates: learning rates.
        ssim_weight: of 1 - SSIM in the loss, from 0 to 1; the rest is for the mean absolute difference.
        seed: of the order of the pictures, one number or several.
        regularizers: beside the pictures.
        batch: pictures in each step.
    """

    stage: str
    steps: int
    rates: Rates
    ssim_weight: float
    seed: Sequence[int]
    regularizers: tuple[Regularizer, ...] = ()
    batch: int = 1


def train(
    learner: TrainableScene,
    targets: TrainingTargets,
    plan: Plan,
    *,
    first: int = 0,
    after: Callable[[int], None] = lambda done: None,
    threads: int = 0,
    progress: Progress = silent,
) -> None:
    """Fit a scene to pictures, from the step ``first`` on.

    The loss is that of Kerbl et al. 2023, equation 7, and what the plan adds to it. The same seed gives the same scene,
    whatever the number of threads; not on a GPU.

    Args:
        learner: changed in place.
        targets: pictures.
        plan: what to do.
        first: steps that were done before.
        after: told the number of steps done, after each.
        threads: 0 means one per processor.
        progress: receives the plan's stage, with loss, PSNR to the lessons and count; what it raises leaves the
            learner as it was after a whole number of steps.
    """
    cameras = [_as_tensors(camera.viewmat, camera.K, targets.background) for camera in targets.cameras]
    order, told = targets.order(plan.seed, first * plan.batch), Told()
    with threads_of_torch(threads):
        for step in range(first, plan.steps):
            progress(plan.stage, step / plan.steps, told.in_words(len(learner)))
            shown = learner.gaussians()
            losses, errors = [], []
            for n in islice(order, plan.batch):
                camera, (viewmat, K, background) = targets.cameras[n], cameras[n]
                target = torch.from_numpy(targets.picture(n))[None].to(shown["means"].device)
                image, _ = rasterize(
                    **shown,
                    viewmats=viewmat,
                    Ks=K,
                    width=camera.width,
                    height=camera.height,
                    backgrounds=background,
                    threads=threads,
                )
                losses.append(photometric_loss(image, target, ssim_weight=plan.ssim_weight, threads=threads))
                errors.append(float((image.detach() - target).square().mean()))
            loss = torch.stack(losses).mean()
            told.hear(float(loss.detach()), sum(errors) / plan.batch)
            for regularizer in plan.regularizers:
                penalty = regularizer.penalty(step, shown)
                loss = loss if penalty is None else loss + penalty
            loss.backward()  # type: ignore[no-untyped-call]
            learner.step(plan.rates(step / plan.steps))
            for regularizer in plan.regularizers:
                regularizer.update(step, learner)
            after(step + 1)
    progress(plan.stage, 1.0, told.in_words(len(learner)))


@dataclass(slots=True)
class Told:
    """Loss and squared error of the last steps, on average."""

    loss: float = math.nan
    error: float = math.nan

    def hear(self, loss: float, error: float) -> None:
        """Of one more step."""
        first = math.isnan(self.loss)
        self.loss = loss if first else SMOOTH * self.loss + (1 - SMOOTH) * loss
        self.error = error if first else SMOOTH * self.error + (1 - SMOOTH) * error

    def in_words(self, count: int) -> str:
        """For people."""
        if math.isnan(self.loss):
            return f"{count:,} Gaussians"
        psnr = math.inf if self.error == 0 else -10 * math.log10(self.error)
        return f"{count:,} Gaussians, loss {self.loss:.4f}, PSNR {psnr:.2f}"


def _as_tensors(*arrays: np.ndarray) -> tuple[Tensor, ...]:
    """Of the type they have: the pose of a camera far from the origin is more than float32 can say."""
    return tuple(torch.as_tensor(array)[None] for array in arrays)


@contextlib.contextmanager
def threads_of_torch(threads: int) -> Iterator[None]:
    """For its own loops, the number that the rasteriser has."""
    before = torch.get_num_threads()
    if threads > 0:
        torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def exponential_lr(base: Mapping[str, float], begin: Mapping[str, float], end: Mapping[str, float]) -> Rates:
    """Rates that go from one share of ``base`` to another, exponentially, as those of the means do in 3DGS.

    Args:
        base: learning rates by parameter.
        begin: what each is multiplied with at the beginning, above 0.
        end: the same at the end.
    """

    def rates(done: float) -> dict[str, float]:
        return {name: rate * begin[name] * (end[name] / begin[name]) ** done for name, rate in base.items()}

    return rates
