"""Parts of a scene, and cameras for those that drawn ones overlook. Oracle: objects, put there and removed."""

import numpy as np
import pytest

import kissgs
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.cameras import COUNT, evaluation_views
from kissgs.evaluation.evaluate import compare_pictures
from kissgs.evaluation.overlooked import MOST_ADDED, NOTICED, Parts
from kissgs.evaluation.parts import find_parts
from kissgs.evaluation.prominence import prominence


def objects(count, gaussians=100, apart=200.0, seed=0):
    """Sample scenes at random places, no two nearer than ``apart``; and the object of each Gaussian."""
    rng, places = np.random.default_rng(seed), []
    while len(places) < count:
        place = rng.uniform(0, 1.7 * apart * count ** (1 / 3), 3)
        if all(np.linalg.norm(place - other) >= apart for other in places):
            places.append(place)
    scenes = [kissgs.sample_scene(gaussians, sh_degree=0, seed=n) for n in range(count)]
    arrays = {name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in ATTRIBUTES}
    arrays["means"] += np.repeat(np.float32(places), gaussians, axis=0)
    return Splats(**arrays), np.repeat(np.arange(count), gaussians)


FIFTY, OBJECT_OF = objects(50)


def found_in(scene):
    return find_parts(scene, prominence(scene))


def test_objects_far_apart_are_parts():
    parts, part_of = found_in(FIFTY)
    assert len(parts) == 50
    for n, part in enumerate(parts):
        inside = OBJECT_OF[part_of == n]
        most = np.bincount(inside).argmax()
        assert (inside == most).mean() > 0.9
        place = np.median(FIFTY.means[most == OBJECT_OF], axis=0)
        assert np.linalg.norm(part.middle - place) < 10
        assert part.radius < 60


def test_an_object_within_another_is_a_part():
    """Of a thousandth of the extent and a twentieth of the Gaussians."""
    scene = kissgs.sample_scene(2000, sh_degree=0)
    small = kissgs.sample_scene(100, sh_degree=0, seed=1)
    arrays = {name: np.concatenate([getattr(scene, name), getattr(small, name)]) for name in ATTRIBUTES}
    arrays["means"][2000:] = small.means * 0.001 + np.float32([4, -9, 4])
    arrays["scales"][2000:] += np.float32(np.log(0.001))
    parts, part_of = found_in(Splats(**arrays))
    (number,) = set(part_of[2000:][part_of[2000:] >= 0])
    assert (part_of[2000:] == number).mean() > 0.8
    assert (part_of[:2000] == number).mean() < 0.01
    assert parts[number].radius < 0.1


@pytest.mark.parametrize("spread", ["even", "normal", "shell"])
def test_what_only_thins_out_is_not_divided(spread):
    """But for what lies far out, which may be one part by itself, and the rest another."""
    rng = np.random.default_rng(3)
    scene = kissgs.sample_scene(3000, sh_degree=0)
    places = {"even": rng.uniform(0, 9, (3000, 3)), "normal": rng.normal(0, 3, (3000, 3))}
    places["shell"] = places["normal"] / np.linalg.norm(places["normal"], axis=1, keepdims=True)
    scene.means[:] = places[spread]
    scene.scales[:] = -6
    assert len(found_in(scene)[0]) <= (spread == "normal")


@pytest.mark.parametrize("count", [0, 1, 7])
def test_hardly_anything_has_no_parts(count):
    scene = kissgs.sample_scene(900, sh_degree=0).select(slice(0, count))
    parts, part_of = found_in(scene)
    assert parts == []
    assert (part_of == -1).all()
    assert len(part_of) == count


def test_gaussians_in_one_place_are_one_part():
    """Two heaps of equal ones, and a third too small to be one."""
    scene = kissgs.sample_scene(900, sh_degree=0).select(np.full(1003, 5))
    scene.means[:] = 0
    scene.means[600:1000] = 100
    scene.means[1000:] = -100
    _, part_of = found_in(scene)
    assert sorted(np.unique(part_of[:1000], return_counts=True)[1]) == [400, 600]
    assert (part_of[:600] == part_of[0]).all()
    assert part_of[0] != part_of[700]


def test_no_object_can_be_lost_unseen():
    """24 cameras look at some of fifty objects; the loss of the others left their pictures as they were."""
    views = evaluation_views(FIFTY)
    assert 20 < sum(view.added for view in views.test) <= MOST_ADDED
    taken, unseen = {}, []
    for gone in range(0, 50, 5):
        found = compare_pictures(FIFTY, FIFTY.select(np.flatnonzero(gone != OBJECT_OF)), views, taken=taken)
        assert found.worst.comparison.candidate_vs_reference.psnr < 20
        unseen.append(
            min(view.comparison.candidate_vs_reference.psnr for view in found.views if not view.view.added) > 20
        )
    assert sum(unseen) > 3
    assert found.added == found.as_dict()["added"] == len(found.views) - COUNT
    assert f"{found.added} of the views were added for parts that the others overlook" in found.extremes


def test_drawn_cameras_stay_as_they_are_and_added_ones_follow():
    alone, again = evaluation_views(FIFTY, threads=1).test, evaluation_views(FIFTY, threads=3).test
    assert [view.name for view in alone] == [view.name for view in again] == sorted(view.name for view in alone)
    for one, other in zip(alone, again, strict=True):
        assert one.camera.viewmat.tobytes() == other.camera.viewmat.tobytes()
        assert one.background.tobytes() == other.background.tobytes()
        assert one.added == other.added == one.name.endswith(" part")
    assert [view.added for view in alone] == sorted(view.added for view in alone)
    assert sum(not view.added for view in alone) == COUNT


def test_a_scene_in_one_piece_gets_no_more_cameras():
    views = evaluation_views(kissgs.sample_scene(3000, sh_degree=0))
    assert [view.added for view in views.test] == [False] * COUNT


def test_there_are_no_more_than_are_allowed():
    scene, _ = objects(120, gaussians=40)
    assert sum(view.added for view in evaluation_views(scene).test) == MOST_ADDED


def test_an_added_camera_is_the_best_of_those_that_were_tried():
    """Its loss shows over one of the backgrounds, or not at all: a part that is the colour of what is behind it."""
    scene, object_of = objects(2, gaussians=300)
    parts = Parts.of(scene, prominence(scene))
    with Workers(1) as pool:
        added = parts.cameras_for(range(len(parts.parts)), (64, 48), np.random.default_rng(0), pool)
    assert all(one.psnr < NOTICED for one in added)
    for part, one in zip(parts.parts, added, strict=True):
        assert (one.target == part.middle).all()
        assert one.background in (0.0, 0.5, 1.0)
    assert len(set(object_of[parts.part_of >= 0])) == 2
