"""Oracle: the naive writer (helpers/reference_compressed_ply.py)."""

import io

import numpy as np
import pytest
from helpers.format_scenes import assert_alike, made_scene
from helpers.reference_compressed_ply import SH_C0, compressed_bytes

from kissgs.core.splats import ATTRIBUTES, clean
from kissgs.io.conventions import morton_order
from kissgs.io.ply import read_ply, write_compressed


def written(splats):
    """Return a file of the scene once it is cleaned, and the notes."""
    file = io.BytesIO()
    notes = write_compressed(file, clean(splats)[0])
    return file.getvalue(), notes


def dicts(splats):
    """Return the Gaussians as the naive writer takes them."""
    rest = splats.shN.transpose(0, 2, 1).reshape(len(splats), 3 * splats.shN.shape[1])
    return [
        {
            "position": splats.means[i].tolist(),
            "quat": splats.quats[i].tolist(),
            "log_scale": np.clip(splats.scales[i], -20, 20).tolist(),
            "rgb": [0.5 + SH_C0 * float(v) for v in splats.sh0[i]],
            "opacity": float(1 / (1 + np.exp(-splats.opacities[i].astype(float)))),
            "rest": rest[i].tolist(),
        }
        for i in range(len(splats))
    ]


@pytest.mark.parametrize(("count", "degree"), [(0, 2), (1, 0), (256, 1), (257, 2), (700, 3)])
def test_bytes_are_those_of_the_reference(count, degree):
    """A few steps differ by one where a half is rounded, or a colour's bound is rounded to a float."""
    scene = clean(made_scene(count, degree))[0]
    scene = scene.select(morton_order(scene.means))
    data = written(scene)[0]
    wanted = compressed_bytes(dicts(scene), 3 * scene.shN.shape[1])
    assert len(data) == len(wanted)
    head = data.index(b"end_header\n") + 11
    assert data[:head] == wanted[:head]
    body = slice(head + 72 * -(-count // 256), None)
    same = np.frombuffer(data[body], np.uint8) == np.frombuffer(wanted[body], np.uint8)
    assert count == 0 or same.mean() > 0.99
    assert_alike(*map(read_ply, (data, wanted)), atol=0.02 if count else 0, rtol=1e-3, opacities=20)


def test_chunks_are_close_together():
    """Random order would give steps of the whole scene; an outlier must not coarsen the order of the others."""
    scene = made_scene(20_000, 0, extremes=False)
    scene.means[7] = 1e12
    order = morton_order(scene.means)
    assert sorted(order.tolist()) == list(range(20_000))
    edges = [np.ptp(scene.means[order[start : start + 256]], axis=0).mean() for start in range(0, 19_000, 256)]
    assert np.median(edges) < 0.25 * np.ptp(np.delete(scene.means, 7, axis=0), axis=0).mean()


def test_equal_places_keep_their_order():
    np.testing.assert_array_equal(morton_order(np.ones((9, 3), np.float32)), np.arange(9))
    assert len(morton_order(np.empty((0, 3), np.float32))) == 0


def test_what_the_format_cannot_hold_is_in_the_notes():
    scene = clean(made_scene(20, 1, extremes=False))[0]
    assert written(scene)[1] == ()
    scene.scales[0] = 25
    scene.shN[3:5] = -5
    assert written(scene)[1] == (
        "scales of 1 Gaussian are clamped to e^±20",
        "view-dependent colours of 2 Gaussians are clamped to coefficients of ±4",
    )


def test_extreme_values():
    scene = made_scene(300, 1)
    scene.means[:4] = [[1e15, -1e15, 1e-40], [np.inf, 0, 0], [0, np.nan, 0], [0, 0, 0]]
    scene.scales[5] = [-np.inf, 30, -30]
    scene.sh0[6] = 1e6
    scene.opacities[:2] = [-np.inf, np.inf]
    found = clean(read_ply(written(scene)[0]))[0]
    assert len(found) == 298
    assert all(np.isfinite(getattr(found, name)).all() for name in ATTRIBUTES)
    assert found.means.max() == np.float32(1e15)
