"""Oracle: distances to every centroid by brute force, a plain Lloyd k-means, and errors of clusters, all in NumPy."""

import numpy as np
import pytest
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st

from kissgs import Settings, sample_scene
from kissgs.core.context import Workers, blas_workers
from kissgs.planning import kmeans_kernels as kernels
from kissgs.planning.kmeans import allocate, assign, fit, near_centroids, sorted_by_label
from kissgs.planning.sh_codebook import codebook_side, nearest_square


def run(vectors, size, weights=None, threads=1, lattice=0.0, report=lambda fraction: None, **changes):
    weights = np.ones(len(vectors), np.float32) if weights is None else weights.astype(np.float32)
    settings = Settings.research("balanced", **{"sh_neighbors": 512, "sh_tolerance": 0.0, **changes}).encode
    with blas_workers(threads) as pool:
        return fit(vectors, np.arange(len(vectors)), weights, size, settings, pool, lattice=lattice, report=report)


def blobs(count=3000, dimensions=6, seed=0):
    """Vectors that cluster, with a tail."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(size=(40, dimensions)) * rng.exponential(1, (40, 1))
    return (centres[rng.integers(0, 40, count)] + rng.normal(0, 0.2, (count, dimensions))).astype(np.float32)


def squared_distances(vectors, centroids):
    return np.square(vectors[:, None].astype(np.float64) - centroids).sum(axis=2)


def error(vectors, clusters, weights=None):
    return np.average(np.square(vectors - clusters.centroids[clusters.labels]).sum(axis=1), weights=weights)


def lloyd(vectors, size, iterations=15, seed=0):
    """Mean squared error of the textbook's k-means from a random start."""
    start = np.random.default_rng(seed).choice(len(vectors), size, replace=False)
    centroids = vectors[start].astype(np.float64)
    for _ in range(iterations):
        labels = squared_distances(vectors, centroids).argmin(axis=1)
        for k in np.unique(labels):
            centroids[k] = vectors[labels == k].mean(axis=0)
    return squared_distances(vectors, centroids).min(axis=1).mean()


@examples(50)
@given(st.integers(1, 3000), st.integers(1, 50), st.integers(1, 8), st.integers(0, 1000))
def test_assign_finds_the_nearest_centroid(count, size, dimensions, seed):
    rng = np.random.default_rng(seed)
    vectors, centroids = (rng.normal(size=(n, dimensions)).astype(np.float32) for n in (count, size))
    labels, distances = assign(vectors, centroids)
    wanted = squared_distances(vectors, centroids)
    np.testing.assert_allclose(wanted[np.arange(count), labels], wanted.min(axis=1), atol=1e-5)
    np.testing.assert_allclose(distances, wanted.min(axis=1), atol=1e-5)


@pytest.mark.parametrize("offset", [0, 10])
def test_labels_are_the_nearest_of_all_where_reach_is_unlimited(offset):
    """A lattice chooses the labels after the last update of the centroids, and nothing may change afterwards."""
    vectors = blobs() + np.float32(offset)
    clusters = run(vectors, 64, lattice=0.5)
    distances = squared_distances(vectors, clusters.centroids)
    found = distances[np.arange(len(vectors)), clusters.labels]
    np.testing.assert_allclose(found, distances.min(axis=1), atol=1e-5 * (1 + offset**2))


@pytest.mark.parametrize(("made", "size"), [("noise", 64), ("sh", 64)])
def test_as_good_as_plain_lloyd(made, size):
    if made == "noise":
        vectors = np.random.default_rng(0).normal(size=(2000, 6)).astype(np.float32)
    else:
        vectors = sample_scene(1000, sh_degree=1).shN.reshape(1000, 9)
    best = min(lloyd(vectors, size, seed=seed) for seed in range(2))
    assert error(vectors, run(vectors, size, sh_kmeans_iterations=8)) < 1.03 * best


def test_a_short_reach_costs_little():
    vectors = blobs(5000)
    assert error(vectors, run(vectors, 100, sh_neighbors=8, sh_kmeans_iterations=2)) < 1.15 * error(
        vectors, run(vectors, 100)
    )


def test_weights_move_the_error():
    vectors, first = blobs(), np.arange(3000) < 1000
    favoured, neglected = (np.where(mask, 20, 0.1) for mask in (first, ~first))
    errors = [error(vectors, run(vectors, 300, weights), first) for weights in (favoured, neglected)]
    assert errors[0] < 0.8 * errors[1]


def test_the_codebook_is_used_up_but_not_exceeded():
    clusters = run(blobs(), 100)
    assert 90 <= len(clusters.centroids) <= 100
    assert set(clusters.labels) == set(range(len(clusters.centroids)))


def test_centroids_are_the_means_of_their_vectors():
    vectors, weights = blobs(2000), np.random.default_rng(3).uniform(0.1, 20, 2000).astype(np.float32)
    clusters = run(vectors, 50, weights)
    for k, centroid in enumerate(clusters.centroids):
        mine = clusters.labels == k
        np.testing.assert_allclose(centroid, np.average(vectors[mine], axis=0, weights=weights[mine]), atol=1e-5)


@pytest.mark.parametrize(
    ("vectors", "centroids"),
    [
        (blobs(1), 1),
        (blobs(64), 64),
        (np.repeat(blobs(10), 30, axis=0), 10),
        (np.full((100, 3), 7, np.float32), 1),
        (np.zeros((1, 1), np.float32), 1),
    ],
)
def test_as_many_centroids_as_different_vectors_are_exact(vectors, centroids):
    clusters = run(vectors, max(64, len(vectors)))
    assert len(clusters.centroids) == centroids
    assert (clusters.centroids[clusters.labels] == vectors).all()
    assert error(vectors, run(vectors, 64)) < 1e-9


def test_nothing_is_split_below_the_tolerance():
    vectors = np.random.default_rng(1).normal(3, 0.01, (1000, 4)).astype(np.float32)
    assert len(run(vectors, 64, sh_tolerance=0.02).centroids) == 1
    assert len(run(vectors, 64, sh_tolerance=0.001).centroids) > 1
    np.testing.assert_allclose(run(blobs(2000), 64, lattice=0.01, sh_tolerance=0.1).step, 0.2, rtol=1e-6)


@pytest.mark.parametrize(("count", "size"), [(2000, 64), (50, 64)])
@pytest.mark.parametrize("lattice", [0.3, 0.9])
def test_centroids_lie_on_the_lattice(count, size, lattice):
    vectors = blobs(count)
    clusters = run(vectors, size, lattice=lattice)
    assert clusters.step > 0
    numbers = (clusters.centroids - clusters.centroids.min(axis=0)) / np.float64(clusters.step)
    np.testing.assert_allclose(numbers, np.rint(numbers), atol=1e-3)
    assert np.ptp(np.rint(numbers), axis=0).max() <= 255, "more levels than an image has"
    widest = np.ptp(vectors, axis=0).max()
    if count > size:
        loose = error(vectors, run(vectors, size))
        np.testing.assert_allclose(clusters.step, max(lattice * (loose / 6) ** 0.5, widest / 254), rtol=0.2)
        assert error(vectors, clusters) < (1 + lattice**2 / 6) * loose
    else:
        assert clusters.step <= widest / 254 * 1.0001


def test_a_constant_dimension_is_exact():
    """The lattice once began at 0 in every dimension, and a constant one was up to half a step off."""
    vectors = blobs(2000)
    vectors[:, 2] = 0.12345
    assert (run(vectors, 64, lattice=0.9).centroids[:, 2] == np.float32(0.12345)).all()


def test_threads_and_repetition_do_not_matter_and_seeds_do():
    vectors = blobs(4000)
    fractions = []
    one, many, other = (
        run(vectors, 100, report=fractions.append),
        run(vectors, 100, threads=3),
        run(vectors, 100, seed=1),
    )
    for name in ("centroids", "labels"):
        assert (getattr(one, name) == getattr(many, name)).all()
    assert not np.array_equal(one.centroids, other.centroids)
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1


def test_the_input_is_not_modified():
    vectors, weights = blobs(500), np.ones(500, np.float32)
    before = vectors.copy()
    vectors.flags.writeable = weights.flags.writeable = False
    for size in (20, 500):
        run(vectors, size, weights, lattice=0.9)
    assert (vectors == before).all()


def test_shares_add_up_and_keep_their_bounds():
    rng = np.random.default_rng(0)
    for size in (30, 100, 5000):
        counts = rng.integers(0, 100, 30)
        errors = rng.exponential(1, 30) * counts
        errors[:5] = 0
        shares = allocate(errors, counts, size, 0.0)
        assert (shares <= counts).all()
        assert (shares >= np.minimum(counts, 1)).all()
        assert shares.sum() == min(size, np.where(errors > 0, counts, np.minimum(counts, 1)).sum())


@examples(100)
@given(st.integers(0, 10**8), st.sampled_from([1, 8, 20]))
def test_codebook_sides_follow_the_formula(count, ratio):
    side = codebook_side(count / ratio)
    assert side % 8 == 0
    assert 8 <= side <= 256
    assert side == 8 or side * side * ratio <= count
    assert side == 256 or (side + 8) ** 2 * ratio > count


@pytest.mark.parametrize(
    "vectors",
    [
        [[-1], [1], [-2], [2], [-3], [3], [10], [11]],  # cells of equal centres
        [[0], [0], [0], [0], [1], [1], [1], [1]],
        [[1e-30], [2e-30], [3e-30], [4e-30], [5e-30], [6e-30], [7e-30], [8e-30]],  # squares underflow
    ],
)
def test_each_list_of_near_centroids_holds_the_own_one_first(vectors):
    centroids, firsts = np.array(vectors, np.float32), np.array([0, 2, 4, 6, 8])
    with Workers(1) as pool:
        for count in (2, 3, 8):
            near = near_centroids(centroids, firsts, count, pool)
            assert near[:, 0].tolist() == list(range(8))
            assert all(len(set(row)) == count for row in near.tolist())


def test_the_square_nearest_to_a_size():
    sizes, wanted = (0, 1, 143, 145, 525, 625, 785, 1e6), [64, 64, 64, 256, 576, 576, 1024, 65536]
    assert [nearest_square(size) for size in sizes] == wanted


class Clusters:
    """Vectors of a table that holds others too, in twelve clusters, of which number 5 is empty."""

    def __init__(self, count=400):
        rng = np.random.default_rng(0)
        self.table = rng.normal(size=(2 * count, 7)).astype(np.float32)
        self.rows = rng.permutation(2 * count)[:count]
        self.weights = rng.uniform(0.1, 10, count).astype(np.float32)
        self.labels = rng.integers(0, 12, count).astype(np.int32)
        self.labels[self.labels == 5] = 6
        self.members, self.edges = sorted_by_label(self.labels, 12)
        self.distances = rng.random(count, np.float32)
        self.data = self.table, self.rows, self.weights, self.distances, self.members, self.edges
        self.centroids, self.totals, self.errors = np.full((12, 7), 9, np.float32), np.empty(12), np.empty(12)
        kernels.means(*self.data, 0, 12, self.centroids, self.totals, self.errors)

    def others(self, count):
        """Lists of a centroid and some others, in random order."""
        rng = np.random.default_rng(2)
        return np.array([[k, *rng.permutation(np.delete(np.arange(12), k))[:count]] for k in range(12)], np.uint16)

    def error(self, own):
        """Return the weighted squared error of some vectors about their mean."""
        vectors, weights = self.table[self.rows[own]].astype(np.float64), self.weights[own].astype(np.float64)
        return (weights * np.square(vectors - weights @ vectors / max(weights.sum(), 1e-9)).sum(axis=1)).sum()


@pytest.mark.parametrize(("count", "listed", "searched"), [(60, 8, 3), (4, 4, 9)])
def test_near_centroids_are_the_nearest_of_the_lists_searched(count, listed, searched):
    rng = np.random.default_rng(3)
    centroids = rng.normal(size=(count, 7)).astype(np.float32)
    near = np.array([[k, *rng.permutation(np.delete(np.arange(count), k))[: listed - 1]] for k in range(count)], "u2")
    squared = np.square(centroids.astype(np.float64)[:, None] - centroids).sum(axis=2)
    found = np.empty_like(near)
    kernels.find_near(centroids, near, searched, 0, count, found)
    for k in range(count):
        candidates = np.unique(near[near[k, : searched + 1]])
        wanted = candidates[np.argsort(np.where(candidates == k, -1, squared[k, candidates]))][:listed]
        assert found[k].tolist() == wanted.tolist()


def test_vectors_go_to_the_nearest_of_their_near_centroids():
    given, near = Clusters(), Clusters().others(5)
    centroids = np.random.default_rng(2).normal(size=(12, 7)).astype(np.float32)
    found, distances = given.labels.copy(), np.empty(400, np.float32)
    arrays = given.table, given.rows, given.members, given.edges
    kernels.assign_near(*arrays, centroids, near, 0, 12, found, distances)
    squared = squared_distances(given.table[given.rows], centroids)
    allowed = np.take_along_axis(squared, near[given.labels], axis=1)
    np.testing.assert_allclose(distances, allowed.min(axis=1), atol=1e-5)
    np.testing.assert_allclose(squared[np.arange(400), found], distances, atol=1e-5)
    assert all(label in near[k] for label, k in zip(found, given.labels, strict=True))


def test_merging_and_splitting_change_the_error_as_they_promise():
    """A list of near centroids holds each once, the own one first, after clusters have been relocated too."""
    given, near = Clusters(), Clusters().others(11)
    partners, costs = np.empty(12, np.int32), np.empty(12)
    kernels.merge_costs(given.centroids, given.totals, near, 0, 12, partners, costs)
    own = [given.labels == k for k in range(12)]
    for k in range(12):
        joint = [given.error(own[k] | own[j]) - given.error(own[j]) for j in range(12) if j not in (k, 5)]
        wanted = min(joint) - given.error(own[k]) if k != 5 else 0
        np.testing.assert_allclose(costs[k], wanted, rtol=1e-3, atol=1e-3)
    second, gains = np.zeros(400, np.bool_), np.empty(12)
    kernels.split_gains(*given.data, given.centroids, given.totals, given.errors, 0.0, 0, 12, second, gains)
    for k in range(12):
        wanted = given.error(own[k]) - given.error(own[k] & second) - given.error(own[k] & ~second)
        np.testing.assert_allclose(gains[k], wanted, rtol=1e-3, atol=1e-3)
    assert (gains[np.arange(12) != 5] > 0).all()

    order = [np.argsort(a, kind="stable").astype(np.int32) for a in (costs, -gains)]
    changed = given.labels.copy()
    kernels.relocate(*order, partners, costs, gains, second, given.members, given.edges, changed, near)
    assert set(changed) == set(range(12)), "the number of the empty cluster is used for a half of another"
    assert sum(given.error(changed == k) for k in range(12)) < sum(map(given.error, own))
    assert (np.sort(near, axis=1) == np.arange(12)).all()
    assert (near[:, 0] == np.arange(12)).all()
