"""Oracle: a reader in plain numbers (helpers/reference_sog.py), the scene's own values, and splat-transform."""

import hashlib
import json
import zipfile
from io import BytesIO

import numpy as np
import pytest
from helpers.codec_scenes import (
    GLANCE,
    PRESETS,
    assert_within,
    constant_scene,
    equivalents,
    random_scene,
    replaced,
    rounding,
    signed_log,
)
from helpers.command_line import run
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_sog import read_files
from helpers.splat_transform import convert, needs_splat_transform
from PIL import Image

import kissgs
from kissgs import Settings, compress, sample_scene
from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io.ply import read_ply


def encoded(splats, preset="balanced", **settings):
    return compress(splats, settings=Settings.research(preset, **{**GLANCE, **settings}), container="sog")


def pixels(result, name):
    return np.asarray(Image.open(BytesIO(result.files[name])))


def assert_round_trip(splats, result):
    """Assert that each Gaussian decodes within the reported errors, in one of its equivalent forms."""
    found, wanted = kissgs.decompress(result.files), splats.select(result.order)
    errors = result.report.max_quantization_error
    assert_within(signed_log(found.means), signed_log(wanted.means), errors["means"])
    assert_within(found.opacities, wanted.opacities, errors["opacities"][0])
    assert_within(found.sh0, wanted.sh0, errors["f_dc"])
    quats, scales = equivalents(wanted.quats, wanted.scales)
    fits = (np.abs(quats - found.quats) <= np.array(errors["quaternions"]) + rounding(quats)).all(axis=2)
    fits &= (np.abs(scales - found.scales) <= np.array(errors["scales"]) + rounding(scales)).all(axis=2)
    assert fits.any(axis=0).all()


@pytest.mark.parametrize(("count", "preset"), [(65, "balanced"), (1, "fast"), (65, "paper")])
def test_round_trip_is_within_the_reported_errors(count, preset):
    scene = random_scene(count, count % 4, seed=count)
    result = encoded(scene, preset)
    assert_round_trip(scene, result)
    assert kissgs.decompress(result.files).sh_degree == count % 4


@pytest.mark.parametrize("degree", [3, 0, 1, 2])
@pytest.mark.quick(2)
def test_another_reader_finds_the_same_values(degree):
    result = encoded(random_scene(70, degree, seed=5), "fast")
    found, wanted = kissgs.decompress(result.files), read_files(result.files)
    for name in ATTRIBUTES:
        np.testing.assert_allclose(getattr(found, name), wanted[name], rtol=2e-6, atol=2e-6, err_msg=name)


@needs_splat_transform
@pytest.mark.parametrize(("count", "degree", "preset"), [(65, 3, "balanced"), (1, 0, "fast")])
def test_splat_transform_reads_extreme_scenes(count, degree, preset, tmp_path):
    encoded(made_scene(count, degree), preset).save(tmp_path / "scene.sog")
    theirs = read_ply(convert(tmp_path / "scene.sog", tmp_path / "scene.ply"))
    assert_alike(kissgs.load(tmp_path / "scene.sog"), clean(theirs)[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("preset", ["fast", "balanced"])
@pytest.mark.quick(1)
def test_threads_do_not_change_a_byte(preset):
    scene = sample_scene(400, sh_degree=2, seed=1)
    settings = Settings.research(preset, **GLANCE)
    one, more = (compress(scene, settings=settings, container="sog", threads=threads).to_zip() for threads in (1, 3))
    assert hashlib.sha256(one).hexdigest() == hashlib.sha256(more).hexdigest()


def test_the_metadata_is_what_readers_ask_for():
    result = encoded(sample_scene(300, sh_degree=2, seed=3), "fast")
    meta = json.loads(result.files["meta.json"])
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, len(result.order), 2)
    assert meta["asset"]["generator"] == f"kissgs {kissgs.__version__}"
    for part in ("scales", "sh0", "shN"):
        table = meta[part]["codebook"]
        assert len(table) == 256
        assert table == sorted(table)
        assert np.isfinite(table).all()
    assert 0.0 in meta["shN"]["codebook"]
    sizes = {name: pixels(result, name).shape[:2] for name in result.files if name.endswith(".webp")}
    assert sizes.pop("shN_centroids.webp") == (-(-meta["shN"]["count"] // 64), 64 * 8)
    assert len(set(sizes.values())) == 1
    with zipfile.ZipFile(BytesIO(result.to_zip())) as archive:
        assert archive.comment == b""
        assert archive.namelist()[0] == "meta.json"
        assert archive.getinfo("meta.json").compress_type == zipfile.ZIP_DEFLATED
        assert archive.getinfo("quats.webp").compress_type == zipfile.ZIP_STORED


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.quick(2)
def test_few_gaussians_keep_their_own_view_dependent_colour(preset):
    """Regression: a scene of fewer than 64 Gaussians had a codebook of one entry, or of one for seven."""
    scene = random_scene(24, 3, seed=3)
    result = encoded(scene, preset)
    found = kissgs.decompress(result.files).shN
    np.testing.assert_allclose(found, scene.select(result.order).shN, atol=np.ptp(scene.shN) / 60)


def test_scenes_without_view_dependent_colour_have_no_codebook():
    result = encoded(random_scene(30, 0), "fast")
    assert "shN" not in json.loads(result.files["meta.json"])
    assert not any(name.startswith("shN") for name in result.files)


@pytest.mark.parametrize("preset", ["balanced", "fast"])
def test_no_stored_gaussian_is_too_faint_to_be_drawn(preset):
    faint = replaced(random_scene(60), opacities=np.linspace(-5.5, -4.5, 60))
    assert (
        pixels(encoded(faint, preset, **({} if preset == "fast" else {"rd_lambda": 1e-12})), "sh0.webp")[..., 3].min()
        >= 2
    )


def test_invisible_gaussians_that_are_kept_stay_invisible():
    scene = replaced(random_scene(20), opacities=np.r_[np.full(10, -9.0), np.full(10, 2.0)])
    result = encoded(scene, "fast", prune_invisible=False)
    hidden = kissgs.decompress(result.files).opacities < -5.5
    assert (hidden == (result.order < 10)).all()


def test_a_canonical_rotation_leaves_out_w():
    assert (pixels(encoded(random_scene(200), "fast"), "quats.webp")[..., 3] == 252).all()


def test_flat_axes_have_level_zero():
    scene = random_scene(50)
    result = encoded(replaced(scene, means=scene.means * [1, 0, 1] + [0, 3, 0]), "fast")
    assert (pixels(result, "means_l.webp")[..., 1] == 0).all()
    assert (pixels(result, "means_u.webp")[..., 1] == 0).all()
    np.testing.assert_allclose(kissgs.decompress(result.files).means[:, 1], 3, rtol=1e-6)


@pytest.mark.parametrize("preset", ["balanced", "fast"])
def test_extremes_survive(preset):
    scene = random_scene(40, 1)
    means, scales, opacities, sh0 = (getattr(scene, name).copy() for name in ("means", "scales", "opacities", "sh0"))
    means[:3] = [[1e9, -1e9, 0], [-3e4, 0, 1e-6], [0, 0, 0]]
    scales[:3] = [[-30, -30, -30], [8, -9, -9], [0, 0, 0]]
    opacities[:3] = [13.8, -5.5, 0]
    sh0[:3] = [[900, -900, 0], [4, 4, 4], [0, 0, 0]]
    extreme = replaced(scene, means=means, scales=scales, opacities=opacities, sh0=sh0)
    assert_round_trip(extreme, encoded(extreme, preset))


@pytest.mark.parametrize("preset", ["balanced", "paper"])
def test_constant_scenes(preset):
    scene = constant_scene(40, 1)
    result = encoded(scene, preset)
    assert_round_trip(scene, result)
    assert result.report.container_bytes < 3000


def test_a_target_size_counts_the_bytes_of_the_file(tmp_path):
    scene = sample_scene(400, sh_degree=1, seed=4)
    settings = Settings.research("balanced", target_size=6500, max_encodes=4, finetune={"enabled": False}, **GLANCE)
    result = compress(scene, tmp_path / "scene.sog", settings=settings)
    assert result.container == "sog"
    assert (tmp_path / "scene.sog").stat().st_size == result.report.container_bytes <= 6500
    assert len(result.report.trials) > 1


@pytest.mark.quick(0)
def test_a_quality_goal_and_evaluation_decode_the_file():
    scene = sample_scene(250, sh_degree=0, seed=4)
    settings = Settings.research("balanced", psnr=32, max_encodes=3, **GLANCE)
    result = compress(scene, settings=settings, container="sog", evaluate=True)
    assert max(trial.psnr for trial in result.report.trials) >= 32
    assert result.report.evaluation is not None


def test_a_folder_holds_the_same_files(tmp_path):
    result = compress(random_scene(20), tmp_path / "folder", settings=Settings(preset="fast"), container="sog")
    assert {path.name: path.read_bytes() for path in (tmp_path / "folder").iterdir()} == dict(result.files)
    assert len(kissgs.load(tmp_path / "folder" / "meta.json")) == 20
    compress(random_scene(9), tmp_path / "folder", settings=Settings(preset="fast"), container="sog", overwrite=True)
    assert len(kissgs.load(tmp_path / "folder")) == 9


@pytest.mark.parametrize("first", [{"container": "sog"}, {"container": "sogxt"}])
def test_a_folder_of_any_container_is_replaced(first, tmp_path):
    """Regression: degree 0, which has no codebook, could not replace a higher degree, and said so after the work."""
    folder, fast = tmp_path / "folder", Settings(preset="fast")
    compress(random_scene(9, 2), folder, settings=fast, **first)
    result = compress(random_scene(7), folder, settings=fast, container="sog", overwrite=True)
    assert {path.name for path in folder.iterdir()} == set(result.files)
    result.save(folder, overwrite=True)
    compress(random_scene(9, 2), settings=fast, container="sogxt").save(folder, overwrite=True)
    assert kissgs.load(folder).sh_degree == 2


def test_what_cannot_be_written_is_refused(tmp_path):
    scene, fast = random_scene(5), Settings(preset="fast")
    for call, message in (
        (lambda: compress(scene, container="ply"), "there is no container 'ply'; choose one of sogxt, sog"),
        (lambda: compress(scene, tmp_path / "a.zip", container="sog"), r"end it in \.sog"),
        (lambda: compress(scene, settings=fast).save(tmp_path / "a.sog"), r"end it in \.zip"),
        (lambda: compress(scene.select([]), settings=fast, container="sog"), "without visible Gaussians"),
    ):
        with pytest.raises(UnsupportedError, match=message):
            call()
    assert not list(tmp_path.iterdir())


def test_the_command_line_writes_sog_by_ending_or_by_name(tmp_path):
    kissgs.save(random_scene(30), tmp_path / "a.ply")
    kissgs.save(random_scene(20), tmp_path / "b.ply")
    assert run("compress", tmp_path / "a.ply", "-p", "fast", "-q", "-o", tmp_path / "one.sog").returncode == 0
    both = run("compress", tmp_path / "*.ply", "-p", "fast", "-q", "--container", "sog", "-o", f"{tmp_path}/all/")
    assert both.returncode == 0
    assert [len(kissgs.load(tmp_path / name)) for name in ("one.sog", "all/a.sog", "all/b.sog")] == [30, 30, 20]
    assert (tmp_path / "one.sog").read_bytes() == (tmp_path / "all/a.sog").read_bytes()
    piped = run("compress", tmp_path / "a.ply", "-p", "fast", "-q", "--container", "sog", "-o", "-").stdout
    assert piped == (tmp_path / "one.sog").read_bytes()
    wrong = run("compress", tmp_path / "a.ply", "--container", "spz")
    assert (wrong.returncode, b"choose one of sogxt, sog" in wrong.stderr) == (2, True)
