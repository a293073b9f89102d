"""Oracle: the naive writer (helpers/reference_splat.py)."""

import io

import numpy as np
import pytest
from helpers.format_scenes import made_scene
from helpers.reference_splat import SH_C0, splat_bytes

from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io import splat
from kissgs.io.splat import ROW, read_splat, write_splat


def written(splats):
    """Return a file of the scene once it is cleaned, and the notes."""
    file = io.BytesIO()
    notes = write_splat(file, clean(splats)[0])
    return file.getvalue(), notes


@pytest.mark.parametrize(("count", "degree"), [(0, 0), (1, 0), (65, 1), (600, 3)])
def test_rows_are_those_of_the_reference(count, degree, monkeypatch):
    """Compared as a set: floats differ in their last bit, bytes where a half is rounded."""
    monkeypatch.setattr(splat, "_BLOCK", 100)
    scene = clean(made_scene(count, degree))[0]
    found = np.frombuffer(written(scene)[0], ROW)
    wanted = np.frombuffer(splat_bytes(scene), ROW)
    found, wanted = (rows[np.lexsort(rows["means"].T)] for rows in (found, wanted))
    np.testing.assert_array_equal(found["means"], wanted["means"])
    np.testing.assert_allclose(found["scales"], wanted["scales"], rtol=1e-6)
    for name in ("rgba", "quats"):
        assert np.abs(found[name].astype(int) - wanted[name]).max(initial=0) <= 1
        assert count == 0 or (found[name] == wanted[name]).mean() > 0.99


def test_large_and_opaque_gaussians_come_first():
    scene = clean(made_scene(600, 0, extremes=False))[0]
    scene.opacities[:] = np.linspace(-1, 3, 600)  # where rounding changes little
    found = read_splat(written(scene)[0])
    weight = np.exp(found.scales.sum(axis=1)) / (1 + np.exp(-found.opacities))
    assert (np.diff(weight) <= 0.01 * weight[:-1]).all()
    same = scene.select(np.zeros(300, int))
    same.means[:, 0] = np.arange(300)
    np.testing.assert_array_equal(read_splat(written(same)[0]).means[:, 0], np.arange(300))


def test_what_the_format_cannot_hold_is_in_the_notes():
    scene = clean(made_scene(20, 0, extremes=False))[0]
    scene.sh0[:] = 0.5 / SH_C0
    assert written(scene)[1] == ()
    scene.sh0[:2] = [[1.8, 0, 0], [-1.8, 0, 0]]
    assert written(scene)[1] == ("colours of 2 Gaussians are clamped to 0 to 1",)
    notes = written(made_scene(20, 2, extremes=False))[1]
    assert notes[0] == "view-dependent colour (SH degree 2) is left out"


def test_huge_and_tiny_values_make_no_warning():
    scene = made_scene(6, 0)
    scene.means[:3] = [[1e15, -1e15, 1e-40], [np.inf, 0, 0], [0, np.nan, 0]]
    scene.scales[:] = [[-np.inf, 30, -30], *[[0, 0, 0]] * 4, [30, 30, 30]]
    scene.opacities[:2] = [-np.inf, np.inf]
    found = read_splat(written(scene)[0])
    assert len(found) == 4
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
