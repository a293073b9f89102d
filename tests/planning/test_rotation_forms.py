"""Oracle: SciPy's rotations, covariance matrices written out, and brute force over all 48 forms."""

import numpy as np
import pytest
from helpers.codec_scenes import covariances, equivalents, random_scene, unit
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kissgs.core.context import blas_workers
from kissgs.planning import kernels, rotation_forms
from kissgs.planning.layout import box_blur
from kissgs.planning.rotation_forms import (
    PERMUTATIONS,
    ROTATIONS,
    apply_forms,
    canonical_forms,
    covariance_error,
    pras_forms,
)


@pytest.fixture(scope="module")
def gaussians():
    splats = random_scene(256, 0, seed=1)
    quats = splats.quats.astype(np.float64)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True), splats.scales


def in_all_forms(quats, scales):
    return [apply_forms(quats, scales, np.full(len(quats), form, np.uint8)) for form in range(48)]


def test_all_48_forms_are_the_same_ellipsoid(gaussians):
    quats, scales = gaussians
    before = covariances(quats, scales)
    for new_quats, new_scales in in_all_forms(quats, scales):
        rotation = Rotation.from_quat(new_quats, scalar_first=True).as_matrix()
        after = rotation @ (np.exp(2 * new_scales.astype(np.float64))[:, :, None] * rotation.transpose(0, 2, 1))
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12)


def test_the_forms_are_those_of_the_cube():
    """48 different ones, the same as those found by SciPy's list of the cube's rotations."""
    splats = random_scene(1, 0, seed=2)
    quats, scales = splats.quats.astype(np.float64), splats.scales
    ours = {tuple(np.round(np.concatenate([q[0], s[0]]), 5)) for q, s in in_all_forms(quats, scales)}
    theirs = {
        tuple(np.round(np.concatenate([q[0], s[0]]), 5)) for q, s in zip(*equivalents(quats, scales), strict=True)
    }
    assert len(ours) == 48
    assert ours == theirs


def test_upright_does_not_depend_on_the_form_that_came_in(gaussians):
    """All 48 forms of a Gaussian are stored alike, so its neighbours' form tells nothing about it."""
    quats, scales = gaussians
    wanted = apply_forms(quats, scales, canonical_forms(quats))
    assert (canonical_forms(wanted[0]) == 0).all()
    assert (canonical_forms(np.array([[1.0, 0, 0, 0], [-1, 0, 0, 0]])) == [0, 24]).all()
    for other_quats, other_scales in in_all_forms(quats, scales):
        found = apply_forms(other_quats, other_scales, canonical_forms(other_quats))
        np.testing.assert_allclose(found[0], wanted[0], atol=1e-7)
        assert (found[1] == wanted[1]).all()


@examples(50)
@given(st.lists(st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]), min_size=4, max_size=4).filter(any))
def test_ties_are_broken_the_same_way_on_every_machine(numbers):
    """Rotations by 45 or 90 degrees have several forms of equal w; the last bits must not decide."""
    quat = unit([numbers]).astype(np.float64)
    forms = [canonical_forms(quat * (1 + delta)) for delta in (0, 1e-15, -1e-15, 1e-12)]
    assert len({int(form[0]) for form in forms}) == 1


def smooth(quats, scales, threads=1, decay=0.8):
    with blas_workers(threads) as pool:
        return pras_forms(quats, scales, int(len(quats) ** 0.5), pool, decay=decay)


def roughness(quats, scales):
    side = int(len(quats) ** 0.5)
    table = np.concatenate([quats, scales / 10], axis=1).reshape(side, side, 7)
    return sum(np.abs(np.diff(table, axis=axis)).sum(axis=2).mean() for axis in (0, 1))


def test_pras_forms_make_neighbours_alike():
    """A scene of like rotations, each written in a form of its own: the forms chosen undo most of that."""
    rng = np.random.default_rng(0)
    even = unit(np.array([1, 0.2, -0.1, 0.3]) + rng.normal(0, 0.02, (1024, 4))).astype(np.float64)
    flat = (np.array([-3, -4, -6]) + rng.normal(0, 0.05, (1024, 3))).astype(np.float32)
    quats, scales = apply_forms(even, flat, rng.integers(0, 48, 1024).astype(np.uint8))
    found = apply_forms(quats, scales, smooth(quats, scales))
    assert roughness(*found) < roughness(even, flat) + 0.05 * (roughness(quats, scales) - roughness(even, flat))


def test_pras_forms_do_not_depend_on_threads(gaussians):
    assert (smooth(*gaussians) == smooth(*gaussians, threads=3)).all()


def test_constant_scales_are_no_trouble(gaussians):
    """The proxy's range is zero there, which once could mean a division by zero."""
    quats, _ = gaussians
    for value in (0, -30, 30):
        forms = smooth(quats, np.full((256, 3), value, np.float32))
        assert forms.max() < 48


def test_each_gaussian_takes_the_form_nearest_to_its_target(gaussians):
    """One radius on an 8 x 8 grid, by brute force: sums of absolute differences over seven channels."""
    quats, scales = gaussians[0][:64], gaussians[1][:64]
    proxies = np.concatenate([quats * 127.5, scales * 20], axis=1).astype(np.float32)
    with blas_workers(1) as pool:
        target = box_blur(proxies.reshape(8, 8, 7).copy(), 3, pool).reshape(64, 7)
    forms = np.zeros(64, np.uint8)
    quat_proxy, scale_proxy = (np.ascontiguousarray(part) for part in (proxies[:, :4], proxies[:, 4:]))
    kernels.nearest_forms(quat_proxy, scale_proxy, target, ROTATIONS.astype(np.float32), PERMUTATIONS, forms)
    candidates = np.stack(
        [np.concatenate(form, axis=1) for form in in_all_forms(quat_proxy.astype(np.float64), scale_proxy)]
    )
    costs = np.abs(candidates - target).sum(axis=2)
    np.testing.assert_allclose(costs[forms, np.arange(64)], costs.min(axis=0), rtol=1e-5)


def test_the_current_form_wins_ties():
    """Without this rule, equal candidates would make forms flicker from radius to radius."""
    quats, scales = np.float32([[127.5, 0, 0, 0]]), np.float32([[5, 5, 5]])
    target = np.float32([[0, 0, 0, 0, 5, 5, 5]])  # all of the first four rows, and their negatives, are as far
    for current in (0, 1, 2, 3, 24, 25, 26, 27):
        forms = np.array([current], np.uint8)
        kernels.nearest_forms(quats, scales, target, ROTATIONS.astype(np.float32), PERMUTATIONS, forms)
        assert forms[0] == current


def test_covariance_error_measures_what_it_says(gaussians):
    quats, scales = gaussians
    assert covariance_error(quats, scales, quats, scales) == 0
    assert covariance_error(quats, scales, *apply_forms(quats, scales, canonical_forms(quats))) < 1e-12
    changed = scales.copy()
    changed[17, scales[17].argmax()] += np.float32(np.log(1.01))  # its largest variance grows by 2.01 %
    before, after = covariances(quats, scales)[17], covariances(quats, changed)[17]
    wanted = np.linalg.norm(after - before) / np.linalg.norm(before)
    np.testing.assert_allclose(covariance_error(quats, scales, quats, changed), wanted, rtol=1e-4)


@pytest.mark.parametrize("size", [-30, 30])
def test_covariance_error_of_extreme_sizes_is_finite(gaussians, size):
    quats = gaussians[0]
    scales = np.full((256, 3), size, np.float32) * np.float32([1, -1, 1])
    assert covariance_error(quats, scales, *apply_forms(quats, scales, canonical_forms(quats))) < 1e-6


def angles(p, q):
    return 2 * np.arccos(np.clip(np.abs((p * q).sum(axis=1)), 0, 1))


@pytest.fixture
def turns():
    random = unit(np.random.default_rng(2).normal(size=(500, 4))).astype(np.float64)
    half = np.sqrt(0.5)
    corners = [[half, half, 0, 0], [0.5, 0.5, 0.5, 0.5], [0, 0, 0, -1], [-half, 0, 0, half], [1, 0, 0, 0]]
    return np.concatenate([random, np.array(corners)])


def test_decoded_rotations_are_near_and_of_length_one(turns):
    omitted = rotation_forms.omitted_components(turns)
    signed = rotation_forms.with_sign(turns, omitted)
    levels = rotation_forms.lattice_levels(rotation_forms.stored_components(signed, omitted), 1)
    found = rotation_forms.whole(rotation_forms.TABLE[levels], omitted)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert np.degrees(angles(found, turns)).max() < 2
    missing = np.take_along_axis(found, omitted[:, None].astype(np.int64), axis=1)
    assert (missing >= 0).all()
    assert (np.abs(found[:, 1:]) <= np.sqrt(0.5) + 1e-12)[omitted == 0].all()


def test_coarse_levels_are_multiples_and_exist(turns):
    omitted = rotation_forms.omitted_components(turns)
    small = rotation_forms.stored_components(rotation_forms.with_sign(turns, omitted), omitted)
    levels = rotation_forms.lattice_levels(small, np.full(len(turns), 16)).astype(np.int64)
    assert rotation_forms.fits(levels).all()
    assert ((levels - 127) % 16 == 0).mean() > 0.9


def test_canonical_forms_leave_out_w(turns):
    forms = canonical_forms(turns)
    turned, _ = apply_forms(turns, np.zeros((len(turns), 3), np.float32), forms)
    assert (rotation_forms.omitted_components(turned) == 0).all()
    assert (turned[:, 0] > 0.85).all()
