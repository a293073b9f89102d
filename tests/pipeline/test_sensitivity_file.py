"""Oracle: what was measured, and whether it was measured again."""

import numpy as np
import pytest
from helpers.captured_scene import cameras

import kissgs
from kissgs import OutputError, Settings
from kissgs.core.sensitivity import Sensitivity
from kissgs.pipeline.encoding import read_sensitivity, write_sensitivity

SCENE = kissgs.sample_scene(300, sh_degree=1, seed=2)
GLANCE = {"sensitivity_views": 4, "sensitivity_view_size": 48}


def compressed(cache, scene=SCENE, preset="balanced", views=None, **settings):
    """The files, and whether the scene was looked at."""
    stages = []
    settings = Settings.research(preset, **{**GLANCE, **settings})
    found = kissgs.compress(
        scene, settings=settings, cache=cache, views=views, progress=lambda stage, fraction: stages.append(stage)
    )
    return found.files, "sensitivity" in stages


def test_it_is_measured_once(tmp_path):
    file = tmp_path / "scene.sensitivity.npz"
    first, measured = compressed(file)
    assert measured
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.sensitivity.npz"]
    again, measured = compressed(file)
    assert not measured
    assert again == first == compressed(None)[0]
    assert not compressed(file, quality_offset_db=-1.0)[1]


@pytest.mark.parametrize("change", ["scene", "cameras", "view_uncertainty", "capture"])
@pytest.mark.quick(1)
def test_it_is_measured_anew_when_anything_has_changed(tmp_path, change):
    file = tmp_path / "a.npz"
    compressed(file)
    moved = SCENE.select(np.arange(299))
    cases = {
        "scene": {"scene": moved},
        "cameras": {"sensitivity_view_size": 60},
        "view_uncertainty": {"view_uncertainty": 0.3},
        "capture": {"views": cameras()},
    }
    options = cases[change]
    files, measured = compressed(file, **options)
    assert measured
    assert files == compressed(None, **options)[0]
    assert not compressed(file, **options)[1]


def test_other_files_are_not_written_over(tmp_path):
    file = tmp_path / "a.npz"
    np.savez(file, weights=np.ones(3))
    for content in (file.read_bytes(), b"", b"a scene", b"PK\x03\x04 broken"):
        file.write_bytes(content)
        with pytest.raises(OutputError, match="is not a sensitivity file of kissgs; move it away"):
            read_sensitivity(file, "key")
    with pytest.raises(OutputError, match="is not a sensitivity file of kissgs; move it away"):
        compressed(file)
    assert file.read_bytes() == content


def test_it_survives(tmp_path):
    rng = np.random.default_rng(0)
    kept = Sensitivity.none(5, 2, captured=True)
    for name in Sensitivity.__slots__:
        if name != "view_uncertainty":
            values = getattr(kept, name)
            values[:] = rng.random(values.shape)
    write_sensitivity(tmp_path / "a.npz", kept, "key")
    found = read_sensitivity(tmp_path / "a.npz", "key")
    assert all(np.array_equal(getattr(found, name), getattr(kept, name)) for name in Sensitivity.__slots__)
    assert read_sensitivity(tmp_path / "a.npz", "another") is None
    assert read_sensitivity(tmp_path / "b.npz", "key") is None
