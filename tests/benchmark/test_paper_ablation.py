"""Reference: what a decoder must get, and bytes counted by hand."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from kissgs import Settings, sample_scene
from kissgs.benchmark import paper_ablation
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.encode import encode

SETTINGS = Settings.from_preset("paper", sh_kmeans_iterations=1).encode
SCENE = sample_scene(500, sh_degree=2, seed=3)


@pytest.fixture(scope="module")
def whole():
    return paper_ablation.encode_parts(SCENE, SETTINGS, 1)


def changed(whole, parts):
    return [
        name for name in ATTRIBUTES if not np.array_equal(getattr(whole.decoded, name), getattr(parts.decoded, name))
    ]


def test_the_whole_is_the_container(whole):
    files = encode(SCENE, SETTINGS, threads=1).files
    assert whole.size(SETTINGS, 1) == len(zip_bytes(files))


def test_the_exact_scene_is_the_scene_in_other_forms(whole):
    """Each Gaussian keeps its covariance, and its form is the one that was quantised."""
    grid = whole.plan.grid
    scene = SCENE.select(grid.cells[grid.mask])
    one, other = covariances(scene), covariances(whole.exact)
    np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max(axis=(1, 2)).max())
    dots = (whole.exact.quats * whole.decoded.quats).sum(axis=1)
    assert dots.min() > 0.99
    assert np.abs(whole.exact.scales - whole.decoded.scales).max() < 0.1


def covariances(splats):
    w, x, y, z = splats.quats.T.astype(np.float64)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    factors = np.moveaxis(np.array(rows), 2, 0) * np.exp(splats.scales)[:, None, :]
    return factors @ factors.transpose(0, 2, 1)


@pytest.mark.parametrize(
    ("field", "images"),
    [
        ("quats", ["quaternions"]),
        ("scales", ["scales"]),
        ("sh0", ["f_dc"]),
        ("opacities", ["opacities"]),
        ("means", ["means_bytes_0", "means_bytes_1"]),
    ],
)
def test_floats_instead_of_levels(whole, field, images):
    parts = paper_ablation.as_floats(field, *images)(whole, SETTINGS, 1)
    assert changed(whole, parts) == [field]
    assert np.array_equal(getattr(parts.decoded, field), getattr(whole.exact, field))
    assert set(whole.images) - set(parts.images) == {f"{name}.webp" for name in images}
    unpacked = np.frombuffer(zlib.decompress(parts.other_files[field]), np.uint8).reshape(4, -1).T
    assert np.array_equal(unpacked.copy().view(np.float32).ravel(), getattr(whole.exact, field).ravel())


@pytest.mark.parametrize(
    "leave_out",
    [paper_ablation.webp, paper_ablation.scene_order, paper_ablation.codebook_order, paper_ablation.label_pairs],
)
def test_parts_that_only_save_bytes_do_not_change_the_decoded_scene(whole, leave_out):
    parts = leave_out(whole, SETTINGS, 1)
    assert changed(whole, parts) == []
    assert parts.size(SETTINGS, 1) != whole.size(SETTINGS, 1)


def test_without_webp_every_level_is_a_byte(whole):
    files = paper_ablation.webp(whole, SETTINGS, 1).other_files
    cells, entries = whole.plan.grid.side**2, whole.plan.codebook.side**2
    levels = sum(len(data) for name, data in files.items() if name.endswith(".webp"))
    assert levels == cells * (1 + 3 + 3 + 1 + 3 + 4 + 3 + 2) + entries * 45


def test_gaussians_are_in_the_order_of_the_scene(whole):
    cells = whole.plan.grid.cells
    mask = paper_ablation.scene_order(whole, SETTINGS, 1).images["active_mask.webp"].ravel() > 0
    assert mask.sum() == len(SCENE)
    assert np.array_equal(np.sort(cells)[mask], np.arange(len(SCENE)))


def test_a_codebook_of_floats_is_more_accurate_than_one_of_levels(whole):
    parts = paper_ablation.codebook_levels(whole, SETTINGS, 1)
    assert changed(whole, parts) == ["shN"]
    assert mean_squared_error(parts, "shN") < mean_squared_error(whole, "shN")


def test_without_a_codebook_the_error_of_a_coefficient_is_at_most_half_a_step(whole):
    parts = paper_ablation.sh_codebook(whole, SETTINGS, 1)
    assert changed(whole, parts) == ["shN"]
    step = np.ptp(whole.exact.shN, axis=0) / 99
    assert (np.abs(parts.decoded.shN - whole.exact.shN) <= 0.501 * step + 1e-7).all()
    assert sum(name.startswith("sh_") for name in parts.images) == 8


@pytest.mark.parametrize("top", [99, 255])
def test_in_forms_of_the_scene_errors_are_at_most_half_a_step(whole, top):
    parts = paper_ablation.rotation_forms(top)(whole, SETTINGS, 1)
    assert changed(whole, parts) == ["quats", "scales"]
    grid = whole.plan.grid
    scene = SCENE.select(grid.cells[grid.mask])
    for name, levels in (("quats", top), ("scales", 255)):
        step = np.ptp(getattr(SCENE, name), axis=0) / levels
        assert (np.abs(getattr(parts.decoded, name) - getattr(scene, name)) <= 0.501 * step + 1e-6).all()


def test_without_a_mask_the_most_opaque_gaussians_fill_a_square(whole):
    parts = paper_ablation.mask(whole, SETTINGS, 1)
    assert len(parts.decoded) == 16**2
    assert np.sort(parts.exact.opacities)[0] >= np.sort(SCENE.opacities)[-(16**2)]
    assert "active_mask.webp" not in parts.images


def test_uniform_steps_of_positions(whole):
    far = replace(SCENE, means=SCENE.means * np.where(np.arange(500) == 7, 1000, 1)[:, None].astype(np.float32))
    one = paper_ablation.encode_parts(far, SETTINGS, 1)
    parts = paper_ablation.signed_log(one, SETTINGS, 1)
    step = np.ptp(far.means) / 65_535
    errors = np.abs(parts.decoded.means - one.exact.means)
    assert errors.max() <= 0.51 * step
    near = np.argsort(np.abs(one.exact.means).max(axis=1))[:250]
    assert errors[near].mean() > 3 * np.abs(one.decoded.means - one.exact.means)[near].mean()


def mean_squared_error(parts, name):
    return float(((getattr(parts.decoded, name) - getattr(parts.exact, name)) ** 2).mean())
