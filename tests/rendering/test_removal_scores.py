"""Reference: the scene is rendered without the Gaussian, by the float64 oracle and by the renderer."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import reference_float64
from helpers.render_scenes import blobs, camera, one, together
from scipy.stats import spearmanr

import kissgs
from kissgs.core.context import Context
from kissgs.core.errors import Cancelled
from kissgs.rendering.rasterizer import removal_scores, render


@pytest.mark.parametrize("seed", [0, 3, 5])
def test_scores_agree_with_removal(seed):
    splats, view = blobs(25, seed % 4, seed=seed, log_scale=-2), camera(seed=seed)
    splats = replace(splats, antialiased=seed > 3)
    background = (0.3, 0.6, 0.1)
    whole = reference_float64.draw(reference_float64.tensors(splats), view, background, splats.antialiased)
    expected = reference_float64.removed(whole, len(splats), background)
    scores = removal_scores(splats, [view], background=background)
    np.testing.assert_allclose(scores, expected, rtol=1e-5, atol=2e-6 * expected.max())


@pytest.mark.quick(0)
def test_scores_of_a_real_scene_have_the_ranks_of_removals(shared_data):
    """Each of 60 Gaussians of fox is removed, and two views of the capture are rendered without it."""
    scene = kissgs.load(shared_data / "fox" / "point_cloud.ply")
    views = [view.camera.at_most(240) for view in kissgs.load_views(shared_data / "fox").train[::20]]
    scores = removal_scores(scene, views)
    seen = np.flatnonzero(scores > 1e-9)
    chosen = seen[np.argsort(scores[seen])][np.linspace(0, len(seen) - 1, 60).astype(int)]
    whole = [render(scene, view)[0].astype(np.float64) for view in views]
    expected = []
    for n in chosen:
        without = scene.select(np.delete(np.arange(len(scene)), n))
        expected.append(
            sum(np.square(render(without, view)[0] - image).sum() for view, image in zip(views, whole, strict=True))
        )
    assert spearmanr(scores[chosen], expected).statistic > 0.999


def test_scores_are_sums_over_cameras():
    splats, views = blobs(30, 2), [camera(seed=1), camera(20, 40, seed=2), camera(seed=3)]
    total = sum(removal_scores(splats, [view]) for view in views)
    np.testing.assert_allclose(removal_scores(splats, views), total, rtol=1e-12)


def test_the_score_of_an_invisible_gaussian_is_0():
    behind, faint, shown = one(mean=(0, 0, -50)), one(opacity=-7.0), one()
    scores = removal_scores(together(behind, faint, shown), [camera()])
    assert scores[0] == scores[1] == 0
    assert scores[2] > 0


def test_scores_behind_opaque_gaussians_are_0():
    pile = together(*(one(mean=(0, 0, 0.2 * i), scale=(2, 2, 2), opacity=9.0) for i in range(6)))
    scores = removal_scores(pile, [camera()])
    nearest = int(np.argmax(scores))
    assert nearest == 0
    assert (scores[3:] == 0).all()


def test_scores_do_not_depend_on_threads():
    splats, views = blobs(400, 1, spread=1.5), [camera(90, 60, seed=1), camera(90, 60, seed=2)]
    first = removal_scores(splats, views, Context(1))
    for threads in (2, 5):
        assert np.array_equal(first, removal_scores(splats, views, Context(threads)))


def test_progress_is_reported_and_may_cancel():
    events = []
    context = Context(progress=lambda stage, fraction: events.append((stage, fraction)))
    removal_scores(blobs(3), [camera()] * 4, context)
    assert events == [("score", fraction) for fraction in (0, 0.25, 0.5, 0.75, 1.0)]

    def stop(stage, fraction):
        raise Cancelled("cancelled")

    with pytest.raises(Cancelled):
        removal_scores(blobs(3), [camera()], Context(progress=stop))


def test_no_gaussians_and_no_cameras():
    assert removal_scores(blobs(0), [camera()]).shape == (0,)
    assert (removal_scores(blobs(4), []) == 0).all()
    image, alpha = render(blobs(0), camera(), background=(0.25, 0.5, 0.75))
    assert (image == np.float32([0.25, 0.5, 0.75])).all()
    assert (alpha == 0).all()
