"""Scenes, and spherical harmonics. Oracles: the promises of the docstrings in float64; SciPy's complex harmonics."""

import numpy as np
import pytest
from helpers.examples import examples
from helpers.reference_harmonics import real_harmonics
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from kissgs import InvalidSceneError, Splats, clean
from kissgs.core.harmonics_kernel import write_harmonics
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import (
    ATTRIBUTES,
    LOG_SCALE_LIMIT,
    MEAN_LIMIT,
    OPACITY_LOGIT_MAX,
    OPACITY_LOGIT_MIN,
    SH_LIMIT,
    SH_REST_COUNTS,
    Cleaned,
)


def tidy(count=6, degree=1):
    """Arrays of a clean scene, all numbers different."""
    numbers = np.random.default_rng(0)
    quats = numbers.normal(size=(count, 4))
    arrays = {
        "means": numbers.normal(size=(count, 3)),
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": numbers.normal(-3, 1, (count, 3)),
        "opacities": numbers.normal(size=count),
        "sh0": numbers.normal(size=(count, 3)),
        "shN": numbers.normal(size=(count, SH_REST_COUNTS[degree], 3)),
    }
    return {name: array.astype(np.float32) for name, array in arrays.items()}


def test_shapes_and_sizes_are_reported():
    for degree, coefficients in enumerate(SH_REST_COUNTS):
        splats = Splats(**tidy(6, degree))
        assert (len(splats), splats.sh_degree) == (6, degree)
        assert splats.nbytes == 6 * 4 * (3 + 4 + 3 + 1 + 3 + 3 * coefficients)


@pytest.mark.parametrize("name", ATTRIBUTES)
@pytest.mark.parametrize("wrong", ["float64", "int", "longer", "shorter", "wider", "flat", "scalar"])
def test_arrays_of_another_type_or_shape_are_refused_by_name(name, wrong):
    arrays = tidy()
    right = arrays[name]
    arrays[name] = {
        "float64": right.astype(np.float64),
        "int": right.astype(np.int32),
        "longer": np.concatenate([right, right]),
        "shorter": right[:-1],
        "wider": np.stack([right, right], axis=-1),
        "flat": right.reshape(-1)[:, None, None, None],
        "scalar": np.array(3, np.float32),
    }[wrong]
    with pytest.raises(InvalidSceneError) as caught:
        Splats(**arrays)
    if wrong in ("float64", "int"):
        assert str(caught.value).startswith(f"{name} is {arrays[name].dtype} of shape {right.shape}")
    if name == "shN" and wrong == "wider":
        assert str(caught.value) == "shN has shape (6, 3, 3, 2); it must be (N, K, 3) with K one of (0, 3, 8, 15)"


@pytest.mark.parametrize("coefficients", [1, 2, 4, 7, 9, 14, 16, 24])
def test_other_numbers_of_coefficients_are_refused(coefficients):
    arrays = {**tidy(), "shN": np.zeros((6, coefficients, 3), np.float32)}
    with pytest.raises(InvalidSceneError, match=r"it must be \(N, K, 3\) with K one of"):
        Splats(**arrays)


def test_selecting_takes_rows_in_the_order_asked_for():
    splats = Splats(**tidy())
    for index in (np.array([4, 0, 0]), np.array([True, False, True, True, False, False]), slice(4, 1, -2)):
        part = splats.select(index)
        for name in ATTRIBUTES:
            assert (getattr(part, name) == getattr(splats, name)[index]).all()
    assert len(splats.select(np.zeros(0, dtype=int))) == 0


def test_cleaning_a_clean_scene_changes_nothing_and_copies_nothing():
    splats = Splats(**tidy())
    cleaned, report = clean(splats)
    assert report == Cleaned()
    assert report.removed == 0
    for name in ATTRIBUTES:
        assert (getattr(cleaned, name) == getattr(splats, name)).all()
        if name != "opacities":
            assert getattr(cleaned, name) is getattr(splats, name)


def test_cleaning_leaves_the_input_as_it_was():
    arrays = tidy()
    arrays["means"][0] = np.nan
    arrays["quats"][1], arrays["quats"][2] = 7, -3
    arrays["scales"][2] = 99
    arrays["opacities"][3] = np.inf
    arrays["sh0"][4] = 1e9
    before = {name: array.copy() for name, array in arrays.items()}
    cleaned, report = clean(Splats(**arrays))
    assert report.as_dict() == {
        "non_finite": 1,
        "far_away": 0,
        "infinite_opacities": 1,
        "saturated_opacities": 0,
        "zero_quats": 0,
        "unnormalised_quats": 2,
        "clamped_scales": 1,
        "clamped_sh": 1,
    }
    assert len(cleaned) == 5
    assert all(np.array_equal(arrays[name], before[name], equal_nan=True) for name in ATTRIBUTES)


@pytest.mark.parametrize("name", ["sh0", "shN"])
def test_infinities_of_both_signs_in_one_colour(name):
    """The sum of such values is NaN, and NumPy once printed a warning about it."""
    arrays = tidy()
    arrays[name].reshape(6, -1)[2, :2] = np.inf, -np.inf
    cleaned, report = clean(Splats(**arrays))
    assert report == Cleaned(non_finite=1)
    assert (cleaned.means == arrays["means"][[0, 1, 3, 4, 5]]).all()


def test_one_gaussian_counts_once_for_each_thing_that_is_wrong_with_it():
    arrays = tidy()
    arrays["scales"][1] = 31, -31, np.inf
    arrays["sh0"][1] = 1e7
    arrays["shN"][1] = 1e7
    arrays["opacities"][1] = -20
    _, report = clean(Splats(**arrays))
    assert report == Cleaned(clamped_scales=1, clamped_sh=1, saturated_opacities=1)


def test_a_gaussian_that_is_removed_is_not_mended_too():
    arrays = tidy()
    arrays["means"][1] = 1e20
    arrays["quats"][1] = 0
    arrays["opacities"][1] = np.inf
    arrays["sh0"][2] = np.nan
    arrays["means"][2] = 1e20
    _, report = clean(Splats(**arrays))
    assert report == Cleaned(non_finite=1, far_away=1)
    assert report.removed == 2


def test_slightly_long_rotations_are_normalised_without_a_word():
    arrays = tidy()
    arrays["quats"][3] *= np.float32(1.0005)
    cleaned, report = clean(Splats(**arrays))
    assert report == Cleaned()
    np.testing.assert_allclose(np.linalg.norm(cleaned.quats.astype(np.float64), axis=1), 1, atol=2e-7)


def anything(*shape):
    return stnp.arrays(np.float32, shape, elements=st.floats(width=32), fill=st.floats(width=32))


@examples(100)
@given(st.data(), st.integers(0, 5), st.sampled_from(SH_REST_COUNTS))
def test_whatever_the_numbers_cleaning_gives_a_canonical_scene(data, count, coefficients):
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (3,), "shN": (coefficients, 3)}
    splats = Splats(**{name: data.draw(anything(count, *shape)) for name, shape in shapes.items()})
    cleaned, report = clean(splats)
    assert len(cleaned) == count - report.removed
    assert all(np.isfinite(getattr(cleaned, name)).all() for name in ATTRIBUTES)
    np.testing.assert_allclose(np.linalg.norm(cleaned.quats.astype(np.float64), axis=1), 1, atol=1.1e-6)
    assert np.abs(cleaned.means).max(initial=0) <= MEAN_LIMIT
    assert np.abs(cleaned.scales).max(initial=0) <= LOG_SCALE_LIMIT
    assert max(np.abs(cleaned.sh0).max(initial=0), np.abs(cleaned.shN).max(initial=0)) <= SH_LIMIT
    assert cleaned.opacities.max(initial=0) <= OPACITY_LOGIT_MAX
    assert cleaned.opacities.min(initial=0) >= OPACITY_LOGIT_MIN
    again, nothing = clean(cleaned)
    assert nothing == Cleaned()
    assert all((getattr(again, name) == getattr(cleaned, name)).all() for name in ATTRIBUTES)


def directions(count=200, seed=0):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    found[:6] = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_arrays_agree_with_scipy_to_degree_3_and_the_kernel_to_degree_6():
    points = directions()
    for degree in range(7):
        wanted = real_harmonics(points, degree)
        if degree <= 3:
            np.testing.assert_allclose(sh_basis(points, degree), wanted, atol=1e-13)
        found = np.zeros((len(points), wanted.shape[1] - 1))
        for (x, y, z), row in zip(points, found, strict=True):
            write_harmonics(x, y, z, degree, row)
        np.testing.assert_allclose(found, wanted[:, 1:], atol=1e-13)
