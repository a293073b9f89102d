"""Fixtures of servers that tests share: PostgreSQL, one with the interface of S3, and a Ray cluster."""

import itertools
import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest
import sqlalchemy as sa

from helpers.ray_cluster import RayCluster
from helpers.s3_server import S3Server


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
    """``new_database()`` creates a database and returns its URL; ``encoding`` is UTF8 by default."""
    numbers = itertools.count(1)

    def create(encoding="UTF8"):
        name = f"jobs{next(numbers)}"
        engine = sa.create_engine(postgresql_server, isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.exec_driver_sql(f"CREATE DATABASE {name} ENCODING '{encoding}' LOCALE 'C' TEMPLATE template0")
        engine.dispose()
        return postgresql_server.rpartition("/")[0] + f"/{name}"

    return create


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory):
    """A server with the interface of Amazon S3, if its program is installed."""
    pytest.importorskip("obstore")
    with S3Server(tmp_path_factory.mktemp("s3")) as server:
        yield server


@pytest.fixture(scope="session")
def ray_cluster():
    """A Ray cluster of two nodes of one processor each."""
    if find_spec("ray") is None:
        pytest.skip("Ray is not installed (pip install 'kissgs[ray]')")
    with RayCluster() as cluster, pytest.MonkeyPatch.context() as patch:
        for name, value in cluster.environment.items():
            patch.setenv(name, value)
        cluster.add_node()
        cluster.add_node()
        yield cluster
