"""No visible part of a scene is lost: random cameras everywhere; oracle: ``fast``, which measures no sensitivity."""

import numpy as np
import pytest
from helpers.whole_scenes import SCENES, cameras, joined, moved, psnrs, two

from kissgs import Settings, clean, compress, decompress, evaluate, sample_scene

VIEWS = 6
"""Number of views of each kind."""


def kept(scene, preset, **settings):
    return decompress(compress(scene, settings=Settings.research(preset, **settings)).to_zip())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.quick(1)
def test_no_view_is_much_worse_than_with_uniform_steps(name):
    """One view in 24 may be worse: if two large Gaussians have nearly equal depth, rounding may swap their order."""
    scene = clean(SCENES[name]())[0]
    views = [camera for kind in cameras(scene, count=VIEWS).values() for camera in kind]
    fast = psnrs(scene, kept(scene, "fast"), views)
    balanced = psnrs(scene, kept(scene, "balanced"), views)
    short = (balanced < np.minimum(38, fast - 3)).any(axis=1)
    assert short.sum() <= 1, (balanced[short], fast[short])


@pytest.mark.quick(0)
def test_most_of_two_distant_objects_is_kept():
    compressed = compress(clean(two(1000))[0])
    places = decompress(compressed.to_zip()).means[:, 0]
    assert (places < 500).sum() > 5000
    assert (places > 500).sum() > 5000
    assert compressed.report.pruned_by_rd < 0.2 * len(places)
    assert "positions have steps" in compressed.report.note


@pytest.mark.quick(0)
def test_half_of_two_objects_is_half_of_each():
    scene = clean(two(1000))[0]
    from kissgs import compact

    settings = Settings.from_preset("fast", compact={"ratio": 0.5})
    places = compact(scene, settings=settings).splats.means[:, 0]
    share = float((places > 500).mean())
    assert 0.4 < share < 0.6


def test_evaluation_finds_an_object_that_is_gone():
    scene = clean(joined(sample_scene(3000), moved(sample_scene(3000, seed=1), by=(1000, 0, 0))))[0]
    gone = scene.select(np.flatnonzero(scene.means[:, 0] < 500))
    found = evaluate(scene, gone)
    assert found.worst.comparison.candidate_vs_reference.psnr < 20
    assert found.fifth_percentile < 20
