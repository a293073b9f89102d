"""Studies of ``bench/``; reference: curves given as formulas, a converter with known errors, bytes counted by hand."""

import csv
import importlib
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.codec_scenes import covariances
from helpers.viewers import CHROMIUM, PLAYCANVAS, SPARK
from helpers.web_tools import DECODER, ROOT
from PIL import Image

import kissgs
from bench import paper_parts
from bench.codecs import at_quality_offset
from bench.curves import bytes_at
from bench.external import measure_external
from bench.rendering import resampled
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES, SH_C0
from kissgs.io.containers import zip_bytes
from kissgs.sogxt.encode import encode

STUDIES = sorted(path.stem for path in Path(__file__).parents[1].glob("bench/[a-z]*.py"))

COPYING_TOOL = """
import shutil, sys
held = b"x" * 2**27
print("copied")
shutil.copy(*sys.argv[-2:])
"""


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_has_what_it_imports(name):
    importlib.import_module(f"bench.{name}")


@pytest.mark.parametrize("growth", [1.05, 1.3])
def test_bytes_are_interpolated_exponentially_and_not_extrapolated(growth):
    curve = [(q, 1e6 * growth**q) for q in (41.0, 30.0, 35.5)]
    for quality in (30.0, 33.3, 35.5, 41.0):
        assert bytes_at([*curve, (math.inf, 5.0), (math.nan, 5.0)], quality) == pytest.approx(1e6 * growth**quality)
    assert [bytes_at(curve, quality) for quality in (29.99, 41.01, math.nan)] == [None] * 3
    assert bytes_at([], 30.0) is None


def test_a_quality_offset_replaces_every_goal():
    other = at_quality_offset(kissgs.Settings.from_preset("balanced", psnr=40.0), -3.5)
    assert (other.encode.quality_offset_db, other.encode.psnr, other.preset) == (-3.5, None, "balanced")


@pytest.mark.quick(0)
def test_an_external_codec_is_measured_without_this_process(tmp_path):
    """The tool holds 128 MB; this process holds 1 GB, which Linux would count as that of the process it starts."""
    scene, tool, held = tmp_path / "scene.ply", tmp_path / "tool.py", b"x" * 2**30
    kissgs.save(kissgs.sample_scene(100, sh_degree=0), scene)
    tool.write_text(COPYING_TOOL)
    found = measure_external(scene, ending="spz", command=[sys.executable, str(tool)])
    assert found.bytes == scene.stat().st_size
    assert 2**27 < found.peak_memory < len(held)
    assert 0 < found.encode_cpu_seconds < 30
    assert found.evaluation.mean.candidate_vs_reference.psnr == math.inf
    tool.write_text("import sys; sys.exit('out of splats')")
    with pytest.raises(kissgs.KissgsError, match=r"scene.ply to \.spz: out of splats"):
        measure_external(scene, ending="spz", command=[sys.executable, str(tool)])


@pytest.mark.quick(0)
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
@pytest.mark.skipif(not all((DECODER / each).exists() for each in (SPARK, PLAYCANVAS)), reason="scripts/setup dev")
def test_viewers_are_compared_with_their_own_drawing_of_the_scene(tmp_path):
    """A copy of the scene is drawn exactly alike; one whose colours are all halved has a known error everywhere."""
    scene = kissgs.sample_scene(300, sh_degree=0)
    white = replace(scene, sh0=np.full_like(scene.sh0, 0.5 / SH_C0))
    grey = replace(scene, sh0=np.zeros_like(scene.sh0))
    for name, splats in {"white": white, "same": white, "grey": grey}.items():
        kissgs.save(splats, tmp_path / f"{name}.ply")
    files = (tmp_path / f"{name}.ply" for name in ("white", "same", "grey"))
    options = "--cameras", "2", "--size", "64", "48", "-o", tmp_path / "table.csv"
    command = sys.executable, "-m", "bench.viewers", *files, *options
    done = subprocess.run(command, check=False, cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr
    table = {row["file"]: row for row in csv.DictReader((tmp_path / "table.csv").read_text().splitlines())}
    for renderer in ("kissgs", "spark", "playcanvas"):
        assert table["same.ply"][f"{renderer} PSNR"] == "60.00"
        assert float(table["same.ply"][f"{renderer} SSIM"]) == 1
        brightness = 10 ** (-float(table["grey.ply"][f"{renderer} PSNR"]) / 20)
        assert 0.05 < brightness < 0.5, "the images are half as bright, and black where nothing is"
        assert float(table["scene.ply"][f"{renderer} PSNR"] or 60) > 20, "mirrored or shifted images have less"
    with Image.open(tmp_path / "table.png") as sheet:
        assert sheet.width == 5 * 32 + 6 * 4, "the scene, two files and their errors, with space between and around"
        row, rest = divmod(sheet.height - 4, 2 * 3)
        assert rest == 0, "a row for each camera and renderer"
        assert 24 + 4 < row < 24 + 4 + 24, "an image, its label and a space"


def test_parts_of_the_paper_that_only_save_bytes_change_nothing_else():
    scene, settings = kissgs.sample_scene(200, sh_degree=1), kissgs.Settings.from_preset("paper").encode
    whole = paper_parts.encode_parts(scene, settings)
    assert whole.size() == len(zip_bytes(encode(scene, settings, Context(1)).files))
    for leave_out in (paper_parts.webp, paper_parts.codebook_order, paper_parts.label_pairs):
        parts = leave_out(whole)
        assert parts.size() != whole.size()
        assert all(np.array_equal(getattr(whole.decoded, name), getattr(parts.decoded, name)) for name in ATTRIBUTES)
    moved = paper_parts.scene_order(whole)
    assert moved.size() != whole.size()
    of_scene, of_grid = (covariances(each.quats, each.scales) for each in (moved.exact, moved.decoded))
    assert np.abs(of_scene - of_grid).max() < 0.2 * np.abs(of_scene).max(), "in other forms, of coarse levels"
    floats = paper_parts.as_floats(whole, "scales", "scales")
    assert np.array_equal(floats.decoded.scales, whole.exact.scales)
    assert np.abs(whole.exact.scales - whole.decoded.scales).max() < 0.1


def test_the_logarithm_of_positions_saves_the_near_ones_of_a_scene_that_extends_far():
    """Published of bicycle: without it 13 % fewer bytes, and 7.55 dB less."""
    scene, settings = kissgs.sample_scene(900, sh_degree=0), kissgs.Settings.from_preset("paper").encode
    sky = np.linalg.norm(scene.means, axis=1) > 25
    near = replace(scene, means=np.where(sky[:, None], np.float32(0.2) * scene.means, scene.means))
    changes = []
    for far in (1, 300):
        means = np.where(sky[:, None], np.float32(far) * near.means, near.means)
        scales = near.scales + np.where(sky, np.float32(np.log(far)), 0)[:, None].astype(np.float32)
        whole = paper_parts.encode_parts(replace(near, means=means, scales=scales), settings)
        found = paper_parts.signed_log(whole)
        psnr = [kissgs.evaluate(whole.exact, each.decoded).mean.candidate_vs_reference.psnr for each in (whole, found)]
        changes.append((found.size() / whole.size() - 1, psnr[1] - psnr[0]))
    (_, beside), (fewer, lost) = changes
    assert abs(beside) < 0.5
    assert fewer < -0.05
    assert lost < -3


@pytest.mark.parametrize("count", [1, 70, 200, 450])
def test_a_resampled_scene_has_the_count_and_covers_as_much(count):
    scene = kissgs.sample_scene(200, sh_degree=0)
    scene = replace(scene, scales=np.full_like(scene.scales, -3))
    areas = [np.exp(2 * each.scales[:, 0].astype(float)).sum() for each in (scene, resampled(scene, count))]
    assert len(resampled(scene, count)) == count
    assert areas[1] == pytest.approx(areas[0], rel=1e-5)
