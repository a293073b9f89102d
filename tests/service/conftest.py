"""Fixtures: a shared service, and new services, for each deployment."""

import pytest
from helpers.data_folders import jobs_folder, no_variables, sample_folder  # noqa: F401
from helpers.preview_browser import preview, software_browser  # noqa: F401
from helpers.ray_service import RayService
from helpers.service import SMALL, Service

import kissgs

CONFORMANCE = {
    *("test_jobs", "test_job_results", "test_job_states", "test_synchronous"),
    *("test_refusals", "test_keys", "test_format_option"),
}
"""Modules whose tests run for each deployment, but in ``make test`` for the first alone."""

DEPLOYMENTS = ("local", "ray")
"""Jobs run on this machine, or on the nodes of a cluster, which do not see the data folder."""


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__.rpartition(".")[2] in CONFORMANCE and "deployment" in metafunc.fixturenames:
        chosen = [pytest.param(name, marks=() if name == "local" else _EXHAUSTIVE) for name in DEPLOYMENTS]
        metafunc.parametrize("deployment", chosen, indirect=True, scope="package")


_EXHAUSTIVE = pytest.mark.exhaustive


@pytest.fixture(scope="package")
def deployment(request):
    """Name of the deployment, one of DEPLOYMENTS."""
    return getattr(request, "param", "local")


@pytest.fixture(scope="package")
def deploy(request, deployment):
    """``deploy(folder, KISSGS_X=…)`` makes a service."""
    if deployment == "local":
        return Service
    cluster = request.getfixturevalue("ray_cluster")
    return lambda folder, **settings: RayService(folder, cluster, **settings)


@pytest.fixture(scope="package")
def service(tmp_path_factory, deploy):
    """Service shared by tests that do not restart it."""
    with deploy(
        tmp_path_factory.mktemp("shared") / "data", KISSGS_MAX_UPLOAD_BYTES="4MB", KISSGS_MAX_GAUSSIANS=20000
    ) as it:
        yield it


@pytest.fixture(scope="module")
def job(service):
    """Status of a job that has succeeded."""
    return service.ended(service.submit())


@pytest.fixture(scope="module")
def local():
    """Compress the scene without a service."""
    return kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"))


@pytest.fixture
def start(tmp_path, deploy):
    """``start(KISSGS_X=…)`` starts a service, which ends with the test."""
    started = []

    def begin(**settings):
        folder = tmp_path / f"data{len(started)}"
        started.append(deploy(folder, **settings))
        return started[-1].start()

    yield begin
    for service in started:
        service.__exit__()
