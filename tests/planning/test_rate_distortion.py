"""Whole scenes with rate-distortion planning. Oracle: a naive decoder; scenes with degenerate sensitivity."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import reference_decoder
from helpers.codec_scenes import constant_scene, covariances, random_scene
from helpers.random_sensitivity import encode_rd, random_sensitivity

import kissgs
from kissgs import Settings, decompress
from kissgs.core.context import Context
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import ATTRIBUTES
from kissgs.sogxt.encode import encode


def test_higher_quality_has_more_bytes_and_smaller_errors():
    splats = random_scene(1500, 1, seed=3)
    sensitivity = random_sensitivity(splats)
    sizes, errors = [], []
    for quality_offset_db in (-6, 0, 6):
        result = encode_rd(splats, sensitivity, quality_offset_db=quality_offset_db, prune_threshold_bits=0)
        sizes.append(sum(map(len, result.files.values())))
        found, wanted = decompress(result.files), splats.select(result.order)
        errors.append(float(sensitivity.diagonal((0,))[result.order, 0] @ (found.opacities - wanted.opacities) ** 2))
    assert sizes == sorted(sizes)
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize(("share", "many"), [(0.05, False), (0.4, True)])
def test_the_least_important_are_left_out_and_counted(share, many):
    """A note says why if they are many."""
    splats = random_scene(1000, 0, seed=4)
    sensitivity = random_sensitivity(splats)
    removal = sensitivity.removal(splats)
    rd_lambda = float(np.quantile(removal, share)) / 30
    result = encode_rd(splats, sensitivity, rd_lambda=rd_lambda, prune_threshold_bits=30)
    assert sorted(result.order) == np.flatnonzero(removal >= 30 * rd_lambda).tolist()
    assert 0 < result.pruned_by_rd == 1000 - len(result.order)
    assert bool(result.note) == many
    assert not many or result.note.startswith(f"{result.pruned_by_rd:,} of 1,000 Gaussians were pruned")


def test_growth_is_held_back():
    """A Gaussian below a pixel's size costs nothing in these views, whatever its size, but is a blob from nearby."""
    splats = random_scene(2000, 0, seed=5)
    sensitivity = random_sensitivity(splats)
    result = encode_rd(
        splats,
        replace(sensitivity, shape_hessian=sensitivity.shape_hessian * np.float32(1e-8)),
        rd_lambda=1e-5,
        prune_threshold_bits=0,
    )
    found, wanted = decompress(result.files), splats.select(result.order)
    grown = np.linalg.det(covariances(found.quats, found.scales)) / np.linalg.det(
        covariances(wanted.quats, wanted.scales)
    )
    assert grown.max() < np.exp(2 * 3 * 0.3 + 1e-3)


def torture():
    scene = random_scene(300, 2, seed=9)
    nothing = Sensitivity.none(300, 2)
    only = np.zeros(300, np.float32)
    only[17] = 1e-5
    one_seen = replace(nothing, color_weight=only, shape_hessian=only[:, None] * np.ones((1, 10), np.float32))
    black = replace(scene, sh0=np.full((300, 3), -5, np.float32))
    few = replace(scene, shN=scene.shN[np.arange(300) % 3])
    huge = random_sensitivity(scene, spread=20)
    return [
        pytest.param(scene, nothing, id="nothing is seen"),
        pytest.param(scene, one_seen, id="one Gaussian is seen"),
        pytest.param(black, random_sensitivity(black), id="all colours are clamped"),
        pytest.param(few, random_sensitivity(few), id="fewer SH vectors than entries"),
        pytest.param(scene, huge, id="sensitivity over forty orders of magnitude"),
        pytest.param(constant_scene(300, 2), random_sensitivity(scene), id="all alike"),
    ]


@pytest.mark.parametrize(("splats", "sensitivity"), torture())
def test_scenes_that_break_weights(splats, sensitivity):
    once = encode(splats, Settings.from_preset("balanced").encode, sensitivity=sensitivity)
    found = decompress(once.files)
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(once.files), once.files)
    assert len(found) == len(once.order) > 0
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)


def test_colours_are_asked_for_once_the_rest_is_known():
    splats = random_scene(500, 1, seed=6)
    asked = []

    def recolor(decoded, order):
        asked.append((decoded, order))
        return np.full((len(order), 3), 0.25, np.float32)

    settings = Settings.research("balanced", order="hilbert").encode
    result = encode(splats, settings, sensitivity=random_sensitivity(splats), recolor=recolor)
    ((decoded, order),) = asked
    found = decompress(result.files)
    np.testing.assert_array_equal(order, result.order)
    np.testing.assert_allclose(found.sh0, 0.25, atol=1e-6)
    np.testing.assert_allclose(decoded.scales, found.scales, atol=1e-5)
    np.testing.assert_allclose(decoded.opacities, found.opacities, atol=1e-5)
    np.testing.assert_allclose(decoded.means, found.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(decoded.shN, found.shN, atol=1e-6)


def test_threads_do_not_change_a_byte():
    splats = random_scene(1000, 3, seed=7)
    sensitivity = random_sensitivity(splats)
    settings = Settings.from_preset("balanced").encode
    one, three = (encode(splats, settings, Context(threads), sensitivity=sensitivity).files for threads in (1, 3))
    assert one == three


@pytest.mark.parametrize(
    "changes", [{"order": "plas"}, {"rotation_form": "pras"}, {"sh_codebook_size": 64}, {"step_classes": 7}]
)
def test_rate_distortion_works_with_every_order_and_form(changes):
    splats = random_scene(700, 1, seed=8)
    result = encode_rd(splats, random_sensitivity(splats), prune_threshold_bits=0, sh_tolerance=0, **changes)
    found, wanted = decompress(result.files), splats.select(result.order)
    assert sorted(result.order) == list(range(700))
    for name, field in (("opacities", "opacities"), ("sh0", "f_dc")):
        assert np.abs(getattr(found, name) - getattr(wanted, name)).max() <= max(result.errors[field]) + 1e-5
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(result.files), result.files)


@pytest.mark.quick(0)
def test_an_enormous_coefficient_does_not_change_what_is_kept():
    """Brighter than a display shows is no reason to give up on others: a Gaussian in a hundred at most is chosen
    otherwise, at the border of what is worth its bytes."""
    plain = kissgs.sample_scene(4000, seed=3)
    shN = plain.shN.copy()
    shN[::800, 4, 1] = 1e5
    settings = kissgs.Settings.research("balanced", sensitivity_views=12, sensitivity_view_size=128)
    usual, found = (
        set(kissgs.compress(scene, settings=settings).order.tolist()) for scene in (plain, replace(plain, shN=shN))
    )
    assert len(usual ^ found) < 0.01 * len(plain)
