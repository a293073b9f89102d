"""Oracle: the same scenes compared from the same cameras by ``compare_images``, and cameras of other stages."""

from dataclasses import replace

import pytest
from helpers.training_scenes import around, cloud

import kissgs
from kissgs.cameras.views import Views, black
from kissgs.cameras.virtual.samples import random_poses
from kissgs.compaction.search_evaluation import COUNT, SearchEvaluation
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.results import SEARCH_SEED

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
