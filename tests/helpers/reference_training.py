"""Oracle of training: an independent implementation of loop, loss and Adam, in float64."""

from __future__ import annotations

import math

import numpy as np
import torch

from helpers import reference_float64
from kissgs.core.context import Context, Pace
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.differentiable import plain_photometric_loss
from kissgs.training.loop import TrainingPlan, train
from kissgs.training.model import BOUNDS, GaussianModel
from kissgs.training.supervision import TrainingTargets

STEPS = 3
RATES = {"means": 1.6e-4, "quats": 1e-3, "scales": 5e-3, "opacities": 0.05, "sh0": 2.5e-3, "shN": 1.25e-4}


def stripes(camera):
    """Return stripes as the training target of the camera, unlike any of the scenes."""
    ys, xs = np.mgrid[0 : camera.height, 0 : camera.width]
    image = np.stack([0.5 + 0.4 * np.sin(a * xs + b * ys) for a, b in ((0.3, 0.1), (0.1, 0.4), (0.5, -0.2))], axis=2)
    return TrainingTargets((camera,), (image.astype(np.float16),), (np.float32([0.25, 0.5, 0.75]),), "renderings")


def trained(splats, camera):
    """Return the largest error of a parameter after three steps, in learning rates, beyond float32 rounding.

    Adam's steps have the size of the learning rate even for tiny gradients, whose signs depend on rounding. So numbers
    are left out whose gradient is below 1e-3 of the largest of their attribute, or changes the loss by less than 1e-4
    of the steepest.
    """
    away = np.linalg.norm(splats.means.astype(np.float64) - camera.position, axis=1)
    targets, rates = stripes(camera), RATES | {"means": RATES["means"] * (np.median(away) if len(away) else 1.0)}
    model = GaussianModel(splats)
    train(
        model, targets, TrainingPlan("step", Pace(STEPS), lambda done: rates, 0.2, mse_weight=5.0, seed=[0]), Context(1)
    )
    wanted, clear = oracle(splats, targets, rates)
    worst = 0.0
    for name in ATTRIBUTES:
        found, target = model.parameters[name].detach().numpy(), wanted[name]
        if not np.isfinite(found).all():
            return math.inf
        rounding = STEPS * np.spacing(np.maximum(np.abs(target), np.abs(found)).astype(np.float32)).astype(np.float64)
        excess = (np.abs(found - target) - rounding).clip(0) / (rates[name] * STEPS)
        worst = max(worst, float(excess[clear[name]].max(initial=0)))
    return worst


def oracle(splats, targets, rates):
    """Return the parameters after these steps, and masks of parameters whose gradients are clearly not 0."""
    leaves = reference_float64.tensors(splats)
    moments = {name: (torch.zeros_like(leaf), torch.zeros_like(leaf)) for name, leaf in leaves.items()}
    clear = {name: np.ones(leaf.shape, bool) for name, leaf in leaves.items()}
    target = torch.from_numpy(targets.image(0)).double()
    for step in range(1, STEPS + 1):
        params = {name: leaf.clone().requires_grad_() for name, leaf in leaves.items()}
        loss = plain_photometric_loss(
            reference_float64.draw(params, targets.cameras[0], targets.backgrounds[0]).image, target, 0.2, 5.0
        )
        if loss.requires_grad:
            loss.backward()
        slopes = {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in params.items()}
        sizes = {name: float(slope.abs().max()) if slope.numel() else 0.0 for name, slope in slopes.items()}
        most = max(size * rates[name] for name, size in sizes.items())
        for name, leaf in leaves.items():
            slope, floor = slopes[name], max(1e-3 * sizes[name], 1e-4 * most / rates[name])
            clear[name] &= (slope.abs() >= floor).numpy()
            leaves[name] = adam(leaf, slope, moments[name], step, rates[name])
            if name in BOUNDS:
                leaves[name].clamp_(*BOUNDS[name])
    return {name: leaf.numpy() for name, leaf in leaves.items()}, clear


def adam(leaf, slope, moments, step, rate):
    """Return a leaf after a step of Adam (Kingma and Ba 2015, algorithm 1), and update the moments in place."""
    mean, square = moments
    mean.mul_(0.9).add_(0.1 * slope)
    square.mul_(0.999).add_(0.001 * slope.square())
    return leaf - rate * (mean / (1 - 0.9**step)) / ((square / (1 - 0.999**step)).sqrt() + 1e-15)
