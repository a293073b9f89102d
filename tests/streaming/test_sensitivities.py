"""Sensitivity of files, partition, errors of levels. Oracles: the sensitivity of the whole scene, each position
compared with the cuts on its way, leaves of known images."""

import itertools

import numpy as np
import pytest
from helpers.render_scenes import blobs, one
from helpers.streamed_scenes import Stop, small_sizes

import kissgs
from kissgs import Settings
from kissgs.core.positions import Cuts
from kissgs.core.splats import concatenate, sampled_rows
from kissgs.rendering.camera import look_at
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import EncodeSettings
from kissgs.streaming import work_folder
from kissgs.streaming.build import measure_file
from kissgs.streaming.compress import compress_streamed
from kissgs.streaming.levels import SIZE, leaf_groups, level_errors, times_to_halve

BALANCED = Settings()
PLAIN = EncodeSettings(view_uncertainty=0.0, sensitivity_view_size=96)


def seen_from(position, target=(0, 0, 0)):
    place, up = np.array(position, float), np.array([0.1, 1.0, 0.2])
    return look_at(place, np.array(target, float), up, fov=0.8, width=96, height=72)


CAMERAS = WeightedCameras([seen_from((0, 0, -6)), seen_from((5, 1, 3))], [1.0, 1.0], np.zeros(3, np.float32))


def test_a_file_has_the_sensitivity_that_its_gaussians_have_in_the_scene():
    """The other files are given as they are, and there is no prior, so that only rounding differs."""
    own, others = blobs(40, seed=1), blobs(30, seed=2)
    expected = measure_sensitivity(concatenate([own, others]), CAMERAS)
    found = measure_file(own, others, CAMERAS.cameras, 0, PLAIN, 1)
    for name in ("position_hessian", "shape_hessian", "color_weight", "mean_harmonics"):
        wanted = getattr(expected, name)[:40]
        np.testing.assert_allclose(getattr(found, name), wanted, rtol=1e-4, atol=1e-6 * np.abs(wanted).max())
    alone = measure_file(own, others.select(slice(0)), CAMERAS.cameras, 0, PLAIN, 1)
    assert not np.allclose(alone.color_weight, found.color_weight, rtol=0.05)


def test_cameras_that_do_not_see_a_file_count_as_images_without_it():
    own, others = blobs(40, seed=1), blobs(30, seed=2)
    elsewhere = seen_from((0, 0, 50), (0, 0, 100))
    more = WeightedCameras([*CAMERAS.cameras, elsewhere, elsewhere], [1.0] * 4, CAMERAS.background)
    expected = measure_sensitivity(concatenate([own, others]), more)
    found = measure_file(own, others, more.cameras, 0, PLAIN, 1)
    np.testing.assert_allclose(found.color_weight, expected.color_weight[:40], rtol=1e-4)
    np.testing.assert_allclose(found.position_hessian, expected.position_hessian[:40], rtol=1e-3, atol=1e-9)
    unseen = WeightedCameras([elsewhere], [1.0], CAMERAS.background)
    assert not measure_file(own, others, unseen.cameras, 0, PLAIN, 1).color_weight.any()


@pytest.mark.quick(0)
def test_the_default_preset_spends_bits_by_sensitivity_and_goes_on_after_its_cameras(tmp_path, monkeypatch):
    small_sizes(monkeypatch, chunk=1600, leaf=400, coarsest=1000)
    monkeypatch.setattr(work_folder, "CONTEXT", 1500)
    kissgs.save(kissgs.sample_scene(3000, sh_degree=1, seed=3), tmp_path / "scene.ply")
    report = compress_streamed(tmp_path / "scene.ply", tmp_path / "whole" / "lod-meta.json", settings=BALANCED)
    assert len(report.counts) == 3
    flat = BALANCED.model_copy(update={"encode": BALANCED.encode.model_copy(update={"rate_distortion": False})})
    uniform = compress_streamed(tmp_path / "scene.ply", tmp_path / "uniform" / "lod-meta.json", settings=flat)
    assert report.level_bytes != uniform.level_bytes
    target = tmp_path / "city" / "lod-meta.json"

    def stop(stage, fraction, note=""):
        if stage == "images" and fraction > 0.3:
            raise Stop

    with pytest.raises(Stop):
        compress_streamed(tmp_path / "scene.ply", target, settings=BALANCED, progress=stop)
    assert (tmp_path / "city.partial" / "cameras.json").exists()
    assert compress_streamed(tmp_path / "scene.ply", target, settings=BALANCED, threads=1) == report
    for path in (tmp_path / "whole").rglob("*.*"):
        assert path.read_bytes() == (tmp_path / "city" / path.relative_to(tmp_path / "whole")).read_bytes()


def positions(count, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.normal(size=(count, 3)) * [10, 1, 0.1] + [1e3, 0, 0]).astype(np.float32)


@pytest.mark.parametrize("depth", [0, 5])
def test_chunks_have_about_equal_counts(depth):
    means = positions(5000)
    chunks = Cuts.of(means, depth).chunk_of(means)
    counts = np.bincount(chunks, minlength=1 << depth)
    assert counts.sum() == 5000
    assert counts.max() - counts.min() <= 2 + depth


def test_a_chunk_is_found_by_the_cuts_on_the_way():
    means = positions(3000)
    cuts = Cuts.of(means[::7], 4)
    for mean, chunk in zip(means, cuts.chunk_of(means), strict=True):
        node = 1
        while node < 16:
            node = 2 * node + int(mean[cuts.axes[node]] >= cuts.values[node])
        assert chunk == node - 16


@pytest.mark.parametrize("sizes", [(10,), (3, 1, 6), (1,) * 9])
def test_a_sample_has_every_kth_position_whatever_the_blocks(sizes, monkeypatch):
    monkeypatch.setattr("kissgs.core.splats.SAMPLED", 4)
    means = positions(sum(sizes))
    blocks = np.split(means, np.cumsum(sizes)[:-1])
    found = sampled_rows(blocks, sum(sizes))
    stride = -(-sum(sizes) // 4)
    assert (found == means[::stride]).all()


@pytest.mark.parametrize(
    ("count", "most", "times"), [(0, 100, 0), (100, 100, 0), (101, 100, 1), (800, 100, 3), (801, 100, 4)]
)
def test_coarser_levels(count, most, times):
    assert times_to_halve(count, most) == times


@pytest.mark.parametrize("count", [1, 7, 64, 65, 1000])
def test_leaves_hold_every_gaussian_once(count):
    order, edges = leaf_groups(positions(count), 64)
    assert sorted(order.tolist()) == list(range(count))
    assert (np.diff(edges) <= 64).all()
    assert edges[0] == 0
    assert edges[-1] == count
    assert all((np.diff(order[a:b]) > 0).all() for a, b in itertools.pairwise(edges))


def test_equal_levels_have_no_error():
    leaf = blobs(50)
    assert level_errors([leaf, leaf.select(np.arange(49, -1, -1)), leaf]) == [0, 0, 0]


def test_a_ball_in_front_of_grey():
    """An opaque ball of one colour, and one of another: the error is the difference times the ball's share."""
    size = -2.0
    ball = one(scale=(size,) * 3, opacity=20.0, sh0=(1.7724539,) * 3)  # white
    grey = one(scale=(size,) * 3, opacity=20.0, sh0=(0, 0, 0))  # as the background: no error but the white ball's
    found = level_errors([ball, grey])[1]
    pixels = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    squared = (pixels[:, None] ** 2 + pixels[None, :] ** 2) * 4  # the radius of the leaf is two standard deviations
    assert found == pytest.approx(0.5 * np.sqrt(np.mean(np.exp(-0.5 * squared) ** 2)), rel=0.03)


def test_a_coarser_level_never_has_a_smaller_error():
    leaf = blobs(60)
    errors = level_errors([leaf, leaf.select(np.arange(10)), leaf.select(np.arange(40))])
    assert 0 < errors[1] == errors[2]
