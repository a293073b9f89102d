"""Streamed scenes at every extreme. Oracle: the cleaned scene, and the formats' own reader."""

import json
import math

import numpy as np
import pytest
from helpers.extreme_containers import BY_NAME, given, scene
from helpers.streamed_scenes import FAST, TARGETS, small_sizes

import kissgs
from kissgs.core.errors import InvalidSceneError
from kissgs.streaming.compress import compress_streamed


@pytest.fixture(autouse=True)
def small(monkeypatch):
    small_sizes(monkeypatch, chunk=6, leaf=3, coarsest=3)


def numbers(node):
    """Return all numbers of a document."""
    if isinstance(node, dict):
        return [value for child in node.values() for value in numbers(child)]
    if isinstance(node, list):
        return [value for child in node for value in numbers(child)]
    return [node] if isinstance(node, (int, float)) else []


@pytest.mark.parametrize("manifest", TARGETS)
@pytest.mark.parametrize("name", list(BY_NAME))
@pytest.mark.quick(4)
def test_all_levels_of_an_extreme_scene_can_be_read(name, manifest, tmp_path):
    source = given(name)
    if isinstance(source, bytes):
        (tmp_path / "scene.ply").write_bytes(source)
    else:
        kissgs.save(source, tmp_path / "scene.ply")
    cleaned, target = scene(name)[0], tmp_path / manifest
    visible = int((cleaned.opacities > math.log(1 / 254)).sum())
    if not visible:
        with pytest.raises(InvalidSceneError, match="no Gaussian"):
            compress_streamed(tmp_path / "scene.ply", target, settings=FAST)
        return
    report = compress_streamed(tmp_path / "scene.ply", target, settings=FAST)
    assert report.counts[0] == visible
    for level, count in enumerate(report.counts):
        if count:
            assert len(kissgs.load(target, level=level)) == count
    assert np.isfinite(numbers(json.loads(target.read_bytes()))).all()


@pytest.mark.parametrize("manifest", TARGETS)
@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 9])
@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.quick(6)
def test_few_gaussians(count, degree, manifest, tmp_path):
    kissgs.save(kissgs.sample_scene(count, sh_degree=degree), tmp_path / "scene.ply")
    target = tmp_path / manifest
    if count == 0:
        with pytest.raises(InvalidSceneError, match="no Gaussian"):
            compress_streamed(tmp_path / "scene.ply", target, settings=FAST)
        return
    assert compress_streamed(tmp_path / "scene.ply", target, settings=FAST).counts[0] == count
    assert len(kissgs.load(target)) == count
