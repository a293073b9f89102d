"""Pruning by score (see tests/rendering), and comparisons of a search. Oracles: sorted scores, pairs of copies of
which one is superfluous, ``compare_images``."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.training_scenes import around, cloud
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs.cameras.views import Views, black
from kissgs.cameras.virtual.samples import random_poses
from kissgs.compaction.scoring import highest_indices, prune_by_score
from kissgs.compaction.search_evaluation import COUNT, SearchEvaluation
from kissgs.core.context import Context
from kissgs.core.splats import ATTRIBUTES, SH_C0
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import SEARCH_SEED
from kissgs.rendering.rasterizer import removal_scores
from kissgs.rendering.sensitivity import Coverage

VIEWS = around()
CAMERAS = [view.camera for view in VIEWS]


@given(st.lists(st.sampled_from([0.0, 1.0, 2.5, 7.0]), max_size=12), st.integers(0, 14))
def test_the_highest_scores_are_selected_and_of_equal_ones_the_first(scores, count):
    selected = highest_indices(np.array(scores), count).tolist()
    best = sorted(range(len(scores)), key=lambda n: (-scores[n], n))[:count]
    assert selected == sorted(best)


def test_one_round_keeps_the_highest_scores():
    scene = cloud(80)
    scores = removal_scores(scene, CAMERAS)
    assert prune_by_score(scene, VIEWS, black(), 20).tolist() == sorted(np.argsort(-scores)[:20].tolist())


@pytest.mark.parametrize("min_score", [0.3, 10.0])
def test_no_score_is_below_a_share_of_that_of_a_camera_nearby(min_score):
    """The unit is the median ratio of score to close-up coverage over the Gaussians that were seen."""
    scene = cloud(80)
    hidden = np.arange(80) % 4 == 0
    scene = replace(scene, means=np.where(hidden[:, None], scene.means + np.float32(500), scene.means))
    scores, close_up = removal_scores(scene, CAMERAS), Coverage(scene).close_up
    assert (scores[hidden] == 0).all()
    unit = np.median((scores / close_up)[scores > 0])
    raised = np.maximum(scores, min_score * unit * close_up)
    kept = prune_by_score(scene, VIEWS, black(), 20, min_score=min_score)
    assert kept.tolist() == sorted(np.argsort(-raised)[:20].tolist())
    assert not hidden[prune_by_score(scene, VIEWS, black(), 20)].any()
    assert hidden[kept].any()


@pytest.mark.parametrize("min_keep", [0.0, 0.8])
@pytest.mark.parametrize("count", [1, 79])
def test_any_number_of_rounds_keeps_exactly_the_requested_count(min_keep, count):
    kept = prune_by_score(cloud(80), VIEWS, black(), count, min_keep_per_scoring=min_keep)
    assert len(kept) == count
    assert (np.diff(kept) > 0).all()


def test_rounds_do_not_remove_both_copies_of_a_pair():
    """Two opaque copies at each position: each is superfluous while the other is there."""
    scene = cloud(20, 0, seed=3)
    opaque = {**{name: getattr(scene, name) for name in ATTRIBUTES}, "opacities": np.full(20, 5, np.float32)}
    pairs = kissgs.Splats(**{name: np.concatenate([value, value]) for name, value in opaque.items()})

    def positions_left(min_keep):
        return len(set((prune_by_score(pairs, VIEWS, black(), 20, min_keep_per_scoring=min_keep) % 20).tolist()))

    assert positions_left(0.99) > positions_left(0.0) + 1


def test_each_view_has_a_background_of_its_own():
    """Black Gaussians show on white but not on black."""
    scene = cloud(80, 0)
    dark = np.arange(80) % 2 == 0
    colours = np.where(dark[:, None], np.float32(-0.5 / SH_C0), np.full((80, 3), 0.1, np.float32))
    scene = replace(scene, sh0=colours, opacities=np.full(80, 3, np.float32))
    mixed = [replace(view, background=np.full(3, n % 2, np.float32)) for n, view in enumerate(VIEWS)]

    def dark_count(views):
        return int(dark[prune_by_score(scene, views, black(), 40)].sum())

    assert dark_count(VIEWS) + 4 < dark_count(mixed)
    split = (removal_scores(scene, [v.camera for v in mixed[n::2]], background=(n, n, n)) for n in (0, 1))
    assert prune_by_score(scene, mixed, black(), 40).tolist() == sorted(np.argsort(-sum(split))[:40].tolist())


def test_images_of_any_size_have_the_same_weight():
    """Scores are mean squared errors: an image of four times the pixels has no more weight."""
    scene = cloud(80)
    small = [replace(view, camera=view.camera.at_most(16)) for view in VIEWS[1:]]
    cameras = [CAMERAS[0], *(view.camera for view in small)]
    means = [removal_scores(scene, [camera]) / (3 * camera.width * camera.height) for camera in cameras]
    kept = prune_by_score(scene, [VIEWS[0], *small], black(), 20).tolist()
    assert kept == sorted(np.argsort(-sum(means), kind="stable")[:20].tolist())
    sums = sum(removal_scores(scene, [camera]) for camera in cameras)
    assert kept != sorted(np.argsort(-sums, kind="stable")[:20].tolist())


@pytest.mark.parametrize(("min_keep", "scorings"), [(0.0, 1), (0.25, 1), (0.5, 2), (0.99, 138)])
def test_the_number_of_scorings_is_the_smallest_possible(min_keep, scorings):
    """Pruning goes from 80 Gaussians to 20, a quarter."""
    events = []

    def progress(stage, fraction, note=""):
        events.append(fraction)

    prune_by_score(cloud(80), VIEWS[:1], black(), 20, Context(progress=progress), min_keep_per_scoring=min_keep)
    found = (len(events) - 1) / 2  # each scoring reports its beginning and its end
    assert found == scorings if scorings < 5 else 55 < found <= scorings, "60 removals, one or more per scoring"
    assert events == sorted(events)
    assert events[-1] == 1.0


SCENE = kissgs.sample_scene(400, sh_degree=1, seed=3)
WORSE = replace(SCENE, opacities=SCENE.opacities - 0.5)


@pytest.mark.quick(0)
def test_without_a_capture_poses_of_photographs_and_cameras_over_the_whole_scene_compare():
    compare = SearchEvaluation(SCENE, None)
    assert compare.seconds == 0
    found = compare(WORSE)
    assert compare.seconds > 0
    assert COUNT <= len(found.views) <= 4 * COUNT  # more for a scene of several objects
    assert found.against == "renderings"
    poses = {view.view.camera.viewmat.tobytes() for view in found.views}
    trained = random_poses(SCENE, side=64, count=COUNT)
    assert not poses & {view.camera.viewmat.tobytes() for view in (*trained.train, *trained.test)}
    drawn = evaluation_views(SCENE, seed=SEARCH_SEED)
    expected = compare_images(SCENE, WORSE, drawn)
    assert found.surroundings.as_dict() == expected.as_dict()
    assert {view.view.background[0] for view in found.views} == {0.0, 0.5, 1.0}
    again = compare_images(SCENE, WORSE, Views((), tuple(view.view for view in found.views), found.background, ""))
    assert again.mean == found.mean


def test_held_out_views_may_have_equal_names():
    scene = cloud(50)
    views = Views(around(3), tuple(replace(view, name="x") for view in around(3)), black(), "")
    compare = SearchEvaluation(scene, views)
    for candidate in (scene, scene):
        assert compare(candidate).mean.candidate_vs_reference.psnr == float("inf")


def test_a_capture_compares_in_its_held_out_views():
    scene = cloud(50)
    views = Views(around(3), around(2), black(), "")
    found = SearchEvaluation(scene, views)(scene)
    assert [view.view.name for view in found.views] == [view.name for view in views.test]
    assert found.surroundings is None


@pytest.mark.parametrize("count", [1, 7])
def test_few_gaussians_are_compared(count):
    few = SCENE.select(range(count))
    found = SearchEvaluation(few, None)(few)
    assert found.views
    assert found.surroundings.views
