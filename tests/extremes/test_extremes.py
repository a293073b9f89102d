"""Oracle: the steps that the report states, and reference_decoder; for numbers at the edge."""

import collections

import numpy as np
import pytest
from helpers import reference_decoder
from helpers.codec_scenes import GLANCE, assert_round_trip, assert_within, random_scene, replaced
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as stnp

from kissgs import Settings, Splats, clean, compress, decompress
from kissgs.core.splats import ATTRIBUTES, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN, SH_REST_COUNTS, Cleaned


def check(splats, preset="fast", **changes):
    """Assert a finite result within the errors that the report states; return the decoded scene and the result."""
    result = compress(splats, settings=Settings.research(preset, **{"sh_tolerance": 0, **GLANCE, **changes}))
    found = decompress(result.files)
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
    reference_decoder.assert_equal_scenes(found, reference_decoder.decode(result.files), result.files)
    reference_decoder.check_browser(result.files)
    assert_round_trip(clean(splats)[0], result)
    assert result.report.form_error < 1e-6
    return found, result


def assert_sh_within(found, cleaned, result):
    """Check shN of fewer Gaussians than codebook entries; all channels have one lattice, also constant ones."""
    assert_within(found.shN, cleaned.shN[result.order], max(result.report.max_quantization_error["f_rest_centroids"]))


CLEANED = [
    *((name, np.nan, "non_finite") for name in ATTRIBUTES),
    *((name, sign * np.inf, "non_finite") for name in ("means", "quats", "sh0", "shN") for sign in (1, -1)),
    *(("means", value, "far_away") for value in (1.1e15, -1e20, 3.4e38)),
    *(("opacities", value, "infinite_opacities") for value in (np.inf, -np.inf)),
    *(("opacities", value, "saturated_opacities") for value in (1000, -1000, 13.81, -14, 3e38)),
    *(("scales", value, "clamped_scales") for value in (np.inf, -np.inf, 100, -100, 3e38)),
    *((name, value, "clamped_sh") for name in ("sh0", "shN") for value in (1.1e6, -3e38)),
]


def test_one_bad_number_is_mended_or_its_gaussian_left_out():
    """Each is in a Gaussian of its own, after one whose rotation has no length."""
    splats = random_scene(40, 1, seed=11)
    splats.quats[0] = (-0.0, 0, -0.0, 0)
    for row, (attribute, value, _) in enumerate(CLEANED, 1):
        getattr(splats, attribute).reshape(40, -1)[row, 0] = value
    found, result = check(splats)
    counts = collections.Counter(reason for _, _, reason in CLEANED)
    assert result.report.cleaned == Cleaned(zero_quats=1, **counts)
    invisible = sum(attribute == "opacities" and value < -5 for attribute, value, _ in CLEANED)
    assert result.report.invisible == invisible
    assert len(found) == result.report.count == 40 - counts["non_finite"] - counts["far_away"] - invisible
    assert (clean(splats)[0].quats[0] == [1, 0, 0, 0]).all()


@pytest.mark.parametrize("length", [1e-45, 1e-20, 1e3, 1e38])
def test_rotations_of_any_length_are_normalised(length):
    """float32 squares of these underflow to 0 or overflow to infinity. Denormal numbers keep few digits."""
    splats = random_scene(30, 0, seed=4)
    scaled = replaced(splats, quats=splats.quats * np.float64(length))
    _, result = check(scaled)
    lengths = np.linalg.norm(clean(scaled)[0].quats.astype(np.float64), axis=1)
    np.testing.assert_allclose(lengths, 1, atol=1e-6)
    assert result.report.cleaned.zero_quats + result.report.cleaned.unnormalised_quats == 30
    if length >= 1e-20:
        np.testing.assert_allclose(clean(scaled)[0].quats, splats.quats, atol=1e-6)


@pytest.mark.parametrize(
    ("attribute", "low", "high", "preset"),
    [
        ("scales", -30, 30, "paper"),
        ("scales", -30, -29.999, "fast"),
        ("opacities", OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX, "paper"),
        ("sh0", -1e5, 1e5, "fast"),
        ("sh0", 1e6 - 0.0625, 1e6, "paper"),
        ("sh0", -1e-45, 1e-45, "fast"),
        ("shN", -1e5, 1e5, "paper"),
        ("shN", 1e6 - 0.0625, 1e6, "fast"),
        ("shN", -1e-20, 1e-20, "paper"),
    ],
)
def test_whole_attributes_at_the_edge(attribute, low, high, preset):
    splats = random_scene(50, 2, seed=5)
    shape = getattr(splats, attribute).shape
    values = np.random.default_rng(0).uniform(low, high, shape).clip(low, high)
    found, result = check(replaced(splats, **{attribute: values}), preset, prune_invisible=False)
    assert len(found) == 50
    assert result.report.cleaned.removed == 0
    if attribute == "shN":
        assert_sh_within(found, clean(replaced(splats, shN=values))[0], result)


@pytest.mark.parametrize(
    ("attribute", "outlier", "preset"),
    [
        ("means", 1e6, "fast"),
        ("means", 1e6, "paper"),
        ("quats", -1, "paper"),
        ("scales", 12, "fast"),
        ("opacities", 13.8, "paper"),
        ("sh0", 500, "fast"),
        ("shN", 500, "fast"),
    ],
)
def test_one_outlier_among_thousands(attribute, outlier, preset):
    """It stretches the range of its channel for all: the report must say by how much. Positions suffer little."""
    count = 3000 if preset == "fast" else 400
    splats = random_scene(count, 1, seed=8)
    array = getattr(splats, attribute).copy()
    array.reshape(count, -1)[17, 0] = outlier
    found, result = check(replaced(splats, **{attribute: array}), preset)
    assert len(found) == count
    half = result.report.max_quantization_error
    assert max(half["means"]) < 1e-3
    assert max(half["f_dc"]) < (1.1 if attribute == "sh0" else 0.03)


@pytest.mark.parametrize(("degree", "preset"), [(0, "fast"), (3, "balanced"), (3, "paper")])
def test_scenes_of_which_nothing_is_left(degree, preset):
    """A labels lookup without any entry once raised IndexError; a neutral Gaussian lends the padding its values."""
    nothing = replaced(random_scene(5, degree), means=np.full((5, 3), np.nan))
    faint = replaced(random_scene(5, degree), opacities=np.full(5, -9))
    for splats, removed, invisible in ((nothing, 5, 0), (nothing.select(slice(0, 0)), 0, 0), (faint, 0, 5)):
        found, result = check(splats, preset, prune_invisible=True)
        assert (len(found), found.sh_degree) == (0, degree)
        assert (result.report.cleaned, result.report.invisible) == (Cleaned(non_finite=removed), invisible)


def arrays(*shape):
    """Any float32 numbers at all, many of them alike."""
    return stnp.arrays(np.float32, shape, elements=st.floats(width=32), fill=st.floats(width=32))


@st.composite
def any_scene(draw):
    count, coefficients = draw(st.integers(0, 6)), draw(st.sampled_from(SH_REST_COUNTS))
    return Splats(
        means=draw(arrays(count, 3)),
        quats=draw(arrays(count, 4)),
        scales=draw(arrays(count, 3)),
        opacities=draw(arrays(count)),
        sh0=draw(arrays(count, 3)),
        shN=draw(arrays(count, coefficients, 3)),
    )


@examples(60)
@given(any_scene(), st.booleans())
def test_any_numbers_at_all(splats, prune_invisible):
    found, result = check(splats, prune_invisible=prune_invisible)
    assert found.sh_degree == splats.sh_degree
    assert len(found) + result.report.invisible + result.report.cleaned.removed == len(splats)
    assert_sh_within(found, clean(splats)[0], result)


STRANGE = {
    "sizes over sixty orders of e": lambda s, rng: {"scales": rng.uniform(-30, 30, s.scales.shape)},
    "positions from 1e-6 to 1e14": lambda s, rng: {"means": s.means * 10 ** rng.uniform(-6, 14, (len(s), 1))},
    "a scene of a micrometre": lambda s, rng: {"means": s.means * 1e-6, "scales": s.scales - 20},
    "opaque or invisible": lambda s, rng: {"opacities": np.where(rng.random(len(s)) < 0.5, np.inf, -np.inf)},
    "colours of a million": lambda s, rng: {"sh0": s.sh0 * 1e6, "shN": s.shN * 1e6},
    "needles": lambda s, rng: {"scales": np.array([-30, 5, 0]) + 0 * s.scales},
    "all on a line": lambda s, rng: {"means": s.means * [1, 0, 0] + 7},
    "all in a point": lambda s, rng: {"means": 0 * s.means + 3},
}


@pytest.mark.parametrize("kind", STRANGE)
@pytest.mark.parametrize(("count", "preset"), [(1, "balanced"), (9, "balanced"), (200, "balanced")])
@pytest.mark.quick(6)
def test_strange_scenes_with_rate_distortion(kind, count, preset):
    splats = random_scene(count, 1, seed=count)
    splats = replaced(splats, **STRANGE[kind](splats, np.random.default_rng(count)))
    found, result = check(splats, preset, sensitivity_views=4, sensitivity_view_size=48)
    assert len(found) == result.report.count
