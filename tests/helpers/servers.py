"""Fixture of a Ray cluster that tests share."""

from importlib.util import find_spec

import pytest

from helpers.ray_cluster import RayCluster


@pytest.fixture(scope="session")
def ray_cluster():
    """A Ray cluster of two nodes of one processor each."""
    if find_spec("ray") is None:
        pytest.skip("Ray is not installed (pip install ray)")
    with RayCluster() as cluster, pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.environment.items():
            patch.setenv(name, value)
        cluster.add_node()
        cluster.add_node()
        yield cluster
