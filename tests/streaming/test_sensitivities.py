"""Sensitivity of files, and the preset balanced. Oracle: the sensitivity of the whole scene, files without it."""

import numpy as np
import pytest
from helpers.render_scenes import blobs
from helpers.streamed_scenes import Stop, small_sizes

import kissgs
from kissgs import Settings
from kissgs.core.splats import concatenate
from kissgs.rendering.camera import look_at
from kissgs.rendering.sensitivity import WeightedCameras, measure_sensitivity
from kissgs.settings import EncodeSettings
from kissgs.streaming import layout
from kissgs.streaming.build import measure_file
from kissgs.streaming.compress import compress_streamed

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
    monkeypatch.setattr(layout, "CONTEXT", 1500)
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
