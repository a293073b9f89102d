"""The metric of view-dependent colour: its forms, and clustering under them, against direct sums over directions."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.captured_scene import cameras
from helpers.memory import takes_less_than
from helpers.reference_harmonics import real_harmonics

import kissgs
from kissgs.core.context import Workers
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_REST_COUNTS
from kissgs.planning import kmeans
from kissgs.planning.kmeans import Clustering, Vectors, sorted_by_label
from kissgs.planning.sh_codebook import UNIFORM_WEIGHT, ShMetric, codebook_error_model

SETTINGS = kissgs.Settings.research("balanced", sh_kmeans_iterations=3, sh_neighbors=32, sh_tolerance=0.0).encode


def seen_directions(count, spread, seed=0, number=12):
    """Return unit vectors ``(count, number, 3)`` around a random axis per Gaussian, and weights that sum to 1."""
    rng = np.random.default_rng(seed)
    found = rng.normal(size=(count, 1, 3)) + spread * rng.normal(size=(count, number, 3))
    weights = rng.uniform(0.1, 1, (count, number))
    return found / np.linalg.norm(found, axis=2, keepdims=True), weights / weights.sum(axis=1, keepdims=True)


def metric_of(directions, weights, degree, captured=1.0):
    """Return the metric of a capture that sees each Gaussian from these directions."""
    count = len(directions)
    basis = real_harmonics(directions.reshape(-1, 3), 2 * degree)[:, 1:].reshape(count, weights.shape[1], -1)
    means = np.einsum("nd,ndj->nj", weights, basis).astype(np.float32)
    own = SH_REST_COUNTS[degree]
    sensitivity = replace(
        Sensitivity.none(count, degree, captured=True),
        mean_harmonics=means[:, :own].copy(),
        higher_harmonics=means[:, own:].copy(),
        captured=np.full(count, captured, np.float32),
    )
    return ShMetric.of(sensitivity, degree)


def direct_errors(differences, directions, weights, degree, captured=1.0):
    """Return errors summed over directions: the variance of the colour error, and all coefficients alike."""
    some = differences.reshape(len(differences), -1, 3)
    basis = real_harmonics(directions.reshape(-1, 3), degree)[:, 1:].reshape(*weights.shape, -1)
    colors = basis @ some
    mean = np.einsum("nd,ndc->nc", weights, colors)
    variance = np.einsum("nd,ndc->n", weights, np.square(colors - mean[:, None]))
    known = (1 - UNIFORM_WEIGHT) * captured
    # A form that is the identity for all directions alike: of the second moment, the uniform part stays at 1 - known.
    uniform = np.square(some).sum(axis=(1, 2))
    return known * 4 * np.pi * variance + (1 - known) * uniform


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("captured", [0.0, 0.4, 1.0])
def test_errors_are_those_of_the_colours_from_the_directions_of_view(degree, captured):
    directions, weights = seen_directions(40, 0.4)
    differences = np.random.default_rng(1).normal(size=(40, 3 * SH_REST_COUNTS[degree])).astype(np.float32)
    metric = metric_of(directions, weights, degree, captured)
    wanted = direct_errors(differences, directions, weights, degree, captured)
    np.testing.assert_allclose(metric.errors(differences, np.arange(40)), wanted, rtol=2e-4)
    assert np.linalg.eigvalsh(metric.quadratic_forms(np.arange(40))).min() > 0.9 * (1 - captured * (1 - UNIFORM_WEIGHT))


def test_without_a_capture_there_is_no_metric():
    assert ShMetric.of(Sensitivity.none(5, 3), 3) is None
    assert ShMetric.of(Sensitivity.none(5, 0, captured=True), 0) is None


def clustering(vectors, labels, centroids, weights):
    data = Vectors(vectors, np.arange(len(vectors)), weights)
    members, edges = sorted_by_label(labels, len(centroids))
    near = np.array([[k, *(c for c in range(len(centroids)) if c != k)] for k in range(len(centroids))], np.uint16)
    zeros = np.zeros(len(centroids))
    distances = np.zeros(len(vectors), np.float32)
    return Clustering(data, centroids, labels, distances, near, members, edges, zeros, zeros.copy())


def test_vectors_go_to_the_centroid_of_the_smallest_error_and_centroids_to_the_best_place():
    rng = np.random.default_rng(2)
    count, clusters, degree = 300, 7, 2
    directions, weights = seen_directions(count, 0.3, seed=3)
    metric = metric_of(directions, weights, degree)
    vectors = rng.normal(size=(count, 3 * SH_REST_COUNTS[degree])).astype(np.float32)
    centroids = rng.normal(size=(clusters, vectors.shape[1])).astype(np.float32)
    state = clustering(
        vectors, rng.integers(0, clusters - 1, count).astype(np.int32), centroids, np.ones(count, np.float32)
    )
    with Workers(1) as pool:
        metric.reassign(state, pool)
        each = [direct_errors(vectors - centroid, directions, weights, degree) for centroid in centroids]
        np.testing.assert_array_equal(state.labels, np.argmin(each, axis=0))
        empty = np.flatnonzero(np.bincount(state.labels, minlength=clusters) == 0)
        before = state.centroids.copy()
        metric.move_centroids(state, pool)
    np.testing.assert_array_equal(state.centroids[empty], before[empty])

    def total(moved):
        return direct_errors(vectors - moved[state.labels], directions, weights, degree).sum()

    best = total(state.centroids)
    for seed in range(5):
        step = np.random.default_rng(seed).normal(size=centroids.shape).astype(np.float32)
        assert total(state.centroids + 0.02 * step) > best
        assert total(state.centroids - 0.02 * step) > best


def test_clustering_under_the_metric_errs_less_where_cameras_are_and_does_not_depend_on_threads():
    rng = np.random.default_rng(4)
    count, degree = 3000, 3
    directions, weights = seen_directions(count, 0.2, seed=5)
    metric = metric_of(directions, weights, degree)
    own = 3 * SH_REST_COUNTS[degree]
    vectors = (rng.normal(size=(count, 4)) @ rng.normal(size=(4, own)) + 0.1 * rng.normal(size=(count, own))).astype(
        "f4"
    )
    ones = np.ones(count, np.float32)
    found = {}
    for name, used, threads in (("plain", None, 1), ("metric", metric, 1), ("threads", metric, 3)):
        with Workers(threads) as pool:
            clusters = kmeans.fit(vectors, np.arange(count), ones, 64, SETTINGS, pool, lattice=0.0, metric=used)
        found[name] = vectors - clusters.centroids[clusters.labels]
    np.testing.assert_array_equal(found["metric"], found["threads"])
    errors = {name: direct_errors(lost, directions, weights, degree).sum() for name, lost in found.items()}
    assert errors["metric"] < 0.97 * errors["plain"]
    assert np.square(found["metric"]).sum() > np.square(found["plain"]).sum()


@pytest.mark.quick(0)
def test_a_capture_makes_the_codebook_better_from_where_it_looks(monkeypatch):
    scene = kissgs.sample_scene(8000, sh_degree=3)
    views = cameras(test=4, train=16, size=(120, 80))
    found = []
    for with_metric in (True, False):
        if not with_metric:
            monkeypatch.setattr(ShMetric, "of", lambda sensitivity, degree: None)
        result = kissgs.compress(scene, settings=kissgs.Settings.from_preset("balanced"), views=views, threads=1)
        evaluation = kissgs.evaluate(scene, kissgs.decompress(result.to_zip()), views)
        psnrs = [each.mean.candidate_vs_reference.psnr for each in (evaluation, evaluation.surroundings)]
        found.append((result.report.container_bytes, *psnrs))
    (size, psnr, elsewhere), (plain_size, plain_psnr, plain_elsewhere) = found
    growth = 20 * np.log10(size / plain_size)  # 6 dB for twice the bytes
    assert psnr - growth > plain_psnr + 0.1
    assert elsewhere - growth > plain_elsewhere - 0.5


@pytest.mark.parametrize("captured", [0.0, 1.0])
def test_the_size_of_the_codebook_grows_only_where_a_capture_has_seen(captured):
    scene = kissgs.sample_scene(2000, sh_degree=2)
    rows, settings = np.arange(2000), kissgs.Settings.from_preset("balanced").encode
    plain = replace(Sensitivity.none(2000, 2), color_weight=np.ones(2000, np.float32))
    known = replace(
        Sensitivity.none(2000, 2, captured=True),
        color_weight=plain.color_weight,
        captured=np.full(2000, captured, np.float32),
    )
    with Workers(1) as pool:
        found, wanted = (codebook_error_model(scene, rows, each, settings, pool) for each in (known, plain))
    if captured:
        assert found.weighted != pytest.approx(wanted.weighted, rel=0.1)
    else:
        assert found.weighted == pytest.approx(wanted.weighted, rel=0.05)


def test_memory_does_not_grow_with_the_largest_cluster():
    count, degree = 40_000, 3
    vectors = np.zeros((count, 3 * SH_REST_COUNTS[degree]), np.float32)
    vectors[:20] = np.random.default_rng(0).normal(size=(20, vectors.shape[1]))
    metric = ShMetric.of(Sensitivity.none(count, degree, captured=True), degree)
    centroids = np.stack([np.zeros(vectors.shape[1], np.float32), vectors[0]])
    state = clustering(vectors, np.zeros(count, np.int32), centroids, np.ones(count, np.float32))

    def improve():
        with Workers(1) as pool:
            metric.reassign(state, pool)
            metric.move_centroids(state, pool)

    assert takes_less_than(16e6, improve)  # the forms of all vectors take 36 MB
    assert state.labels[0] == 1


def test_a_single_vector_is_its_own_centroid():
    directions, weights = seen_directions(3, 0.3)
    vectors = np.random.default_rng(0).normal(0, 1e9, (3, 9)).astype(np.float32)
    state = clustering(vectors, np.arange(3, dtype=np.int32), np.zeros((3, 9), np.float32), np.ones(3, np.float32))
    with Workers(1) as pool:
        metric_of(directions, weights, 1).move_centroids(state, pool)
    np.testing.assert_array_equal(state.centroids, vectors)
