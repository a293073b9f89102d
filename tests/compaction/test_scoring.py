"""Oracle: counting, and for a pile of copies, knowing that one of them is enough. Scores: tests/rendering."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.training_scenes import around, cloud
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs.cameras.views import black
from kissgs.compaction.scoring import highest, show_most
from kissgs.core.splats import ATTRIBUTES, SH_C0
from kissgs.rendering.coverage import Coverage
from kissgs.rendering.rasterizer import removal_scores

VIEWS = around()
CAMERAS = [view.camera for view in VIEWS]


@given(st.lists(st.sampled_from([0.0, 1.0, 2.5, 7.0]), max_size=12), st.integers(0, 14))
def test_exactly_so_many_the_highest_and_of_equal_ones_the_first(scores, count):
    chosen = highest(np.array(scores), count).tolist()
    best = sorted(range(len(scores)), key=lambda n: (-scores[n], n))[:count]
    assert chosen == sorted(best)


def test_in_one_round_those_with_the_highest_scores_stay():
    scene = cloud(80)
    scores = removal_scores(scene, CAMERAS)
    assert show_most(scene, VIEWS, black(), 20).tolist() == sorted(np.argsort(-scores)[:20].tolist())


@pytest.mark.parametrize("least", [0.05, 0.3, 10.0])
def test_no_score_is_less_than_a_share_of_what_a_camera_nearby_would_find(least):
    """The unit: scores of the seen, in the median, by squared alpha over an image that the surroundings fill."""
    scene = cloud(80)
    hidden = np.arange(80) % 4 == 0
    scene = replace(scene, means=np.where(hidden[:, None], scene.means + np.float32(500), scene.means))
    scores, nearby = removal_scores(scene, CAMERAS), Coverage(scene).close_up
    assert (scores[hidden] == 0).all()
    unit = np.median((scores / nearby)[scores > 0])
    wanted = np.maximum(scores, least * unit * nearby)
    kept = show_most(scene, VIEWS, black(), 20, least=least)
    assert kept.tolist() == sorted(np.argsort(-wanted)[:20].tolist())
    assert not hidden[show_most(scene, VIEWS, black(), 20)].any()
    assert hidden[kept].any()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.8, 0.99])
@pytest.mark.parametrize("count", [1, 7, 79])
def test_however_many_rounds_exactly_so_many_stay(share, count):
    kept = show_most(cloud(80), VIEWS, black(), count, share=share)
    assert len(kept) == count
    assert (np.diff(kept) > 0).all()


def test_rounds_do_not_throw_away_both_of_a_pair():
    """Two opaque ones at each place: each is superfluous as long as the other is there."""
    scene = cloud(20, 0, seed=3)
    opaque = {**{name: getattr(scene, name) for name in ATTRIBUTES}, "opacities": np.full(20, 5, np.float32)}
    pairs = kissgs.Splats(**{name: np.concatenate([value, value]) for name, value in opaque.items()})

    def places(share):
        return len(set((show_most(pairs, VIEWS, black(), 20, share=share) % 20).tolist()))

    assert places(0.99) > places(0.0) + 1


def test_each_view_has_a_background_of_its_own():
    """What is black does not show on black; on white it does."""
    scene = cloud(80, 0)
    dark = np.arange(80) % 2 == 0
    colours = np.where(dark[:, None], np.float32(-0.5 / SH_C0), np.full((80, 3), 0.1, np.float32))
    scene = replace(scene, sh0=colours, opacities=np.full(80, 3, np.float32))
    mixed = [replace(view, background=np.full(3, n % 2, np.float32)) for n, view in enumerate(VIEWS)]

    def dark_ones(views):
        return int(dark[show_most(scene, views, black(), 40)].sum())

    assert dark_ones(VIEWS) + 4 < dark_ones(mixed)
    split = (removal_scores(scene, [v.camera for v in mixed[n::2]], background=(n, n, n)) for n in (0, 1))
    assert show_most(scene, mixed, black(), 40).tolist() == sorted(np.argsort(-sum(split))[:40].tolist())


def test_images_of_any_size_count_the_same():
    """Scores are mean squared errors: an image of four times the pixels has no more weight."""
    scene = cloud(80)
    small = [replace(view, camera=view.camera.at_most(16)) for view in VIEWS[1:]]
    cameras = [CAMERAS[0], *(view.camera for view in small)]
    means = [removal_scores(scene, [camera]) / (3 * camera.width * camera.height) for camera in cameras]
    kept = show_most(scene, [VIEWS[0], *small], black(), 20).tolist()
    assert kept == sorted(np.argsort(-sum(means), kind="stable")[:20].tolist())
    sums = sum(removal_scores(scene, [camera]) for camera in cameras)
    assert kept != sorted(np.argsort(-sums, kind="stable")[:20].tolist())


def test_progress_rises_to_the_end():
    told = []
    views = [replace(view, background=np.full(3, n % 3 / 2, np.float32)) for n, view in enumerate(VIEWS)]
    show_most(cloud(30), views, black(), 5, share=0.6, progress=lambda stage, fraction, note="": told.append(fraction))
    assert told == sorted(told)
    assert told[-1] == 1.0


@pytest.mark.parametrize(("share", "scorings"), [(0.0, 1), (0.1, 1), (0.25, 1), (0.5, 2), (0.7, 4), (0.99, 138)])
def test_it_scores_as_often_as_needed(share, scorings):
    """From 80 to 20: a quarter."""
    begun = []

    def progress(stage, fraction, note=""):
        begun.append(fraction)

    show_most(cloud(80), VIEWS[:1], black(), 20, share=share, progress=progress)
    told = (len(begun) - 1) / 2  # each scoring tells its beginning and its end
    assert told == scorings if scorings < 5 else 55 < told <= scorings, "60 Gaussians go, at least one at a time"
