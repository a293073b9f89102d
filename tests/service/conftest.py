"""Fixtures: a shared service, and new services, for each deployment."""

import contextlib
import os

import pytest
import sqlalchemy as sa
from helpers.data_folders import jobs_folder, no_variables, sample_folder  # noqa: F401
from helpers.preview_browser import preview, software_browser  # noqa: F401
from helpers.ray_service import RayReplicas
from helpers.service import SMALL, Replicas, Service

import kissgs
from service.core.models import Base
from service.core.settings import ServiceSettings
from service.http.app import build
from service.storage.replicas import Replica, ReplicaBase

CONFORMANCE = {
    *("test_jobs", "test_job_results", "test_job_states", "test_synchronous"),
    *("test_refusals", "test_keys", "test_format_option"),
}
"""Modules whose tests run for each deployment, but in ``make test`` for the first alone."""

DEPLOYMENTS = {"folder": 0, "bucket": 1, "replicas": 2, "ray": 2}
"""Number of replicas of each deployment; without one, a data folder and SQLite. Jobs of the last run on a cluster."""


def pytest_generate_tests(metafunc):
    if metafunc.module.__name__.rpartition(".")[2] in CONFORMANCE and "deployment" in metafunc.fixturenames:
        chosen = [pytest.param(name, marks=() if name == "folder" else _EXHAUSTIVE) for name in DEPLOYMENTS]
        metafunc.parametrize("deployment", chosen, indirect=True, scope="package")


_EXHAUSTIVE = pytest.mark.exhaustive


@pytest.fixture(scope="package")
def deployment(request):
    """Name of the deployment, one of DEPLOYMENTS."""
    return getattr(request, "param", "folder")


@pytest.fixture(scope="package")
def deploy(request, deployment):
    """``deploy(folder, KISSGS_X=…)`` makes a service."""
    count = DEPLOYMENTS[deployment]
    if not count:
        return Service
    server, new_database = request.getfixturevalue("s3_server"), request.getfixturevalue("new_database")
    if deployment == "ray":
        cluster = request.getfixturevalue("ray_cluster")
        return lambda folder, **settings: RayReplicas(folder, cluster, server.bucket(), new_database(), **settings)
    return lambda folder, **settings: Replicas(folder, count, server.bucket(), new_database(), **settings)


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


@pytest.fixture
def postgresql(postgresql_server):
    """URL of a database without tables."""
    yield postgresql_server
    engine = sa.create_engine(postgresql_server)
    ReplicaBase.metadata.drop_all(engine)
    Base.metadata.drop_all(engine)
    engine.dispose()


@pytest.fixture
def bucket(s3_server):
    """A new bucket."""
    return s3_server.bucket()


@pytest.fixture
def two(tmp_path, bucket, new_database):
    """Two replicas."""
    with Replicas(tmp_path / "two", 2, bucket, new_database()) as it:
        yield it


@pytest.fixture
def member(tmp_path, bucket, new_database, monkeypatch):
    """``member()`` opens a replica in this process; ``member.die(context)`` makes it one of an ended process."""
    for name in os.environ:
        if name.startswith(("KISSGS_", "AWS_")):
            monkeypatch.delenv(name)
    variables = {**bucket.variables, "KISSGS_DATABASE_URL": new_database()}
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    opened = []

    def join():
        context = build(ServiceSettings(data_dir=tmp_path / f"member{len(opened)}"))
        opened.append(context)
        set_process(context, os.getppid())  # else it would be taken for a former process with the same number
        return context

    def set_process(context, number):
        with context.store._writing.begin() as session:
            session.get(Replica, context.store.replica).process = number

    def die(context):
        set_process(context, 2**22 + 1)
        return context.store.replica

    join.die = die
    yield join
    for context in opened:
        with contextlib.suppress(Exception):
            context.store.close()
        context.storage.close()
