"""Fixtures: a runner on this machine, and one on a Ray cluster of two nodes."""

from importlib.util import find_spec

import pytest
from helpers.ray_cluster import PATHS, RayCluster
from helpers.running import processors, wait_until

from kissgs.runners.process import LocalRunner


@pytest.fixture(autouse=True, scope="package")
def _find_helpers():
    """Let the processes of items import ``helpers.runner_items``."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", PATHS)
        yield


@pytest.fixture(scope="package")  # not to the end of all tests: its processes take time while they wait
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


@pytest.fixture(scope="package")
def ray_runner(ray_cluster):
    from kissgs.runners.ray_runner import RayRunner

    runner = RayRunner(ray_cluster.address)
    yield runner
    runner.close()


@pytest.fixture
def whole_cluster(ray_cluster, ray_runner):
    """The cluster, with both nodes before and after the test."""
    wait_until(lambda: processors(ray_runner) == 2)
    yield ray_cluster
    ray_cluster.restore()
    wait_until(lambda: processors(ray_runner) == 2)


@pytest.fixture(scope="package")
def local_runner(_find_helpers):
    runner = LocalRunner()
    yield runner
    runner.close()


@pytest.fixture(params=["local", "ray"])
def runner(request):
    """Each runner, on Ray when all of its nodes can run items."""
    found = request.getfixturevalue(f"{request.param}_runner")
    wait_until(lambda: request.param == "local" or processors(found) == 2)
    return found
