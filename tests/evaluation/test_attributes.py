"""Errors of stored values. Oracle: known perturbations, SciPy's octahedral group, loops over single Gaussians."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import SH_C0
from kissgs.evaluation import attributes
from kissgs.evaluation.attributes import attribute_errors
from kissgs.synthetic.scene import sample_scene

OCTAHEDRAL = Rotation.create_group("O")
seeds = st.integers(0, 2**32)


def test_equal_scenes_have_no_errors():
    scene = sample_scene(300)
    errors = attribute_errors(scene, scene)
    assert errors.gaussians == 300
    for name in ("means", "means_relative", "scales", "opacity_logits", "opacities", "sh0", "sh0_levels"):
        assert getattr(errors, name).max == 0
    assert errors.rotation_degrees.max < 1e-5
    assert errors.covariance_relative_max == 0
    assert errors.shN.rmse == 0
    assert [band.energy_kept for band in errors.bands] == [1, 1, 1]


@examples(30)
@given(seed=seeds)
def test_equivalent_forms_have_no_errors(seed):
    scene = sample_scene(60, sh_degree=0, seed=seed)
    errors = attribute_errors(scene, in_other_forms(scene, np.random.default_rng(seed)))
    assert errors.rotation_degrees.max < 1e-4
    assert errors.scales.max == 0
    assert errors.covariance_relative_max < 1e-5


@examples(30)
@given(seed=seeds, degrees=st.floats(0.01, 15))
def test_a_known_rotation_is_measured_in_any_form(seed, degrees):
    rng = np.random.default_rng(seed)
    scene = sample_scene(60, sh_degree=0, seed=seed)
    # Three clearly different axes: otherwise exchanging two may be the smaller error.
    scene = replace(scene, scales=rng.permuted(np.tile(np.float32([-6, -4, -2]), (60, 1)), axis=1))
    axes = rng.normal(size=(60, 3))
    rotation = Rotation.from_rotvec(np.radians(degrees) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    errors = attribute_errors(scene, in_other_forms(with_rotations(scene, rotation * rotations(scene)), rng))
    assert errors.rotation_degrees.rmse == pytest.approx(degrees, abs=1e-4)
    assert errors.rotation_degrees.max == pytest.approx(degrees, abs=1e-4)
    assert errors.scales.max == 0


@examples(20)
@given(seed=seeds)
def test_the_nearest_form_equals_an_exhaustive_search(seed):
    rng = np.random.default_rng(seed)
    reference, candidate = sample_scene(12, sh_degree=0, seed=seed), sample_scene(12, sh_degree=0, seed=seed + 1)
    candidate = replace(candidate, scales=(reference.scales + rng.normal(0, 1, (12, 3))).astype(np.float32))
    angles, differences = [], []
    for row in range(12):
        original, changed = rotations(reference)[row], rotations(candidate)[row]
        forms = []
        for form in OCTAHEDRAL:
            permutation = np.abs(form.as_matrix()).argmax(axis=0)
            angle = ((changed * form).inv() * original).magnitude()
            difference = candidate.scales[row, permutation].astype(float) - reference.scales[row]
            forms.append((angle**2 + (difference**2).sum(), angle, difference))
        _, angle, difference = min(forms, key=lambda form: form[0])
        angles.append(angle)
        differences.append(difference)
    errors = attribute_errors(reference, candidate)
    assert errors.rotation_degrees.rmse == pytest.approx(np.degrees(np.sqrt(np.mean(np.square(angles)))), rel=1e-6)
    assert errors.rotation_degrees.max == pytest.approx(np.degrees(max(angles)), rel=1e-6)
    assert errors.scales.rmse == pytest.approx(np.sqrt(np.mean(np.square(differences))), rel=1e-9)


@examples(20)
@given(seed=seeds)
def test_covariance_errors_equal_those_of_the_matrices(seed):
    reference, candidate = sample_scene(15, sh_degree=0, seed=seed), sample_scene(15, sh_degree=0, seed=seed + 1)
    relative = []
    for row in range(15):
        original, changed = covariance(reference, row), covariance(candidate, row)
        relative.append(np.linalg.norm(changed - original) / np.linalg.norm(original))
    errors = attribute_errors(reference, candidate)
    assert errors.covariance_relative_median == pytest.approx(np.median(relative), rel=1e-6)
    assert errors.covariance_relative_max == pytest.approx(max(relative), rel=1e-6)


def test_errors_are_in_the_documented_units():
    def with_one_changed(array, index, value):
        changed = array.copy()
        changed[index] += value
        return changed

    scene = sample_scene(4, sh_degree=0)
    reference = replace(
        scene, means=np.full_like(scene.means, 3), opacities=np.zeros(4, np.float32), sh0=np.zeros_like(scene.sh0)
    )
    candidate = replace(
        reference,
        means=with_one_changed(reference.means, (2, 1), 0.5),
        scales=reference.scales + np.float32(0.25),
        opacities=with_one_changed(reference.opacities, 3, np.log(3)),
        sh0=with_one_changed(reference.sh0, (0, 2), 0.1),
    )
    errors = attribute_errors(reference, candidate)
    assert (errors.means.rmse, errors.means.max) == pytest.approx((0.5 / np.sqrt(12), 0.5))
    assert (errors.means_relative.rmse, errors.means_relative.max) == pytest.approx((0.125 / np.sqrt(12), 0.125))
    assert (errors.opacity_logits.rmse, errors.opacity_logits.max) == pytest.approx((np.log(3) / 2, np.log(3)))
    assert (errors.opacities.rmse, errors.opacities.max) == pytest.approx((0.125, 0.25))
    assert (errors.sh0.rmse, errors.sh0.max) == pytest.approx((0.1 / np.sqrt(12), 0.1))
    assert errors.sh0_levels.max == pytest.approx(25.5 * SH_C0)
    assert (errors.scales.rmse, errors.scales.max) == pytest.approx((0.25, 0.25), rel=1e-5)
    assert errors.covariance_relative_median == pytest.approx(np.exp(0.5) - 1, rel=1e-5)
    assert errors.rotation_degrees.max < 1e-5


def test_sh_energy_is_reported_per_band():
    scene = sample_scene(200)
    shN = scene.shN.copy()
    shN[:, :3] *= np.float32(0.5)
    shN[:, 8:] = 0
    errors = attribute_errors(scene, replace(scene, shN=shN))
    assert [band.energy_kept for band in errors.bands] == pytest.approx([0.75, 1, 0])
    assert errors.bands[0].signal == pytest.approx(np.sqrt((scene.shN[:, :3].astype(float) ** 2).mean()))
    assert errors.bands[2].rmse == errors.bands[2].signal
    assert errors.shN.rmse == pytest.approx(np.sqrt(((scene.shN - shN).astype(float) ** 2).mean()), rel=1e-6)
    signal = (scene.shN.astype(float) ** 2).sum()
    assert errors.shN.energy_kept == pytest.approx(1 - ((scene.shN - shN).astype(float) ** 2).sum() / signal, rel=1e-6)


def test_missing_bands_of_the_candidate_count_as_zeros():
    scene = sample_scene(50)
    short = attribute_errors(scene, replace(scene, shN=scene.shN[:, :3]))
    padded = np.where(np.arange(15)[:, None] < 3, scene.shN, np.float32(0))
    assert short == attribute_errors(scene, replace(scene, shN=padded))
    assert [band.energy_kept for band in short.bands] == [1, 0, 0]


def test_energy_kept_is_none_for_a_reference_without_sh_energy():
    scene = sample_scene(5, sh_degree=1)
    errors = attribute_errors(replace(scene, shN=np.zeros_like(scene.shN)), scene)
    assert errors.shN.energy_kept is None
    assert errors.shN.rmse > 0


def test_an_empty_scene_has_no_errors():
    errors = attribute_errors(sample_scene(0), sample_scene(0))
    assert (errors.gaussians, errors.means.rmse, errors.rotation_degrees.max, errors.covariance_relative_median) == (
        0,
    ) * 4
    assert errors.shN.energy_kept is None


def test_chunk_size_does_not_change_the_errors(monkeypatch):
    reference, candidate = sample_scene(100, seed=1), sample_scene(100, seed=2)
    whole = attribute_errors(reference, candidate).as_dict()
    monkeypatch.setattr(attributes, "CHUNK", 7)
    parts = attribute_errors(reference, candidate).as_dict()
    assert flatten(parts) == pytest.approx(flatten(whole), rel=1e-9)


def test_errors_are_valid_json():
    errors = attribute_errors(sample_scene(20, seed=1), sample_scene(20, seed=2)).as_dict()
    read = json.loads(json.dumps(errors, allow_nan=False))
    assert read["means"] == errors["means"]
    assert len(read["bands"]) == 3


def test_incomparable_scenes_are_rejected():
    with pytest.raises(InvalidSceneError, match="4 and 3 Gaussians"):
        attribute_errors(sample_scene(4), sample_scene(3))
    with pytest.raises(InvalidSceneError, match="SH degree, 2, is above the reference's, 1"):
        attribute_errors(sample_scene(4, sh_degree=1), sample_scene(4, sh_degree=2))


def rotations(splats):
    return Rotation.from_quat(splats.quats, scalar_first=True)


def with_rotations(splats, rotations):
    return replace(splats, quats=rotations.as_quat(scalar_first=True).astype(np.float32))


def in_other_forms(splats, rng):
    """Return the scene with each Gaussian in a random one of its 48 equivalent forms."""
    forms = OCTAHEDRAL[rng.integers(24, size=len(splats))]
    permutation = np.abs(forms.as_matrix()).argmax(axis=1)
    scene = with_rotations(splats, rotations(splats) * forms)
    signs = rng.choice(np.float32([-1, 1]), (len(splats), 1))
    return replace(scene, quats=scene.quats * signs, scales=np.take_along_axis(splats.scales, permutation, axis=1))


def covariance(splats, row):
    axes = rotations(splats)[row].as_matrix() @ np.diag(np.exp(splats.scales[row].astype(float)))
    return axes @ axes.T


def flatten(tree):
    if isinstance(tree, dict):
        tree = list(tree.values())
    return [value for branch in tree for value in flatten(branch)] if isinstance(tree, list | tuple) else [tree]
