"""Coverage and local scale. Reference: neighbours by brute force, a stable sort, and cameras placed by hand."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers.whole_scenes import joined, moved
from hypothesis import given
from hypothesis import strategies as st

from kissgs import Splats, sample_scene
from kissgs.core.context import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import concatenate
from kissgs.rendering.camera import Camera, look_at
from kissgs.rendering.cpu.frame import add_sensitivities, draw
from kissgs.rendering.cpu.neighbours import leaves_of
from kissgs.rendering.sensitivity import Coverage, local_scale

UP = np.array([0.0, -1.0, 0.0])


def neighbour(splats: Splats, rank: int) -> np.ndarray:
    means = splats.means.astype(np.float64)
    return np.array([np.partition(np.linalg.norm(means - mean, axis=1), rank)[rank] for mean in means])


def test_local_scale_is_the_distance_of_about_the_128th_neighbour():
    scene = sample_scene(3000)
    found = local_scale(scene)
    sizes = np.exp(np.sort(scene.scales, axis=1)[:, 1])
    by_neighbours = found > 1.01 * sizes
    share = found[by_neighbours]
    assert (
        share >= 0.99 * neighbour(scene, 20)[by_neighbours]
    ).mean() > 0.97  # the others are at the edge of an object
    assert np.median(share / neighbour(scene, 128)[by_neighbours]) < 1.6


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_local_scale_follows_the_scale_of_the_scene(scale: float):
    scene = sample_scene(2000)
    assert local_scale(moved(scene, scale=scale)) == pytest.approx(scale * local_scale(scene), rel=2e-2)


def test_a_far_object_does_not_change_local_scales():
    """Float32 positions could not represent its shape at ten times the distance."""
    scene = sample_scene(2000)
    both = joined(scene, moved(sample_scene(2000, seed=1), by=(1e4, 0, 0), scale=0.01))
    there = both.means[:, 0] > 5e3
    found = local_scale(both)
    assert np.median(found[there]) == pytest.approx(0.01 * np.median(local_scale(sample_scene(2000, seed=1))), rel=0.5)
    assert np.median(found[~there]) == pytest.approx(np.median(local_scale(scene)), rel=0.5)


@pytest.mark.parametrize("count", [60, 100])
def test_the_scale_of_an_object_of_few_gaussians_is_its_own(count: int):
    """The other objects are three hundred times their size away."""
    one = replace(sample_scene(count, seed=2), scales=np.full((count, 3), -9, np.float32))
    extent = np.ptp(one.means, axis=0).max()
    many = joined(*(moved(one, by=(n % 5 * 6000.0, n // 5 * 6000.0, 0)) for n in range(20)))
    assert np.quantile(local_scale(many), 0.95) < 3 * extent


@pytest.mark.parametrize("far", [1e8, 1e12, 1e18])
def test_one_gaussian_however_far_out_does_not_change_local_scales(far: float):
    """Distances in its leaf are accurate too."""
    scene = sample_scene(2000)
    means = scene.means.copy()
    means[0, 0] = far
    ratios = local_scale(replace(scene, means=means))[1:] / local_scale(scene)[1:]
    assert ratios.min() > 0.5
    assert ratios.max() < 2


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 9, 513])
def test_small_and_coincident_scenes_have_positive_scales(count: int):
    scene = sample_scene(count)
    coincident = moved(scene, scale=1e-6)
    for splats in (scene, coincident):
        found = local_scale(splats)
        assert found.shape == (count,)
        assert (found > 0).all()
        assert np.isfinite(found).all()


@given(st.lists(st.integers(-3, 3), min_size=0, max_size=60), st.integers(1, 8))
def test_a_part_is_split_at_its_median_and_the_first_of_equal_values_are_below_it(values, leaf):
    """The choice among equal values is the same on every processor."""
    points = np.zeros((len(values), 3), np.float32)
    points[:, 1] = values
    order, edges = leaves_of(points, leaf)

    def parts(members):
        if len(members) <= leaf:
            return [sorted(members)]
        ascending = sorted(members, key=lambda n: (values[n], n))
        return parts(ascending[: len(members) // 2]) + parts(ascending[len(members) // 2 :])

    assert [sorted(order[a:b].tolist()) for a, b in itertools.pairwise(edges)] == parts(range(len(values)))


@pytest.mark.parametrize("spacing", [1e-3, 1.0, 1e4])
def test_on_a_grid_it_is_the_same_number_of_spacings_at_any_scale(spacing):
    scene = sample_scene(4096)
    grid = np.stack(np.meshgrid(np.arange(64), np.arange(64), [0], indexing="ij"), axis=-1).reshape(-1, 3)
    flat = replace(
        scene, means=(grid * spacing).astype(np.float32), scales=np.full((4096, 3), np.log(0.1 * spacing), np.float32)
    )
    found = local_scale(flat) / spacing
    assert 5 < np.median(found) < 14, "128 neighbours fill a disc of 6.4 spacings; in a corner more than twice as far"


def coverage_of(splats: Splats, *cameras: Camera) -> np.ndarray:
    coverage = Coverage(splats)
    with Workers(1) as pool:
        for camera in cameras:
            found = Sensitivity.none(len(splats), splats.sh_degree)
            frame = draw(splats, camera, np.zeros(3, np.float32), pool)
            coverage.add(frame, add_sensitivities(frame, 1.0, 0.0, found, pool), pool)
    return coverage.share


def plate(z: float, opacity: float = 10.0, n: int = 900) -> Splats:
    side = int(np.sqrt(n))
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    means = np.stack([x.ravel(), y.ravel(), np.full(side**2, z)], axis=1).astype(np.float32)
    return Splats(
        means=means,
        quats=np.tile(np.float32([1, 0, 0, 0]), (side**2, 1)),
        scales=np.tile(np.float32(np.log([2 / side, 2 / side, 0.01])), (side**2, 1)),
        opacities=np.full(side**2, opacity, np.float32),
        sh0=np.zeros((side**2, 3), np.float32),
        shN=np.zeros((side**2, 0, 3), np.float32),
    )


def camera(position: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    return look_at(np.array(position), np.array(target), UP, fov=np.radians(60), width=128, height=128)


def test_gaussians_behind_an_opaque_plate_are_not_covered():
    front, behind = plate(0.0), plate(1.0)
    both = concatenate([front, behind])
    share = coverage_of(both, camera((0, 0, -2.2), (0, 0, 0)))
    inner = (np.abs(both.means[:, :2]) < 0.7).all(axis=1)
    assert (share[inner & (both.means[:, 2] == 0)] > 0.5).all()
    assert (share[inner & (both.means[:, 2] == 1)] < 0.05).all()
    from_both = coverage_of(both, camera((0, 0, -2.2), (0, 0, 0)), camera((0, 0, 3.2), (0, 0, 0)))
    assert (from_both[inner] > 0.5).all()


def test_gaussians_seen_only_from_far_away_are_hardly_covered():
    scene = plate(0.0)
    near, far = (coverage_of(scene, camera((0, 0, -z), (0, 0, 0))) for z in (2.2, 220.0))
    inner = (np.abs(scene.means[:, :2]) < 0.7).all(axis=1)
    assert (near[inner] > 0.5).all()
    assert (far < 0.05).all()


def test_close_up_does_not_depend_on_the_scale_of_the_scene():
    scene = sample_scene(1500)
    assert Coverage(moved(scene, scale=100)).close_up == pytest.approx(Coverage(scene).close_up, rel=0.05, abs=1e-6)


def test_samples_of_an_image_see_hidden_points_as_well_as_the_whole_image_on_average():
    """So little of them shows that coverage is in proportion to what each sample finds."""
    points = replace(plate(1.0, opacity=3.0, n=225), scales=np.full((225, 3), -9, np.float32))
    cover = replace(
        plate(0.0, opacity=6.0, n=1), means=np.zeros((1, 3), np.float32), scales=np.full((1, 3), 3, np.float32)
    )
    hidden = joined(cover, points)
    camera = look_at(np.array([0, 0, -3.0]), np.zeros(3), UP, fov=0.9, width=301, height=301)
    behind = hidden.means[:, 2] > 0.5
    samples = [coverage_of(hidden, camera.sampled(3, (x, y)))[behind] for x in range(3) for y in range(3)]
    assert 0 < np.max(samples) < 1
    assert np.mean(samples) == pytest.approx(coverage_of(hidden, camera)[behind].mean(), rel=0.02)


def test_points_are_covered_alike_whether_their_opacities_are_compensated_or_not():
    """Compensation takes most of a point's alpha away, however open it lies."""
    points = replace(plate(0.0, opacity=9.0, n=225), scales=np.full((225, 3), -5.2, np.float32))
    classic, antialiased = (
        coverage_of(replace(points, antialiased=mark), camera((0, 0, -2.2), (0, 0, 0))) for mark in (False, True)
    )
    assert np.median(classic) > 0.3
    assert antialiased == pytest.approx(classic, rel=0.2)
