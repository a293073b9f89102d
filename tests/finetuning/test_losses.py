"""Rate and total variation losses. Oracle: entropies and differences computed one by one in Python; WebP files."""

import functools
import io
import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_scenes import cloud
from helpers.tuning_scenes import chosen, shuffled
from PIL import Image

from kissgs.core.context import Pace
from kissgs.finetuning.quantized_scene import (
    ENTROPY_FIELDS,
    PAPER_TV_WEIGHTS,
    CodebookRate,
    QuantizedScene,
    RateLoss,
    TotalVariationLoss,
)
from kissgs.sog.encode import SOG


@functools.cache
def plan_of(count, degree, preset):
    return chosen(cloud(count, degree), preset)


def quantized(count=400, degree=1, preset="balanced"):
    return QuantizedScene(plan_of(count, degree, preset), degree)


def round_latents(scene):
    for latents in scene.latents.values():
        latents.data.round_()


def value(penalty):
    return 0.0 if penalty is None else float(penalty.detach())


def symbols(scene, name):
    return np.rint((scene.planes[name].base_multiples + scene.latents[name]).detach().numpy()).astype(int)


def neighbour_bits(levels):
    """Return bits of ``(S, S, 3, 15)`` levels by the differences of neighbours, after green is subtracted."""
    side, bits = len(levels), 0.0
    for color in range(3):
        for coefficient in range(15):
            tile = levels[:, :, color, coefficient].astype(float)
            if color != 1:
                tile = tile - levels[:, :, 1, coefficient]
            beside = [abs(tile[y, x] - tile[y, x - 1]) for y in range(side) for x in range(1, side)]
            above = [abs(tile[y, x] - tile[y - 1, x]) for y in range(1, side) for x in range(side)]
            both = (np.mean(beside) + np.mean(above)) / 2
            bits += (sum(beside) + sum(above)) / 2 / ((both + 0.3) * math.log(2))
    return bits


def codebook_levels(scene):
    side = math.isqrt(len(scene.latents["f_rest_centroids"]))
    return symbols(scene, "f_rest_centroids").reshape(side, side, 3, 15)


@pytest.mark.parametrize("preset", ["balanced", "fast"])
def test_bits_are_the_entropy_of_levels_per_class(preset):
    scene = quantized(preset=preset)
    shuffled(scene, far=1.0)
    round_latents(scene)
    bits = 0.0
    for name in ENTROPY_FIELDS:
        rows = symbols(scene, name)
        for kind in set(scene.classes):
            for column in rows[scene.classes == kind].T:
                bits += sum(-times * math.log2(times / len(column)) for times in Counter(column).values())
    found = value(RateLoss(scene, 0.5).penalty(0, {})) - 0.5 * neighbour_bits(codebook_levels(scene))
    assert found == pytest.approx(0.5 * bits, rel=0.03)  # unused levels have a small probability


@pytest.mark.parametrize("degree", [1, 3])
def test_the_rate_of_a_square_codebook_is_that_of_differences_of_neighbours(degree):
    scene = quantized(degree=degree)
    loss = RateLoss(scene, 1.0)
    former = value(loss.penalty(0, {})), neighbour_bits(codebook_levels(scene))
    latents = scene.latents["f_rest_centroids"]
    plane, moves = scene.planes["f_rest_centroids"], np.random.default_rng(0).integers(-2, 3, latents.shape)
    latents.data += latents.new_tensor(moves)
    latents.data.clamp_(plane.min_latent, plane.max_latent)
    round_latents(scene)
    later = value(loss.penalty(25, {})), neighbour_bits(codebook_levels(scene))
    assert later[0] - former[0] == pytest.approx(later[1] - former[1], rel=1e-3)
    assert later[1] > former[1] + 10


def test_the_gradient_of_the_codebooks_rate_is_that_of_its_bits():
    scene = quantized(degree=1)
    shuffled(scene)
    loss, latents = RateLoss(scene, 1.0), scene.latents["f_rest_centroids"]
    loss.penalty(0, {}).backward()
    slopes = latents.grad.clone()
    before = value(loss.penalty(1, {}))
    latents.data += 1e-3 * slopes.sign()
    assert value(loss.penalty(1, {})) - before == pytest.approx(1e-3 * float(slopes.abs().sum()), rel=0.05)


def test_equal_entries_have_no_bits():
    scene = quantized(degree=1)
    rate = CodebookRate(scene.planes["f_rest_centroids"])
    base = scene.planes["f_rest_centroids"].base_multiples.float()
    latents = (base[:1] - base).clone().requires_grad_()
    rate.count(latents)
    bits = rate.bits(latents)
    bits.backward()
    assert float(bits.detach()) == 0
    assert (latents.grad == 0).all()


def test_the_rate_makes_the_image_of_the_codebook_smaller():
    scene = quantized(degree=3)
    shuffled(scene, far=1.0)
    loss, rates = RateLoss(scene, 1e-3), {**dict.fromkeys(scene.latents, 0.2), "attraction": 0.0}

    def size():
        levels = codebook_levels(scene) - codebook_levels(scene).min()
        side, stored = len(levels), io.BytesIO()
        image = levels.reshape(side, side, 3, 3, 5).transpose(3, 0, 4, 1, 2).reshape(3 * side, 5 * side, 3)
        Image.fromarray(image.astype(np.uint8)).save(stored, "WEBP", lossless=True)
        return len(stored.getvalue())

    before = size()
    for step in range(25):
        loss.penalty(step, {}).backward()
        scene.step(rates)
    assert size() < 0.9 * before


def test_bits_of_a_sog_codebook_have_one_code_per_colour():
    scene = QuantizedScene(chosen(cloud(300, 2), "fast", SOG), 2, container=SOG)
    round_latents(scene)
    latents = scene.latents["f_rest_centroids"]
    loss = RateLoss(scene, 1.0)
    before = value(loss.penalty(0, {}))
    rng = np.random.default_rng(0)
    rows = symbols(scene, "f_rest_centroids").reshape(-1, 3, 15)[:, :, :8]

    def entropy(rows):
        bits = 0.0
        for color in range(3):
            seen = rows[:, color].reshape(-1).tolist()
            bits += sum(-times * math.log2(times / len(seen)) for times in Counter(seen).values())
        return bits

    first = entropy(rows)
    latents.data += latents.new_tensor(rng.integers(-2, 3, latents.shape))
    latents.data.clamp_(scene.planes["f_rest_centroids"].min_latent, scene.planes["f_rest_centroids"].max_latent)
    second = entropy(symbols(scene, "f_rest_centroids").reshape(-1, 3, 15)[:, :, :8])
    assert abs(second - first) > 100
    assert value(loss.penalty(25, {})) - before == pytest.approx(second - first, rel=0.05)


def test_bits_are_interpolated_between_levels():
    scene = quantized()
    rate_loss = RateLoss(scene, 1.0)
    rate_loss.penalty(0, {})
    latents = scene.latents["scales"]
    row, column = next(map(tuple, torch.nonzero(scene.planes["scales"].max_latent > 1).tolist()))
    found = []
    for latent in (0.0, 0.25, 1.0):
        latents.data[row, column] = latent
        found.append(value(rate_loss.penalty(1, {})))
    assert found[1] == pytest.approx(0.75 * found[0] + 0.25 * found[2], rel=1e-5)
    latents.data[row, column] = 0.5
    rate_loss.penalty(1, {}).backward()
    assert float(latents.grad[row, column]) == pytest.approx(found[2] - found[0], rel=1e-2, abs=0.05)


def test_histograms_are_updated_every_25_steps_and_restored():
    scene = quantized()
    rate_loss = RateLoss(scene, 1.0)
    first = value(rate_loss.penalty(0, {}))
    shuffled(scene)
    round_latents(scene)
    later = value(rate_loss.penalty(24, {}))
    assert later != pytest.approx(first, rel=1e-3)
    other = RateLoss(scene, 1.0)
    other.restore(rate_loss.state())
    assert value(other.penalty(24, {})) == later
    assert value(rate_loss.penalty(25, {})) < later


def test_losses_of_weight_zero_are_skipped():
    assert RateLoss(quantized(), 0.0).penalty(0, {}) is None
    assert TotalVariationLoss(quantized(), 0.0, Pace(10)).penalty(9, {}) is None
    assert TotalVariationLoss(quantized(), 1.0, Pace(100)).penalty(35, {}) is None


def test_total_variation_does_without_tables_of_one_value():
    """Regression: a division by zero for a scene of one colour as ``.sog``."""
    round_grey = replace(cloud(40, 1), sh0=np.zeros((40, 3), np.float32), scales=np.zeros((40, 3), np.float32))
    scene = QuantizedScene(chosen(round_grey, "paper", SOG), 1, container=SOG)
    assert (scene.planes["f_dc"].field.top, scene.planes["scales"].field.top) == (0, 0)
    assert value(TotalVariationLoss(scene, 1.0, Pace(10)).penalty(9, {})) > 0  # of the others


@pytest.mark.parametrize(("count", "preset"), [(400, "fast"), (70, "paper"), (1, "fast")])
def test_total_variation_equals_that_of_the_images(count, preset):
    scene = quantized(count, preset=preset)
    shuffled(scene)
    grid, total = scene.grid, 0.0
    mask = grid.mask.reshape(grid.side, grid.side)
    for name, weight in PAPER_TV_WEIGHTS.items():
        plane = scene.planes[name]
        levels = plane.levels(scene.latents[name]).detach().numpy()
        parts = [levels % 256 / 255, levels // 256 / 255] if name == "means" else [levels / plane.field.top]
        for part in parts:
            image = np.zeros((grid.side**2, part.shape[1]))
            image[grid.mask] = part
            image = image.reshape(grid.side, grid.side, -1)
            steps = []
            for y in range(grid.side):
                for x in range(grid.side):
                    for v, u in ((y, x + 1), (y + 1, x)):
                        if max(v, u) < grid.side and mask[y, x] and mask[v, u]:
                            steps.append(np.abs(image[y, x] - image[v, u]))
            total += weight * np.mean(steps) if steps else 0.0
    for step, share in ((475, 0.5), (600, 1.0), (1000, 1.0)):
        found = TotalVariationLoss(scene, 3.0, Pace(1000)).penalty(step, {})
        assert value(found) == pytest.approx(3 * share * total, rel=1e-6)


def test_total_variation_decreases_in_training():
    scene = quantized(100, preset="fast")
    loss, rates = TotalVariationLoss(scene, 100.0, Pace(1)), {**dict.fromkeys(scene.latents, 0.1), "attraction": 0.0}
    before = value(loss.penalty(1, {}))
    for _ in range(30):
        loss.penalty(1, {}).backward()
        scene.step(rates)
    assert value(loss.penalty(1, {})) < 0.8 * before
