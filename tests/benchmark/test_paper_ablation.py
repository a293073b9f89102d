"""Oracle: what a decoder must then find, and bytes that are counted by hand."""

import zlib
from dataclasses import replace

import numpy as np
import pytest

from kissgs import Settings, sample_scene
from kissgs.benchmark import paper_ablation as recoding
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.encode import encode

SETTINGS = Settings.from_preset("paper", sh_kmeans_iterations=1).encode
SCENE = sample_scene(500, sh_degree=2, seed=3)


@pytest.fixture(scope="module")
def whole():
    return recoding.coded(SCENE, SETTINGS, 1)


def changed(whole, coded):
    return [
        name for name in ATTRIBUTES if not np.array_equal(getattr(whole.decoded, name), getattr(coded.decoded, name))
    ]


def test_the_whole_is_the_container(whole):
    files = encode(SCENE, SETTINGS, threads=1).files
    assert whole.size(SETTINGS, 1) == len(zip_bytes(files))


def test_what_is_exact_is_the_scene_in_other_forms(whole):
    """The covariance of every Gaussian is its own, and its rotation the one that was rounded."""
    grid = whole.choice.grid
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
    turn = np.moveaxis(np.array(rows), 2, 0) * np.exp(splats.scales)[:, None, :]
    return turn @ turn.transpose(0, 2, 1)


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
def test_numbers_instead_of_levels(whole, field, images):
    coded = recoding.as_floats(field, *images)(whole, SETTINGS, 1)
    assert changed(whole, coded) == [field]
    assert np.array_equal(getattr(coded.decoded, field), getattr(whole.exact, field))
    assert set(whole.images) - set(coded.images) == {f"{name}.webp" for name in images}
    unpacked = np.frombuffer(zlib.decompress(coded.stored[field]), np.uint8).reshape(4, -1).T
    assert np.array_equal(unpacked.copy().view(np.float32).ravel(), getattr(whole.exact, field).ravel())


@pytest.mark.parametrize(
    "leave_out", [recoding.webp, recoding.scene_order, recoding.codebook_order, recoding.label_pairs]
)
def test_what_only_costs_bytes_changes_nothing_else(whole, leave_out):
    coded = leave_out(whole, SETTINGS, 1)
    assert changed(whole, coded) == []
    assert coded.size(SETTINGS, 1) != whole.size(SETTINGS, 1)


def test_without_webp_every_level_is_a_byte(whole):
    stored = recoding.webp(whole, SETTINGS, 1).stored
    cells, entries = whole.choice.grid.side**2, whole.choice.codebook.side**2
    levels = sum(len(data) for name, data in stored.items() if name.endswith(".webp"))
    assert levels == cells * (1 + 3 + 3 + 1 + 3 + 4 + 3 + 2) + entries * 45


def test_the_scenes_order_is_that_of_the_scene(whole):
    cells = whole.choice.grid.cells
    mask = recoding.scene_order(whole, SETTINGS, 1).images["active_mask.webp"].ravel() > 0
    assert mask.sum() == len(SCENE)
    assert np.array_equal(np.sort(cells)[mask], np.arange(len(SCENE)))


def test_a_codebook_of_numbers_is_no_worse_than_one_of_levels(whole):
    coded = recoding.codebook_levels(whole, SETTINGS, 1)
    assert changed(whole, coded) == ["shN"]
    assert error(coded, "shN") < error(whole, "shN")


def test_without_a_codebook_every_coefficient_is_right_to_half_a_step(whole):
    coded = recoding.sh_codebook(whole, SETTINGS, 1)
    assert changed(whole, coded) == ["shN"]
    step = np.ptp(whole.exact.shN, axis=0) / 99
    assert (np.abs(coded.decoded.shN - whole.exact.shN) <= 0.501 * step + 1e-7).all()
    assert sum(name.startswith("sh_") for name in coded.images) == 8


@pytest.mark.parametrize("top", [99, 255])
def test_forms_of_the_scene_are_right_to_half_a_step(whole, top):
    coded = recoding.forms(top)(whole, SETTINGS, 1)
    assert changed(whole, coded) == ["quats", "scales"]
    grid = whole.choice.grid
    scene = SCENE.select(grid.cells[grid.mask])
    for name, levels in (("quats", top), ("scales", 255)):
        step = np.ptp(getattr(SCENE, name), axis=0) / levels
        assert (np.abs(getattr(coded.decoded, name) - getattr(scene, name)) <= 0.501 * step + 1e-6).all()


def test_a_square_holds_the_most_opaque(whole):
    coded = recoding.mask(whole, SETTINGS, 1)
    assert len(coded.decoded) == 16**2
    assert np.sort(coded.exact.opacities)[0] >= np.sort(SCENE.opacities)[-(16**2)]
    assert "active_mask.webp" not in coded.images


def test_even_steps_of_positions(whole):
    far = replace(SCENE, means=SCENE.means * np.where(np.arange(500) == 7, 1000, 1)[:, None].astype(np.float32))
    one = recoding.coded(far, SETTINGS, 1)
    coded = recoding.signed_log(one, SETTINGS, 1)
    step = np.ptp(far.means) / 65_535
    errors = np.abs(coded.decoded.means - one.exact.means)
    assert errors.max() <= 0.51 * step
    near = np.argsort(np.abs(one.exact.means).max(axis=1))[:250]
    assert errors[near].mean() > 3 * np.abs(one.decoded.means - one.exact.means)[near].mean()


def error(coded, name):
    return float(((getattr(coded.decoded, name) - getattr(coded.exact, name)) ** 2).mean())
