"""Fixtures: a shared service, new services, and a PostgreSQL server."""

import itertools
import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest
import sqlalchemy as sa
from helpers.data_folders import jobs_folder, no_variables, sample_folder  # noqa: F401
from helpers.preview_browser import preview, software_browser  # noqa: F401
from helpers.s3_server import S3Server
from helpers.service import Replicas, Service

from service.core.models import Base
from service.storage.replicas import ReplicaBase

CONFORMANCE = {"test_jobs": True, "test_refusals": False, "test_keys": False, "test_format_option": False}
"""Modules whose tests run for each deployment; whether ``make test`` runs them with two replicas."""

DEPLOYMENTS = {"folder": 0, "bucket": 1, "replicas": 2}
"""Number of replicas of each deployment; without one, a data folder and SQLite."""


def pytest_generate_tests(metafunc):
    quick = CONFORMANCE.get(metafunc.module.__name__.rpartition(".")[2])
    if quick is not None and "deployment" in metafunc.fixturenames:
        chosen = [
            pytest.param(name, marks=() if name == "folder" or (quick and name == "replicas") else _EXHAUSTIVE)
            for name in DEPLOYMENTS
        ]
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
    return lambda folder, **settings: Replicas(folder, count, server.bucket(), new_database(), **settings)


@pytest.fixture(scope="package")
def service(tmp_path_factory, deploy):
    """Service shared by tests that do not restart it."""
    with deploy(
        tmp_path_factory.mktemp("shared") / "data", KISSGS_MAX_UPLOAD_BYTES="4MB", KISSGS_MAX_GAUSSIANS=20000
    ) as it:
        yield it


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


def programs():
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


@pytest.fixture(scope="session")
def postgresql_server():
    """A PostgreSQL server for the tests, if its programs are installed."""
    binaries = programs()
    if binaries is None:
        pytest.skip("PostgreSQL is not installed")
    folder = Path(tempfile.mkdtemp(prefix="kissgs-postgresql-"))  # other users cannot open pytest's folders
    user = {}
    if os.geteuid() == 0:  # PostgreSQL refuses to run as root
        try:
            account = pwd.getpwnam("postgres")
        except KeyError:
            pytest.skip("PostgreSQL does not run as root, and there is no user postgres")
        user = {"user": "postgres", "group": account.pw_gid}
        os.chown(folder, account.pw_uid, account.pw_gid)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    data, settings = folder / "data", f"listen_addresses=127.0.0.1 -c unix_socket_directories={folder} -c fsync=off"

    def run(program, *arguments):
        with (folder / "log").open("ab") as log:  # the server would keep a pipe open
            subprocess.run([binaries / program, "-D", data, *arguments], cwd=folder, check=True, stdout=log, **user)

    run("initdb", "-A", "trust", "-U", "postgres", "-E", "UTF8", "--no-sync")
    run("pg_ctl", "-w", "-l", folder / "server.log", "-o", f"-p {port} -c {settings}", "start")
    yield f"postgresql+psycopg://postgres@127.0.0.1:{port}/postgres"
    run("pg_ctl", "-w", "-m", "immediate", "stop")
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def new_database(postgresql_server):
    """``new_database()`` creates a database and returns its URL."""
    numbers = itertools.count(1)

    def create():
        name = f"jobs{next(numbers)}"
        engine = sa.create_engine(postgresql_server, isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.exec_driver_sql(f"CREATE DATABASE {name}")
        engine.dispose()
        return postgresql_server.rpartition("/")[0] + f"/{name}"

    return create


@pytest.fixture
def postgresql(postgresql_server):
    """URL of a database without tables."""
    yield postgresql_server
    engine = sa.create_engine(postgresql_server)
    ReplicaBase.metadata.drop_all(engine)
    Base.metadata.drop_all(engine)
    engine.dispose()


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory):
    """A server with the interface of Amazon S3, if its program is installed."""
    pytest.importorskip("obstore")
    with S3Server(tmp_path_factory.mktemp("s3")) as server:
        yield server


@pytest.fixture
def bucket(s3_server):
    """A new bucket."""
    return s3_server.bucket()
