"""Oracle: entropies and differences counted one by one, in Python."""

import math
from collections import Counter

import numpy as np
import pytest
import torch
from helpers.training_scenes import cloud
from helpers.tuning_scenes import chosen, shuffled

from kissgs.finetuning.losses import COUNTED, PAPER_WEIGHTS, CodeLength, Smoothness
from kissgs.finetuning.quantized_scene import QuantizedScene


def trip(count=400, degree=1, preset="balanced"):
    return QuantizedScene(chosen(cloud(count, degree), preset), degree)


def rounded(work):
    for latents in work.latents.values():
        latents.data.round_()


def value(penalty):
    return 0.0 if penalty is None else float(penalty.detach())


def symbols(work, name):
    return np.rint((work.planes[name].base_multiples + work.latents[name]).detach().numpy()).astype(int)


@pytest.mark.parametrize("preset", ["balanced", "fast"])
def test_bits_are_the_entropy_of_the_levels_that_each_class_has(preset):
    work = trip(preset=preset)
    shuffled(work, far=1.0)
    rounded(work)
    bits = 0.0
    for name in COUNTED:
        rows = symbols(work, name)
        for kind in set(work.classes):
            for column in rows[work.classes == kind].T:
                bits += sum(-times * math.log2(times / len(column)) for times in Counter(column).values())
    found = value(CodeLength(work, 0.5).penalty(0, {}))
    assert found == pytest.approx(0.5 * bits, rel=0.03)  # levels that nobody has are taken to be possible


def test_between_two_levels_bits_are_interpolated_and_pull_to_the_cheaper():
    work = trip()
    lengths = CodeLength(work, 1.0)
    lengths.penalty(0, {})
    latents = work.latents["scales"]
    row, column = next(map(tuple, torch.nonzero(work.planes["scales"].max_latent > 1).tolist()))
    found = []
    for place in (0.0, 0.25, 1.0):
        latents.data[row, column] = place
        found.append(value(lengths.penalty(1, {})))
    assert found[1] == pytest.approx(0.75 * found[0] + 0.25 * found[2], rel=1e-5)
    latents.data[row, column] = 0.5
    lengths.penalty(1, {}).backward()
    assert float(latents.grad[row, column]) == pytest.approx(found[2] - found[0], rel=1e-2, abs=0.05)


def test_levels_are_counted_anew_now_and_then_and_a_restored_one_has_the_same_counts():
    work = trip()
    lengths = CodeLength(work, 1.0)
    first = value(lengths.penalty(0, {}))
    shuffled(work)
    rounded(work)
    later = value(lengths.penalty(24, {}))
    assert later != pytest.approx(first, rel=1e-3)
    other = CodeLength(work, 1.0)
    other.restore(lengths.state())
    assert value(other.penalty(24, {})) == later
    assert value(lengths.penalty(25, {})) < later


def test_nothing_is_asked_for_without_weight():
    assert CodeLength(trip(), 0.0).penalty(0, {}) is None
    assert Smoothness(trip(), 0.0, 10).penalty(9, {}) is None
    assert Smoothness(trip(), 1.0, 100).penalty(35, {}) is None


@pytest.mark.parametrize(("count", "preset"), [(400, "fast"), (70, "paper"), (1, "fast")])
def test_total_variation_is_that_of_the_images(count, preset):
    work = trip(count, preset=preset)
    shuffled(work)
    grid, total = work.grid, 0.0
    mask = grid.mask.reshape(grid.side, grid.side)
    for name, weight in PAPER_WEIGHTS.items():
        levels = work.planes[name].levels(work.latents[name]).detach().numpy()
        parts = [levels % 256, levels // 256] if name == "means" else [levels]
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
        found = Smoothness(work, 3.0, 1000).penalty(step, {})
        assert value(found) == pytest.approx(3 * share * total, rel=1e-6)


def test_smoothness_pulls_neighbours_together():
    work = trip(preset="fast")
    wish, rates = Smoothness(work, 100.0, 1), {**dict.fromkeys(work.latents, 0.05), "spring": 0.0}
    before = value(wish.penalty(1, {}))
    for _ in range(40):
        wish.penalty(1, {}).backward()
        work.step(rates)
    assert value(wish.penalty(1, {})) < 0.8 * before
