"""Properties of a measurement on any computer: sizes, counts and positive times."""

import json

import numpy as np
import pytest

from kissgs import sample_scene
from kissgs.benchmark.render_speed import rendering_cost, resampled
from kissgs.rendering.camera import look_at
from kissgs.rendering.metrics import psnr
from kissgs.rendering.rasterizer import render

VIEW = look_at(
    np.array([1.2, -2.2, -5.2]), np.array([0, -0.8, 0]), np.array([0.0, -1, 0]), fov=0.9, width=96, height=64
)


@pytest.fixture(scope="module")
def table():
    return sample_scene(4000, sh_degree=1)


def test_a_cost_has_sizes_counts_and_positive_times(table):
    stages = []
    cost = rendering_cost(table, [VIEW], progress=lambda stage, fraction: stages.append(stage))
    assert (cost.gaussians, cost.width, cost.height, cost.views) == (4000, 96, 64, 1)
    assert 100 < cost.visible <= 4000
    assert min(cost.render, cost.render_and_backward, cost.loss, cost.adam, cost.removal_scores) > 0
    assert cost.training_step > 0
    assert "measure" in stages
    assert json.loads(json.dumps(cost.as_dict()))["gaussians"] == 4000


@pytest.mark.parametrize("count", [0, 1, 1000, 4000, 9001])
def test_a_resampled_scene_has_the_count_and_looks_similar(table, count):
    other = resampled(table, count)
    assert len(other) == count
    if count >= 1000:
        image, resampled_image = render(table, VIEW)[0], render(other, VIEW)[0]
        assert psnr(resampled_image.clip(0, 1), image.clip(0, 1)) > (60 if count == 4000 else 15)


def test_resampling_is_repeatable(table):
    assert np.array_equal(resampled(table, 5000).means, resampled(table, 5000).means)
