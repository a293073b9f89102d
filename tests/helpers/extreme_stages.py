"""Stages and their errors against float64 oracles: one number per extreme, 0 for an empty scene."""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from helpers import reference_float64
from helpers.extreme_containers import BACKGROUND, BY_NAME, balanced, browser, decode, fast, largest, levels, scene
from helpers.reference_training import trained
from kissgs.compaction.regularizers import erank_loss
from kissgs.rendering.differentiable import rasterize
from kissgs.rendering.rasterizer import removal_scores, render, tensors_of
from kissgs.training.loop import torch_threads


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
