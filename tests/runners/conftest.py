"""Fixtures: a runner on this machine, and one on a Ray cluster of two nodes."""

from importlib.util import find_spec

import pytest
from helpers.ray_cluster import NODE_MEMORY, PATHS, RayCluster
from helpers.running import wait_until

from kissgs.runners.contract import Resources
from kissgs.runners.local import LocalRunner


@pytest.fixture(autouse=True, scope="session")
def _find_helpers():
    """Let the processes of items import ``helpers.runner_items``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", PATHS)
        yield


@pytest.fixture(scope="session")
def ray_cluster(_find_helpers):
    """A Ray cluster of two nodes of one processor each."""
    if find_spec("ray") is None:
        pytest.skip("Ray is not installed (pip install 'kissgs[ray]')")
    with RayCluster() as cluster, pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.environment.items():
            patch.setenv(name, value)
        cluster.add_node()
        cluster.add_node()
        yield cluster


@pytest.fixture(scope="session")
def ray_runner(ray_cluster):
    from kissgs.runners.ray_runner import RayRunner

    runner = RayRunner(ray_cluster.address)
    yield runner
    runner.close()


@pytest.fixture(scope="session")
def local_runner(_find_helpers):
    runner = LocalRunner(Resources(cpus=2, memory=NODE_MEMORY))
    yield runner
    runner.close()


@pytest.fixture(params=["local", "ray"])
def runner(request):
    """Each runner, with two processors in all, when all of its nodes can run items."""
    found = request.getfixturevalue(f"{request.param}_runner")
    wait_until(lambda: found.stats().cpus == 2)
    return found
