"""Correspondence of Gaussians. Oracle: permutations that the test applied."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.evaluation.matching import match_gaussians
from kissgs.synthetic.scene import sample_scene


def disturbed(splats, rng, size=1.0):
    """Return the scene with errors of the magnitude of coarse codecs', times ``size``."""

    def noisy(array, error):
        return (array + size * error * rng.standard_normal(array.shape)).astype(np.float32)

    return replace(
        splats,
        means=noisy(splats.means, 3e-4 * (1 + np.abs(splats.means))),
        scales=noisy(splats.scales, 0.02),
        opacities=noisy(splats.opacities, 0.02),
        sh0=noisy(splats.sh0, 0.02),
    )


def test_shuffled_and_disturbed_gaussians_are_matched():
    rng = np.random.default_rng(0)
    scene = sample_scene(10_000)
    order = rng.permutation(len(scene))
    found = match_gaussians(scene, disturbed(scene.select(order), rng))
    assert found.dtype == np.int64
    assert (found == order).mean() > 0.999
    assert len(np.unique(found)) > 0.999 * len(scene)


def test_dropped_gaussians_leave_their_rows_unused():
    rng = np.random.default_rng(0)
    scene = sample_scene(5000)
    order = rng.permutation(len(scene))[:2000]
    assert (match_gaussians(scene, disturbed(scene.select(order), rng)) == order).mean() > 0.999


def test_equivalent_forms_are_matched():
    scene = sample_scene(2000)
    permuted = replace(scene, scales=scene.scales[:, [1, 2, 0]])
    assert (match_gaussians(scene, permuted) == np.arange(2000)).all()


def test_colours_of_invisible_gaussians_are_ignored():
    """splat-transform's WebP images keep no colour under zero alpha."""
    scene = sample_scene(2000)
    opacities, sh0 = scene.opacities.copy(), scene.sh0.copy()
    opacities[::2], sh0[::2] = -13, 2
    candidate = replace(scene, opacities=opacities, sh0=sh0)
    assert (match_gaussians(replace(scene, opacities=opacities), candidate) == np.arange(2000)).mean() > 0.999


@examples(50)
@given(references=st.integers(1, 8), candidates=st.integers(0, 8), seed=st.integers(0, 2**32))
def test_few_gaussians_are_matched_one_to_one(references, candidates, seed):
    found = match_gaussians(sample_scene(references, seed=seed), sample_scene(candidates, seed=seed + 1))
    assert found.shape == (candidates,)
    assert len(np.unique(found)) == min(references, candidates)
    assert ((found >= 0) & (found < references)).all()


def test_equal_gaussians_are_matched_one_to_one():
    scene = sample_scene(1).select(np.zeros(8, np.int64))
    assert sorted(match_gaussians(scene, scene)) == list(range(8))


def test_empty_scenes():
    assert match_gaussians(sample_scene(0), sample_scene(0)).shape == (0,)
    with pytest.raises(InvalidSceneError, match="cannot be matched with an empty reference"):
        match_gaussians(sample_scene(0), sample_scene(1))


def test_a_missing_extra_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    with pytest.raises(UnsupportedError, match=r"kissgs\[bench\]"):
        match_gaussians(sample_scene(2), sample_scene(2))
