"""Oracle: what the docstrings promise, measured with SciPy's rotations, spherical harmonics and nearest neighbours."""

import numpy as np
import pytest
from helpers.examples import examples
from helpers.reference_harmonics import real_harmonics
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, clean
from kissgs.synthetic import BALL_CENTRE, BALL_RADIUS, SUN, SURFACES, sample_scene


@pytest.fixture(scope="module")
def scene():
    return sample_scene(20_000)


@examples(30)
@given(count=st.integers(0, 400), sh_degree=st.integers(0, 3), seed=st.integers(0, 2**64))
def test_every_scene_is_canonical_and_of_the_size_asked_for(count, sh_degree, seed):
    splats = sample_scene(count, sh_degree=sh_degree, seed=seed)
    assert len(splats) == count
    assert splats.sh_degree == sh_degree
    cleaned, report = clean(splats)
    assert not any(report.as_dict().values())
    assert all(getattr(cleaned, name) is getattr(splats, name) for name in ATTRIBUTES if name != "opacities")
    assert (cleaned.opacities == splats.opacities).all()


def test_equal_seeds_give_equal_scenes_and_others_do_not():
    first, again, other = (sample_scene(500, seed=seed) for seed in (7, 7, 8))
    for name in ATTRIBUTES:
        assert (getattr(first, name) == getattr(again, name)).all()
        assert (getattr(first, name) != getattr(other, name)).any()


def test_the_degree_only_cuts_the_sh(scene):
    for degree, k in enumerate(SH_REST_COUNTS):
        lower = sample_scene(len(scene), sh_degree=degree)
        assert (lower.shN == scene.shN[:, :k]).all()
        for name in ("means", "quats", "scales", "opacities"):
            assert (getattr(lower, name) == getattr(scene, name)).all()
        np.testing.assert_allclose(lower.sh0, scene.sh0, atol=1e-6)


@pytest.mark.parametrize(("arguments", "found"), [({"count": -1}, "-1"), ({"seed": -2}, "-2"), ({"sh_degree": 4}, "4")])
def test_impossible_scenes_are_refused(arguments, found):
    with pytest.raises(UnsupportedError, match=found):
        sample_scene(**{"count": 10} | arguments)


def test_opacities_are_those_of_a_trained_scene(scene):
    opacities = 1 / (1 + np.exp(-scene.opacities.astype(float)))
    assert 0.002 < (opacities < 1 / 255).mean() < 0.03
    assert 0.02 < (opacities < 0.02).mean() < 0.1
    assert (opacities > 0.9).mean() > 0.35
    assert ((opacities > 0.1) & (opacities < 0.6)).mean() > 0.15


def test_sh_are_those_of_a_trained_scene(scene):
    bands = [scene.shN[:, first:end] for first, end in ((0, 3), (3, 8), (8, 15))]
    assert all(0.02 < band.std() < 0.08 for band in bands)
    assert bands[0].std() > bands[1].std() > bands[2].std()
    assert np.corrcoef(scene.shN.reshape(-1, 3).T)[0, 1] > 0.6
    assert (scene.shN**4).mean() > 6 * (scene.shN**2).mean() ** 2, "tails like a normal distribution's, or lighter"


def test_rotations_come_in_mixed_forms(scene):
    thin = np.bincount(scene.scales.argmin(axis=1), minlength=3) / len(scene)
    assert (thin > 0.25).all()
    assert 0.4 < (scene.quats[:, 0] > 0).mean() < 0.6


def test_discs_lie_flat_on_the_table(scene):
    order = np.sort(scene.scales, axis=1)
    flat = order[:, 1] - order[:, 0] > 1
    x, y, z = scene.means.T
    # Around the middle, away from the three objects; floaters keep off the ground.
    on_table = flat & (np.abs(y) < 0.03) & (np.hypot(x, z) > 2.5) & (np.hypot(x, z) < 5)
    assert on_table.sum() > 1000
    axes = Rotation.from_quat(scene.quats[on_table], scalar_first=True).as_matrix()
    thin = axes[np.arange(len(axes)), :, scene.scales[on_table].argmin(axis=1)]
    assert (np.abs(thin[:, 1]) > 0.99).mean() > 0.99


def test_surfaces_have_no_holes(scene):
    rng = np.random.default_rng(0)
    for surface in SURFACES[:4]:
        points = surface.shape(rng.random((2000, 2), np.float32))[0]
        distance, nearest = cKDTree(scene.means).query(points)
        assert np.quantile(distance / np.exp(scene.scales[nearest].max(axis=1)), 0.99) < 2.5


def test_the_ball_shines_where_the_sun_is_mirrored():
    """End to end through the sign convention: real harmonics as 3DGS has them, from SciPy's complex ones."""
    scene = sample_scene(20_000)
    outward = (scene.means - BALL_CENTRE) / BALL_RADIUS
    ball = np.abs(np.linalg.norm(outward, axis=1) - 1) < 0.02
    lit = ball & (outward @ SUN.direction > 0.4)
    normals, sh = outward[lit].astype(float), scene.shN[lit].astype(float)
    glance = (
        SUN.direction - 2 * (normals @ SUN.direction)[:, None] * normals
    )  # from a camera that sees the sun mirrored
    glance /= np.linalg.norm(glance, axis=1, keepdims=True)
    aside = np.cross(glance, normals)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    assert lit.sum() > 100
    shine = np.einsum("nk,nkc->nc", real_harmonics(glance, 3)[:, 1:], sh).mean()
    assert shine > 0.3
    assert shine > 0.3 + np.einsum("nk,nkc->nc", real_harmonics(aside, 3)[:, 1:], sh).mean()
