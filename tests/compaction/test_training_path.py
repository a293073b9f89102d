"""Training path. Oracle: its parts called one by one, and the same work without interruption."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.photographed import photographs
from helpers.training_scenes import around, cloud, same

import kissgs
from kissgs import CompactSettings
from kissgs.cameras.views import black
from kissgs.compaction.popspa import MOST_STEP_PER_SIZE, Popspa, TrainingPath
from kissgs.compaction.scoring import prune_by_score
from kissgs.core.context import Context, Deadline, silent
from kissgs.training.supervision import SupervisionViews

SCENE = cloud(60)
SHORT = {"sparsify_steps": 12, "refine_steps": 6, "prune_rounds": 3, "min_keep_per_scoring": 0.0}


def path(threads=1, progress=silent, **changes):
    views = SupervisionViews(around(5), around(5), around(3), black(), "five views")
    settings = CompactSettings(**{**SHORT, **changes})
    return TrainingPath(Popspa(SCENE, settings, views, Context(threads, progress=progress)))


def test_points_have_falling_numbers_and_know_their_gaussians():
    walked = path()
    walked.prune(40)
    walked.train()
    walked.prune(20)
    walked.train()
    assert [point.number for point in walked.points] == [0, 1, 2]
    assert [len(point) for point in walked.points] == [60, 40, 20]
    assert [point.trained for point in walked.points] == [False, True, True]
    whole, one, two = walked.points
    assert same(whole.splats, SCENE)
    assert set(two.index) < set(one.index) < set(whole.index)
    expected = prune_by_score(SCENE, around(5), black(), 40, min_score=0.3)
    assert np.array_equal(one.index, expected)
    assert not same(one.splats, SCENE.select(one.index))  # it was trained
    moved = np.linalg.norm(two.splats.means - SCENE.means[two.index], axis=1)
    assert moved.max() < 0.2


def test_the_first_step_of_a_position_is_a_share_of_the_size_of_a_small_gaussian():
    """Adam's first step has the length of the learning rate in each axis, halved where renderings are the targets."""
    scales = SCENE.scales.copy()
    scales[::2] = [np.log(0.001), np.log(0.002), -30.0]  # a disc without thickness
    walked = path(sparsify_steps=3)
    walked.compactor = replace(walked.compactor, splats=replace(SCENE, scales=scales))
    walked.points[0] = replace(walked.points[0], splats=walked.compactor.splats)
    point = walked.prune(50)
    assert walked.train().trained
    moved = np.abs(walked.points[-1].splats.means - SCENE.means[point.index]).max(axis=1)
    sizes = np.exp(np.median(walked.compactor.splats.scales[point.index], axis=1))
    small = point.index % 2 == 0
    assert (moved[small] <= 0.5 * MOST_STEP_PER_SIZE * sizes[small] + 1e-6).all()
    assert moved[small].max() > 0.4 * MOST_STEP_PER_SIZE * sizes[small].min()
    assert moved[~small].max() > 2 * moved[small].max()


@pytest.mark.parametrize("deadline", [None, Deadline.after(1e6)])
@pytest.mark.parametrize(
    ("photographed", "sparsify_steps", "expected"),
    [(True, 12, 12), (True, 2, 2), (True, 0, 0), (False, 12, 4), (False, 4, 1), (False, 2, 0)],
)
def test_a_point_is_trained_for_so_many_steps(photographed, sparsify_steps, expected, deadline, tmp_path):
    """Three times as many with photographs as between two of the three prunings, however much time there is."""
    done = []

    def progress(stage, fraction, note=""):
        if stage == "sparsify" and fraction < 1:
            done.append(fraction)

    walked = path(progress=progress, sparsify_steps=sparsify_steps)
    if photographed:
        train = photographs(SCENE, tmp_path, train=5, held_out=0).train
        walked.compactor = replace(walked.compactor, supervision=replace(walked.compactor.supervision, train=train))
    walked.prune(40)
    assert walked.train(deadline=deadline).trained == (expected > 0)
    assert done == [step / expected for step in range(expected)]


def test_a_point_that_is_passed_takes_a_third_of_the_steps_and_the_others_where_it_is_encoded(tmp_path):
    done = []
    walked = path(progress=lambda *event: done.append(event[:2]), sparsify_steps=12)
    train = photographs(SCENE, tmp_path, train=5, held_out=0).train
    walked.compactor = replace(walked.compactor, supervision=replace(walked.compactor.supervision, train=train))
    walked.prune(40)
    for passed, expected in [(True, 4), (True, 0), (False, 8), (False, 0), (True, 0)]:
        done.clear()
        walked.train(passed=passed)
        assert len([stage for stage, fraction in done if stage == "sparsify" and fraction < 1]) == expected


def test_an_untrained_point_is_the_pruned_scene():
    walked = path()
    point = walked.prune(30)
    assert same(point.splats, SCENE.select(point.index))
    compacted = walked.compacted(point, refine=False)
    assert same(compacted.splats, point.splats)
    assert compacted.report.target_source == "nothing"
    refined = walked.compacted(point, refine=True)
    assert not same(refined.splats, point.splats)
    assert refined.report.target_source == "renderings"
    assert (compacted.report.source_count, compacted.report.count) == (60, 30)


def test_refinement_leaves_the_path_as_it_is():
    with_refinement, without = path(), path()
    for walked in (with_refinement, without):
        walked.prune(40)
        walked.train()
        if walked is with_refinement:
            refined = walked.compacted(walked.points[-1], refine=True)
            assert not same(refined.splats, walked.points[-1].splats)
            assert same(refined.splats, walked.compacted(walked.points[-1], refine=True).splats)
        walked.prune(20)
        walked.train()
    assert same(with_refinement.points[-1].splats, without.points[-1].splats)
    assert same(without.compacted(without.points[-1], refine=False).splats, without.points[-1].splats)


@pytest.mark.parametrize("stage", ["score", "sparsify"])
def test_an_interruption_leaves_the_path_as_it_was(stage):
    armed = []

    def progress(now, fraction, note=""):
        if armed and now == stage and fraction > 0.3:
            armed.clear()
            raise kissgs.Cancelled

    def walk(walked, repeated):
        for count in (40, 20):
            for step in (lambda n=count: walked.prune(n), walked.train):
                if repeated and (step == walked.train) == (stage == "sparsify"):
                    armed.append(True)
                    points = list(walked.points)
                    with pytest.raises(kissgs.Cancelled):
                        step()
                    assert walked.points == points
                step()
        return walked.points[-1]

    one, other = walk(path(progress=progress), repeated=True), walk(path(), repeated=False)
    assert same(one.splats, other.splats)


def test_states_can_be_forgotten():
    kept, forgotten = path(), path()
    forgotten.keep_states = False
    for walked in (kept, forgotten):
        for count in (40, 20):
            walked.prune(count)
            walked.train()
    assert same(kept.points[-1].splats, forgotten.points[-1].splats)
    assert [point.state is None for point in kept.points] == [True, False, False]
    assert [point.state is None for point in forgotten.points] == [True, True, False]
