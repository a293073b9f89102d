"""Oracle: the rotations that the levels decode to, by the rule of the format written out."""

import numpy as np
import pytest
from helpers.codec_scenes import unit

from kissgs.planning import rotation_forms
from kissgs.planning.rotation_forms import apply_forms, canonical_forms


def angles(p, q):
    return 2 * np.arccos(np.clip(np.abs((p * q).sum(axis=1)), 0, 1))


@pytest.fixture
def quats():
    random = unit(np.random.default_rng(2).normal(size=(500, 4))).astype(np.float64)
    half = np.sqrt(0.5)
    corners = [[half, half, 0, 0], [0.5, 0.5, 0.5, 0.5], [0, 0, 0, -1], [-half, 0, 0, half], [1, 0, 0, 0]]
    return np.concatenate([random, np.array(corners)])


def test_decoded_rotations_are_near_and_of_length_one(quats):
    omitted = rotation_forms.omitted_components(quats)
    signed = rotation_forms.with_sign(quats, omitted)
    levels = rotation_forms.lattice_levels(rotation_forms.stored_components(signed, omitted), 1)
    found = rotation_forms.whole(rotation_forms.TABLE[levels], omitted)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert np.degrees(angles(found, quats)).max() < 2
    missing = np.take_along_axis(found, omitted[:, None].astype(np.int64), axis=1)
    assert (missing >= 0).all()
    assert (np.abs(found[:, 1:]) <= np.sqrt(0.5) + 1e-12)[omitted == 0].all()


def test_coarse_levels_are_multiples_and_exist(quats):
    omitted = rotation_forms.omitted_components(quats)
    small = rotation_forms.stored_components(rotation_forms.with_sign(quats, omitted), omitted)
    levels = rotation_forms.lattice_levels(small, np.full(len(quats), 16)).astype(np.int64)
    assert rotation_forms.fits(levels).all()
    assert ((levels - 127) % 16 == 0).mean() > 0.9


def test_canonical_forms_leave_out_w(quats):
    forms = canonical_forms(quats)
    turned, _ = apply_forms(quats, np.zeros((len(quats), 3), np.float32), forms)
    assert (rotation_forms.omitted_components(turned) == 0).all()
    assert (turned[:, 0] > 0.85).all()
