"""Containers of the extremes, and the errors of decoded scenes against oracles: one number for each."""

from __future__ import annotations

import functools
import json
import math

import numpy as np
import torch

import kissgs
from helpers import reference_decoder
from helpers.codec_scenes import rounding, signed_log, stored_forms
from helpers.extremes import EXTREMES
from kissgs import Settings, Splats
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES
from kissgs.finetuning.quantized_scene import QuantizedScene
from kissgs.io.ply import read_ply
from kissgs.planning.planner import plan_encoding
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.sogxt.encode import write_files

PRESETS = ("fast", "balanced")
BACKGROUND = (0.25, 0.5, 0.75)
BY_NAME = {extreme.name: extreme for extreme in EXTREMES}
FIELDS = ("opacities", "scales", "quaternions", "f_dc")


def ply_of(arrays):
    """Return a .ply of float64 properties."""
    count = len(arrays["means"])
    rest = arrays["shN"].transpose(0, 2, 1).reshape(count, -1)
    names = ["x", "y", "z", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest.shape[1])), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    table = [arrays["means"], arrays["sh0"], rest, arrays["opacities"][:, None], arrays["scales"], arrays["quats"]]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header += [*(f"property double {name}" for name in names), "end_header", ""]
    return "\n".join(header).encode() + np.concatenate(table, axis=1).astype("<f8").tobytes()


@functools.cache
def given(name):
    """Return the scene as a user gives it: float32 arrays, or the bytes of a file."""
    extreme = BY_NAME[name]
    arrays = extreme.arrays()
    if extreme.as_ply:
        return ply_of(arrays)
    with np.errstate(over="ignore", under="ignore"):
        return Splats(**{name: values.astype(np.float32) for name, values in arrays.items()})


@functools.cache
def scene(name):
    """Return the cleaned scene and the report of cleaning."""
    source = given(name)
    if isinstance(source, bytes):
        source = read_ply(source)
    return kissgs.clean(source)


@functools.cache
def chosen(name, preset):
    """Return the plan of a row; with rate-distortion planning, sensitivity is that of the row's camera."""
    splats, settings = scene(name)[0], encode_settings(preset)
    sensitivity = None
    if settings.rate_distortion:
        watch = WeightedCameras([BY_NAME[name].camera()], [1.0], np.float32(BACKGROUND))
        sensitivity = measure_sensitivity(splats, watch, view_uncertainty=0.3, threads=1)
    return plan_encoding(splats, settings, Context(1), sensitivity=sensitivity)


def encode_settings(preset):
    return Settings.research(preset, sh_tolerance=0).encode


@functools.cache
def packed(name, preset):
    """Return the container of a row."""
    return write_files(chosen(name, preset), encode_settings(preset), Context(1))


def largest(*errors):
    """Return the largest of numbers and arrays; infinity if one is NaN."""
    worst = [float(np.max(error, initial=0)) for error in errors]
    return math.inf if any(math.isnan(error) for error in worst) else max(worst, default=0.0)


def fast(name):
    """Return the largest error of a decoded attribute, in the half steps that the report states."""
    return _share(scene(name)[0], packed(name, "fast"), "fast")


def balanced(name):
    """Return the largest error with rate-distortion planning, in the largest errors that the report states."""
    return _share(scene(name)[0], packed(name, "balanced"), "balanced")


def _share(splats, result, preset):
    found, wanted, half = kissgs.decompress(result.files), splats.select(result.order), result.errors
    if len(found) != len(wanted) or found.sh_degree != splats.sh_degree or result.form_error > 1e-6:
        return math.inf

    def share(value, target, step):
        error = np.abs(np.asarray(value, np.float64) - target)
        return error / (np.asarray(step) * (1 + 1e-6) + rounding(target))

    quats, scales = stored_forms(wanted.quats, wanted.scales)
    turned, stretched = share(found.quats, quats, half["quaternions"]), share(found.scales, scales, half["scales"])
    parts = [
        share(signed_log(found.means), signed_log(wanted.means), half["means"]),
        share(found.opacities, wanted.opacities, half["opacities"][0]),
        share(found.sh0, wanted.sh0, half["f_dc"]),
        np.maximum(turned.max(axis=2), stretched.max(axis=2)).min(axis=0),  # the form that fits best
    ]
    entries = json.loads(result.files["meta.json"])["shN"]["centroidSide"] ** 2
    if preset == "fast" and len(found) <= entries:
        parts.append(share(found.shN, wanted.shN, max(half["f_rest_centroids"], default=0)))
    return largest(*parts)


def decode(name):
    """Return the largest difference to the oracle's decoder, in ranges of the attribute (positions: in 1 + |x|)."""
    return largest(*(_decode(packed(name, preset).files) for preset in PRESETS))


def _decode(files):
    found, wanted = kissgs.decompress(files), reference_decoder.decode_browser(files)
    errors = []
    for attribute in ATTRIBUTES:
        value = getattr(found, attribute).astype(np.float64)
        target = wanted[attribute][:, : value.shape[1]] if attribute == "shN" else wanted[attribute]
        if value.shape != target.shape:
            return math.inf
        if attribute == "quats":
            value /= np.linalg.norm(value, axis=1, keepdims=True)
        reach = np.abs(target).max(initial=1)
        if attribute == "means":
            reach = (1 + np.abs(target)) * np.log1p(reach).clip(1)
        errors.append(np.abs(value - target) / reach)
    return largest(*errors)


def levels(name):
    """Return how many levels of fine-tuning's quantised scene differ from the container; infinite if a gradient is."""
    return float(sum(_levels(scene(name)[0], chosen(name, preset), encode_settings(preset)) for preset in PRESETS))


def _levels(splats, choice, settings):
    if not choice.grid.mask.any():
        return 0
    work, rng, wrong = QuantizedScene(choice, splats.sh_degree), np.random.default_rng(0), 0
    for field, latents in work.latents.items():
        latents.data += latents.new_tensor(rng.normal(0, 2, latents.shape))
        latents.data.clamp_(work.planes[field].min_latent, work.planes[field].max_latent)
    shown = work.gaussians()
    sum(values.sum() for values in shown.values()).backward()
    if not all(torch.isfinite(latents.grad).all() for latents in work.latents.values()):
        return math.inf
    files, mask = write_files(work.plan(), settings, Context(1)).files, choice.grid.mask
    inside = {field: work.planes[field].levels(work.latents[field]).detach().numpy() for field in (*FIELDS, "means")}
    for field in FIELDS:
        image = reference_decoder.levels(files, field, 4 if field == "quaternions" else 3)[mask]
        wrong += int((image[:, : inside[field].shape[1]] != inside[field]).sum())
    high, low = (reference_decoder.levels(files, f"means_bytes_{n}", 3)[mask].astype(int) for n in (1, 0))
    return wrong + int((256 * high + low != inside["means"]).sum())


@functools.cache
def browsers():
    """Return the difference of JavaScript and Python for all rows, ulps; infinite if levels differ."""
    from helpers import web_scenes

    files = [dict(packed(name, preset).files) for name in BY_NAME for preset in PRESETS]
    said = web_scenes.in_node(*(web_scenes.job(some, options={"keepPlanes": True}) for some in files))
    found = []
    for answer, some in zip(said, files, strict=True):
        try:
            found.append(float(web_scenes.assert_scene(answer, some)))
        except AssertionError:
            found.append(math.inf)
    return {name: max(found[2 * n : 2 * n + 2]) for n, name in enumerate(BY_NAME)}


def browser(name):
    """See :func:`browsers`."""
    return browsers()[name]
