"""Merging. Oracle: integrals as sums over grids of pixels, NumPy's eigenvalues, distances of all pairs; renderings."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.training_scenes import cloud, same
from hypothesis import given
from hypothesis import strategies as st

import kissgs
from kissgs import CompactSettings
from kissgs.compaction import merging
from kissgs.compaction.budget import chosen_views, compact_scene
from kissgs.compaction.merging import BLUR, CONTRAST, merge_gaussians
from kissgs.compaction.scoring import highest_indices
from kissgs.core.context import Context, Workers
from kissgs.core.splats import ATTRIBUTES, OPACITY_LOGIT_MAX, OPACITY_LOGIT_MIN
from kissgs.rendering.camera import look_at
from kissgs.rendering.cpu.neighbours import nearest_neighbours, unique_pairs
from kissgs.rendering.rasterizer import render

AXES = ((1, 2), (0, 2), (0, 1))
"""The two coordinates of an image along each axis."""


def matrices(packed):
    """Return (N, 3, 3) of xx, xy, xz, yy, yz, zz."""
    return packed[..., [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(*packed.shape[:-1], 3, 3)


def covariance(scene):
    """Return covariances from the rotation of the basis vectors by each quaternion."""
    w, x, y, z = scene.quats.astype(np.float64).T
    zero = np.zeros_like(w)
    cross = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]).transpose(2, 0, 1)
    turn = np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross
    return (turn * np.exp(2 * scene.scales.astype(np.float64))[:, None, :]) @ turn.transpose(0, 2, 1)


def packed(full):
    return np.ascontiguousarray(full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])


class Pixels:
    """Images of Gaussians along each axis as sums over a fine grid."""

    def __init__(self, reach=10.0, count=401):
        line = np.linspace(-reach, reach, count)
        self.area = (line[1] - line[0]) ** 2
        self.points = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1)

    def image(self, mean, full, axis, blur):
        rows = list(AXES[axis])
        offset = self.points - mean[rows]
        inverse = np.linalg.inv(full[np.ix_(rows, rows)] + blur * np.eye(2))
        return np.exp(-0.5 * np.einsum("...i,ij,...j", offset, inverse, offset))


def two(seed, coefficients=3):
    """Return two overlapping Gaussians as the kernels take them, of moderate size and anisotropy."""
    rng = np.random.default_rng(seed)
    scene = cloud(2, degree=kissgs.core.splats.SH_REST_COUNTS.index(coefficients), seed=seed)
    scene = replace(
        scene,
        means=rng.normal(0, 0.5, (2, 3)).astype(np.float32),
        scales=rng.uniform(-1, 0.2, (2, 3)).astype(np.float32),
        opacities=rng.normal(0, 1.5, 2).astype(np.float32),
    )
    alphas = 1 / (1 + np.exp(-scene.opacities.astype(np.float64)))
    colors = np.concatenate([scene.sh0, scene.shN.reshape(2, -1)], axis=1)
    return scene, scene.means.astype(np.float64), covariance(scene), alphas, colors


@pytest.mark.parametrize("seed", range(2))
def test_moments_opacity_and_error_of_a_pair(seed):
    scene, means, full, alphas, colors = two(seed)
    spacing, pixels = np.full(2, 3.0), Pixels()
    blur = BLUR * 3
    weights = np.empty(2)
    merging.opacity_areas(packed(full), alphas, spacing, BLUR, 0, 2, weights)
    areas = [sum(math.sqrt(np.linalg.det(one[np.ix_(rows, rows)] + blur * np.eye(2))) for rows in AXES) for one in full]
    np.testing.assert_allclose(weights, alphas * areas, rtol=1e-12)
    share = weights / weights.sum()
    mean = share @ means
    joint = sum(s * (c + np.outer(m - mean, m - mean)) for s, c, m in zip(share, full, means, strict=True))

    target = square = 0.0
    for axis in range(3):
        a, b = (value * pixels.image(m, c, axis, blur) for value, m, c in zip(alphas, means, full, strict=True))
        one = pixels.image(mean, joint, axis, blur)
        target += ((a + b - a * b) * one).sum()
        square += (one * one).sum()
    alpha = target / square

    mixed = share @ colors.astype(np.float64)
    c_a, c_b = (of_directions(color.astype(np.float64) - mixed) for color in colors)
    first, second, cross = ((u * v).mean(axis=0).sum() for u, v in ((c_a, c_a), (c_b, c_b), (c_a, c_b)))
    error = 0.0
    for axis in range(3):
        a, b = (value * pixels.image(m, c, axis, blur) for value, m, c in zip(alphas, means, full, strict=True))
        one = pixels.image(mean, joint, axis, blur)
        drawn_a, drawn_b = a * (1 - b / 2), b * (1 - a / 2)  # the mean of both orders of depth
        color = drawn_a**2 * first + drawn_b**2 * second + 2 * drawn_a * drawn_b * cross
        error += (color + CONTRAST * (a + b - a * b - alpha * one) ** 2).sum() * pixels.area

    pairs, before = np.array([[0, 1]], np.int32), np.array([0.3, 0.2])
    added = np.empty(1)
    gaussians = means, packed(full), alphas, colors, weights, spacing
    merging.pair_errors(*gaussians, before, BLUR, CONTRAST, pairs, 0, 1, added)
    assert added[0] == pytest.approx(error + 2 * math.sqrt(error * 0.5), rel=1e-3)

    merged, index = merge_gaussians(scene, 1)
    spacing_of_two = np.full(2, ((means[0] - means[1]) ** 2).sum())
    own = np.empty(2)
    merging.opacity_areas(packed(full), alphas, spacing_of_two, BLUR, 0, 2, own)
    assert index.tolist() == [int(np.argmax(own))]
    own /= own.sum()
    np.testing.assert_allclose(merged.means[0], own @ means, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(merged.sh0[0], own @ scene.sh0, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(merged.shN[0], np.tensordot(own, scene.shN, 1), rtol=1e-5, atol=1e-6)
    spread = sum(s * (c + np.outer(m - own @ means, m - own @ means)) for s, c, m in zip(own, full, means, strict=True))
    np.testing.assert_allclose(covariance(merged)[0], spread, rtol=1e-4, atol=1e-5)
    merging.merge(*gaussians, BLUR, pairs, 0, 1)
    assert alphas[0] == pytest.approx(alpha, rel=1e-5)


@pytest.mark.parametrize("lengths", [1e2, 1e4, 1e6])
def test_errors_and_opacities_of_needles_far_apart_along_their_own_direction(lengths):
    """Rounding of their determinants must not make an image's value at a distance larger than its peak."""
    count, spacing, weights = 50, np.zeros(100), np.ones(100)
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    full = np.exp(-4) * directions[:, :, None] * directions[:, None, :] + np.exp(-60) * np.eye(3)
    covariances = packed(np.repeat(full, 2, axis=0))
    means = np.repeat(directions, 2, axis=0) * np.tile([0, lengths * np.exp(-2)], count)[:, None]
    alphas, colors = np.full(2 * count, 0.9), np.zeros((2 * count, 3), np.float32)
    pairs, added = np.arange(2 * count, dtype=np.int32).reshape(-1, 2), np.empty(count)
    gaussians = means, covariances, alphas, colors, weights, spacing
    merging.pair_errors(*gaussians, np.zeros(2 * count), BLUR, CONTRAST, pairs, 0, count, added)
    assert np.isfinite(added).all()
    assert (added >= 0).all()
    merging.merge(*gaussians, BLUR, pairs, 0, count)
    assert (alphas[::2] < 0.9).all()  # both together cover little of what the joint Gaussian covers


def of_directions(coefficients, count=4000):
    """Return the colours (directions, RGB) of SH coefficients of degree 1 in evenly distributed directions."""
    at = np.arange(count) + 0.5
    height, angle = 1 - 2 * at / count, np.pi * (1 + 5**0.5) * at
    ring = np.sqrt(1 - height**2)
    x, y, z = ring * np.cos(angle), ring * np.sin(angle), height
    c0, c1 = 0.5 / math.sqrt(math.pi), math.sqrt(3 / (4 * math.pi))
    basis = np.stack([np.full(count, c0), -c1 * y, c1 * z, -c1 * x], axis=1)
    return basis @ np.concatenate([coefficients[None, :3], coefficients[3:].reshape(-1, 3)])


def test_two_gaussians_at_one_place_cover_as_both_together():
    scene = cloud(1, degree=1)
    both = scene.select(np.array([0, 0]))
    merged, _ = merge_gaussians(both, 1)
    alpha = 1 / (1 + np.exp(-scene.opacities.astype(np.float64)))
    together = 2 * alpha - alpha**2
    # The image of the product of both is narrower; half its width fits less of it.
    found = 1 / (1 + np.exp(-merged.opacities.astype(np.float64)))
    assert found == pytest.approx(2 * alpha - alpha**2 * 2 / 3, rel=1e-4)
    assert (found >= together).all()
    for name in ("means", "sh0", "shN"):
        np.testing.assert_allclose(getattr(merged, name), getattr(scene, name), rtol=1e-6)
    np.testing.assert_allclose(covariance(merged), covariance(scene), rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("count", [2, 5, 9, 300])
def test_nearest_neighbours(count):
    rng = np.random.default_rng(count)
    means = rng.normal(size=(count, 3)) * [1, 1e3, 1e-3]
    known = min(8, count - 1)
    with Workers(2) as pool:
        near, spacing = nearest_neighbours(means, known, min(3, known - 1), pool)
    distances = ((means[:, None] - means) ** 2).sum(axis=2)
    np.fill_diagonal(distances, np.inf)
    assert (near == np.argsort(distances, axis=1)[:, : near.shape[1]]).all()
    np.testing.assert_allclose(spacing, np.sort(distances, axis=1)[:, min(3, known - 1)])
    pairs = np.empty((near.size, 2), np.int32)
    pairs = pairs[: unique_pairs(near, pairs)]
    listed = sorted(map(tuple, pairs.tolist()))
    assert listed == sorted({(min(i, j), max(i, j)) for i, row in enumerate(near.tolist()) for j in row})


@given(st.integers(0, 10**6))
def test_covariances_become_rotations_and_scales_again(seed):
    rng = np.random.default_rng(seed)
    scene = cloud(20, seed=seed)
    scene = replace(scene, scales=rng.uniform(-4, 4, (20, 3)).astype(np.float32))
    packed_ones = np.empty((20, 6))
    merging.covariances_of(scene.quats, scene.scales, 0, 20, packed_ones)
    np.testing.assert_allclose(matrices(packed_ones), covariance(scene), rtol=1e-6, atol=1e-9)
    quats, scales = np.empty((20, 4), np.float32), np.empty((20, 3), np.float32)
    merging.decompose(packed_ones, np.arange(20), 0, 20, quats, scales)
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1, rtol=1e-6)
    values = np.linalg.eigvalsh(matrices(packed_ones))
    np.testing.assert_allclose(np.sort(scales, axis=1)[:, 2], 0.5 * np.log(values[:, 2]), atol=1e-4)
    again = covariance(replace(scene, quats=quats, scales=scales))
    tolerance = 1e-6 * values[:, 2].max()
    np.testing.assert_allclose(again, covariance(scene), atol=tolerance)


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize(("count", "left"), [(0, 1), (1, 1), (2, 1), (8, 7), (9, 9), (100, 33)])
def test_the_count_is_exact_and_gaussians_that_stay_are_untouched(degree, count, left):
    scene = cloud(count, degree=degree)
    merged, index = merge_gaussians(scene, left)
    left = min(left, count)
    assert len(merged) == left
    assert (np.diff(index, prepend=-1) > 0).all()
    assert same(kissgs.clean(merged)[0], merged)
    alone = [n for n, origin in enumerate(index) if (merged.means[n] == scene.means[origin]).all()]
    assert same(merged.select(np.array(alone, int)), scene.select(index[alone]))
    assert len(alone) >= 2 * left - count


def test_the_result_depends_neither_on_threads_nor_on_the_order():
    scene = cloud(500, degree=1)
    merged, index = merge_gaussians(scene, 100, Context(1))
    again, same_index = merge_gaussians(scene, 100, Context(5))
    assert same(merged, again)
    assert (index == same_index).all()
    shuffled = np.random.default_rng(0).permutation(500)
    other, other_index = merge_gaussians(scene.select(shuffled), 100)
    assert set(shuffled[other_index].tolist()) == set(index.tolist())
    rank, other_rank = (np.lexsort(one.means.T) for one in (merged, other))
    np.testing.assert_allclose(other.means[other_rank], merged.means[rank], rtol=1e-5, atol=1e-6)


EXTREMES = {
    "means": [0.0, 1e6, -1e6, 1e-6, 1e15],
    "scales": [0.0, 30.0, -30.0],
    "opacities": [0.0, OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX],
    "sh0": [0.0, 1e6, -1e6],
}


@pytest.mark.parametrize("name", EXTREMES)
def test_extreme_values_give_a_clean_scene(name):
    scene, rng = cloud(60, degree=1), np.random.default_rng(0)
    values = rng.choice(np.float32(EXTREMES[name]), size=getattr(scene, name).shape)
    scene = kissgs.clean(replace(scene, **{name: values}))[0]
    for left in (30, 7, 1):
        merged, _ = merge_gaussians(scene, left)
        assert len(merged) == left
        cleaned, report = kissgs.clean(merged)
        assert report.removed == report.zero_quats == report.unnormalised_quats == 0
        assert same(cleaned, merged)


def test_many_gaussians_at_one_place():
    """Every distance is 0: the search must not compare all pairs, which would take minutes."""
    scene = cloud(1).select(np.zeros(60_000, int))
    merged, _ = merge_gaussians(scene, 3)
    assert len(merged) == 3
    np.testing.assert_allclose(merged.means, scene.means[:3], rtol=1e-6)


def test_a_level_seen_from_afar_is_nearer_to_the_scene_than_its_most_important_gaussians():
    scene = kissgs.sample_scene(6000, sh_degree=1, seed=1)
    left = len(scene) // 4
    merged = merge_gaussians(scene, left)[0]
    pruned = scene.select(highest_indices(scene.opacities + scene.scales.sum(axis=1), left))
    for distance, gain in ((9.0, 2.0), (36.0, 4.0)):
        errors = []
        for angle in np.linspace(0, 2 * math.pi, 5)[:4]:
            eye = distance * np.array([math.cos(angle), -0.4, math.sin(angle)])
            camera = look_at(eye, np.zeros(3), np.array([0.0, -1, 0]), fov=0.8, width=160, height=120)
            images = [render(one, camera)[0] for one in (scene, merged, pruned)]
            errors.append([((image - images[0]) ** 2).mean() for image in images[1:]])
        ours, theirs = np.mean(errors, axis=0)
        assert 10 * math.log10(theirs / ours) > gain


def test_a_budget_is_met_by_merging_without_views():
    scene = cloud(200, degree=1)
    result = compact_scene(scene, CompactSettings(ratio=0.25, method="merge"))
    expected, index = merge_gaussians(scene, 50)
    assert same(result.splats, expected)
    assert (result.index == index).all()
    assert [(step.name, step.count) for step in result.report.steps] == [("input", 200), ("merge", 50)]
    assert (result.report.target_source, result.report.source) == ("nothing", "")
    assert all(getattr(result.splats, name).dtype == np.float32 for name in ATTRIBUTES)
    supervision = chosen_views(scene, CompactSettings(ratio=0.25, method="merge"), None, Context())
    assert supervision.train == supervision.score == (), "it draws no cameras that nothing uses"
