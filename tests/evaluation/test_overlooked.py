"""Separate parts of a scene, and cameras for overlooked ones. Oracle: objects with known positions, then removed."""

import numpy as np
import pytest

import kissgs
from kissgs.core.context import Context, Workers
from kissgs.core.splats import ATTRIBUTES, Splats
from kissgs.evaluation.cameras import COUNT, MAX_ADDED, VISIBLE_PSNR, Parts, evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.scene_parts import find_parts, prominence
from kissgs.rendering.metrics import psnr
from kissgs.rendering.rasterizer import render


def objects(count, gaussians=100, apart=200.0, seed=0):
    """Return sample scenes at random positions, at least ``apart`` from each other, and each Gaussian's object."""
    rng, positions = np.random.default_rng(seed), []
    while len(positions) < count:
        position = rng.uniform(0, 1.7 * apart * count ** (1 / 3), 3)
        if all(np.linalg.norm(position - other) >= apart for other in positions):
            positions.append(position)
    scenes = [kissgs.sample_scene(gaussians, sh_degree=0, seed=n) for n in range(count)]
    arrays = {name: np.concatenate([getattr(scene, name) for scene in scenes]) for name in ATTRIBUTES}
    arrays["means"] += np.repeat(np.float32(positions), gaussians, axis=0)
    return Splats(**arrays), np.repeat(np.arange(count), gaussians)


@pytest.fixture(scope="module")
def fifty():
    """Fifty objects, and each Gaussian's."""
    return objects(50)


@pytest.fixture(scope="module")
def views(fifty):
    return evaluation_views(fifty[0], Context(1))


def parts_of(scene):
    return find_parts(scene, prominence(scene))


def test_distant_objects_are_parts(fifty):
    scene, object_of = fifty
    parts, part_of = parts_of(scene)
    assert len(parts) == 50
    for n, part in enumerate(parts):
        inside = object_of[part_of == n]
        most = np.bincount(inside).argmax()
        assert (inside == most).mean() > 0.9
        center = np.median(scene.means[most == object_of], axis=0)
        assert np.linalg.norm(part.center - center) < 10
        assert part.radius < 60


def test_a_small_object_inside_another_is_a_part():
    """The small one has a thousandth of the extent and a twentieth of the Gaussians."""
    scene = kissgs.sample_scene(2000, sh_degree=0)
    small = kissgs.sample_scene(100, sh_degree=0, seed=1)
    arrays = {name: np.concatenate([getattr(scene, name), getattr(small, name)]) for name in ATTRIBUTES}
    arrays["means"][2000:] = small.means * 0.001 + np.float32([4, -9, 4])
    arrays["scales"][2000:] += np.float32(np.log(0.001))
    parts, part_of = parts_of(Splats(**arrays))
    (number,) = set(part_of[2000:][part_of[2000:] >= 0])
    assert (part_of[2000:] == number).mean() > 0.8
    assert (part_of[:2000] == number).mean() < 0.01
    assert parts[number].radius < 0.1


@pytest.mark.parametrize("spread", ["even", "normal", "shell"])
def test_gradual_changes_of_density_make_no_parts(spread):
    """A single outlying group may be a part of its own."""
    rng = np.random.default_rng(3)
    scene = kissgs.sample_scene(3000, sh_degree=0)
    positions = {"even": rng.uniform(0, 9, (3000, 3)), "normal": rng.normal(0, 3, (3000, 3))}
    positions["shell"] = positions["normal"] / np.linalg.norm(positions["normal"], axis=1, keepdims=True)
    scene.means[:] = positions[spread]
    scene.scales[:] = -6
    assert len(parts_of(scene)[0]) <= (spread == "normal")


@pytest.mark.parametrize("count", [0, 1, 7])
def test_scenes_of_few_gaussians_have_no_parts(count):
    scene = kissgs.sample_scene(900, sh_degree=0).select(slice(0, count))
    parts, part_of = parts_of(scene)
    assert parts == []
    assert (part_of == -1).all()
    assert len(part_of) == count


def test_coincident_gaussians_are_one_part():
    """Two groups of equal Gaussians, and a third one too small to be a part."""
    scene = kissgs.sample_scene(900, sh_degree=0).select(np.full(1003, 5))
    scene.means[:] = 0
    scene.means[600:1000] = 100
    scene.means[1000:] = -100
    _, part_of = parts_of(scene)
    assert sorted(np.unique(part_of[:1000], return_counts=True)[1]) == [400, 600]
    assert (part_of[:600] == part_of[0]).all()
    assert part_of[0] != part_of[700]


def test_the_loss_of_any_object_is_visible(fifty, views):
    """24 drawn cameras show only some of fifty objects; the added ones show the others."""
    scene, object_of = fifty
    assert 20 < sum(view.added for view in views.test) <= MAX_ADDED
    reference_images, unseen = {}, []
    for removed in range(0, 50, 20):
        rest = scene.select(np.flatnonzero(removed != object_of))
        found = compare_images(scene, rest, views, reference_images=reference_images)
        assert found.worst.comparison.candidate_vs_reference.psnr < 20
        unseen.append(
            min(view.comparison.candidate_vs_reference.psnr for view in found.views if not view.view.added) > 20
        )
    assert sum(unseen) > 1
    assert found.added == found.as_dict()["added"] == len(found.views) - COUNT
    assert f"{found.added} of the views were added for parts that the others overlook" in found.extremes


def test_added_cameras_follow_the_drawn_ones_whatever_the_threads(fifty, views):
    first, again = views.test, evaluation_views(fifty[0], Context(3)).test
    assert [view.name for view in first] == [view.name for view in again] == sorted(view.name for view in first)
    for one, other in zip(first, again, strict=True):
        assert one.camera.viewmat.tobytes() == other.camera.viewmat.tobytes()
        assert one.background.tobytes() == other.background.tobytes()
        assert one.added == other.added == one.name.endswith(" part")
    assert [view.added for view in first] == sorted(view.added for view in first)
    assert sum(not view.added for view in first) == COUNT


def test_a_scene_without_separate_parts_gets_no_added_cameras():
    views = evaluation_views(kissgs.sample_scene(3000, sh_degree=0))
    assert [view.added for view in views.test] == [False] * COUNT


@pytest.mark.quick(0)
def test_the_number_of_added_cameras_is_limited():
    scene, _ = objects(120, gaussians=40)
    assert sum(view.added for view in evaluation_views(scene).test) == MAX_ADDED


def test_the_loss_of_a_part_is_visible_to_its_added_camera():
    """It is visible over at least one of the backgrounds."""
    scene, object_of = objects(2, gaussians=300)
    parts = Parts(scene, *parts_of(scene))
    with Workers(1) as pool:
        added = parts.cameras_for(range(len(parts.parts)), np.random.default_rng(0), pool)
    for number, (part, view) in enumerate(zip(parts.parts, added, strict=True)):
        assert (view.target == part.center).all()
        assert view.background.tolist() in ([grey] * 3 for grey in (0, 0.5, 1))
        rest = scene.select(np.flatnonzero(parts.part_of != number))
        images = (render(each, view.camera, background=view.background.tolist())[0] for each in (scene, rest))
        assert psnr(*(image.clip(0, 1) for image in images)) < VISIBLE_PSNR + 2
    assert len(set(object_of[parts.part_of >= 0])) == 2
