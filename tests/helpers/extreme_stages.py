"""Stages and their errors against float64 oracles: one number per extreme, 0 for an empty scene."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from helpers import reference_float64
from helpers.extreme_containers import BACKGROUND, BY_NAME, balanced, browser, decode, fast, largest, levels, scene
from kissgs.compaction.regularizers import erank_loss
from kissgs.core.context import Context, Pace
from kissgs.core.splats import ATTRIBUTES
from kissgs.rendering.differentiable import plain_photometric_loss, rasterize
from kissgs.rendering.rasterizer import removal_scores, render, tensors_of
from kissgs.training.loop import TrainingPlan, torch_threads, train
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


def clean(name):
    """Return the largest difference of the cleaned scene, relative for values above 1; infinite if a count is wrong."""
    extreme, (found, report) = BY_NAME[name], scene(name)
    rows, counts = reference_float64.cleaned(extreme.arrays())
    stated = {change: count for change, count in report.as_dict().items() if count}
    if len(rows) != len(found) or counts != report.as_dict() or stated != extreme.changes:
        return math.inf
    errors = []
    for n, row in enumerate(rows):
        for attribute, wanted in row.items():
            value = getattr(found, attribute)[n].astype(np.float64)
            value = 1 / (1 + np.exp(-value)) if attribute == "opacities" else value
            errors.append(np.abs(value - wanted) / np.maximum(np.abs(wanted), 1))
    return largest(*errors)


def image_error(name):
    """Return the largest difference of a pixel to the float64 oracle, relative to the brightest colour if above 1."""
    splats, view = scene(name)[0], BY_NAME[name].camera()
    expected = reference_float64.draw(reference_float64.tensors(splats), view, BACKGROUND)
    sure = expected.sure
    if sure.mean() < 0.9:
        return math.inf
    image, alpha = render(splats, view, background=BACKGROUND)
    brightest = expected.colours.numpy().max(initial=1.0)
    if not (np.isfinite(image).all() and np.isfinite(alpha).all()):
        return math.inf
    differences = np.abs(image - expected.image.numpy()) / brightest, np.abs(alpha - expected.alpha.numpy())
    return largest(*(difference[sure] for difference in differences))


def gradient(name):
    """Return the largest error of a gradient, relative to its attribute's largest, or to 1e-4 of the overall one."""
    splats, view = scene(name)[0], BY_NAME[name].camera()
    wanted, rng = reference_float64.tensors(splats, leaf=True), np.random.default_rng(1)
    expected = reference_float64.draw(wanted, view, BACKGROUND)
    weights = torch.from_numpy(rng.normal(0, 1, (view.height, view.width, 4)) * expected.sure[:, :, None])
    _weighted(expected.image, expected.alpha, weights).backward()
    found = {attribute: tensor.clone().requires_grad_() for attribute, tensor in tensors_of(splats).items()}
    images, alphas = rasterize(found, **_camera(view))
    _weighted(images[0], alphas[0], weights).backward()
    return relative(*({key: tensor.grad for key, tensor in leaves.items()} for leaves in (found, wanted)), splats, view)


def _camera(view):
    pose, K = torch.from_numpy(view.viewmat)[None], torch.from_numpy(view.K)[None]
    return {
        "viewmats": pose,
        "Ks": K,
        "width": view.width,
        "height": view.height,
        "backgrounds": torch.tensor([BACKGROUND]),
    }


def _weighted(image, alpha, weights):
    return (image * weights[:, :, :3]).sum() + (alpha * weights[:, :, 3]).sum()


def relative(found, wanted, splats, view):
    """Return relative errors; positions are divided by the nearest drawn depth, for comparable gradients."""
    depth = splats.means.astype(np.float64) @ view.viewmat[2, :3] + view.viewmat[2, 3]
    unit = {"means": depth[depth >= 0.01].min(initial=np.inf) if (depth >= 0.01).any() else 1.0}
    none = torch.zeros(())
    sizes = {key: np.abs((none if wanted[key] is None else wanted[key]).numpy()).max(initial=0) for key in found}
    floor = 1e-4 * max(size * unit.get(key, 1.0) for key, size in sizes.items())
    errors = []
    for key, size in sizes.items():
        target = np.zeros(1) if wanted[key] is None else wanted[key].numpy()
        scale = max(size, floor / unit.get(key, 1.0), 1e-30)
        errors.append(np.abs(found[key].numpy().astype(np.float64) - target) / scale)
    return largest(*errors)


def score(name):
    """Return the largest error of a removal score, relative to the largest score."""
    splats, view = scene(name)[0], BY_NAME[name].camera()
    wanted = reference_float64.removed(
        reference_float64.draw(reference_float64.tensors(splats), view, BACKGROUND), len(splats), BACKGROUND
    )
    found = removal_scores(splats, [view], background=BACKGROUND)
    return largest(np.abs(found - wanted) / max(wanted.max(initial=0), 1e-30))


def rank(name):
    """Return the largest error of the effective-rank loss (relative above 1) and of its gradient, at most 2."""
    scales = torch.from_numpy(scene(name)[0].scales).clone().requires_grad_()
    loss = erank_loss(scales)
    loss.sum().backward()
    wanted, slope = reference_float64.erank_loss(scales.detach())
    off = np.abs(scales.grad.numpy() - slope).max(axis=1, initial=0)
    at_kink = wanted < 1e-5  # at a disc, both one-sided gradients are correct
    off = np.where(at_kink & (scales.grad.numpy() == 0).all(axis=1), 0, off)
    return largest(np.abs(loss.detach().numpy() - wanted) / np.maximum(wanted, 1), off)


def step(name):
    """Return the largest error after three training steps, in learning rates, beyond float32 rounding."""
    return trained(scene(name)[0], BY_NAME[name].camera())


STAGES = {
    "clean": clean,
    "fast": fast,
    "balanced": balanced,
    "decode": decode,
    "image": image_error,
    "gradient": gradient,
    "score": score,
    "rank": rank,
    "step": step,
    "levels": levels,
    "browser": browser,
}


@functools.cache
def measured(name, stage):
    """Return the error of a stage for an extreme."""
    with torch_threads(1):  # more threads slow down parallel tests
        return STAGES[stage](name)
