"""Data folders with jobs, and services in this process, without an HTTP server."""

import contextlib
import os
import shutil
import sqlite3
import uuid

import pytest

from service.core.models import Job, State
from service.core.settings import ServiceSettings
from service.jobs.container import ServiceContainer


@pytest.fixture
def no_variables(monkeypatch):
    """Remove the service's variables from the environment."""
    for name in os.environ:
        if name.startswith("KISSGS_"):
            monkeypatch.delenv(name)


def opened(folder):
    return ServiceContainer(ServiceSettings(data_dir=folder))


@contextlib.contextmanager
def service(folder):
    context = opened(folder)
    try:
        yield context
    finally:
        context.close()


def swept(context):
    """Remove what has expired, as if the service had run for long; return the ids of the jobs."""
    context.began = 0.0
    return context.sweep()


def add_a_row(store, owner="", *, max_queue=10, max_owner=3, **values):
    """Add a queued job to the table alone; return it."""
    fixed = {"name": "scene", "options": {"preset": "fast"}, "preset": "fast", "evaluate": False}
    fixed |= {"gaussians": 20_000, "sh_degree": 1, "upload_sha256": "0" * 64, "fingerprint": "f"}
    fixed |= {"upload_bytes": 5_000_000_000, "disk_bytes": 3_000_000_000}
    job = Job(id=uuid.uuid4().hex, owner=owner, **{**fixed, **values})
    return store.add(job, max_queue=max_queue, max_owner=max_owner)


def add_a_job(context, scene=b"ply"):
    """Add a queued job; return its id."""
    sizes = {"gaussians": 3, "upload_bytes": len(scene), "disk_bytes": len(scene)}
    job_id = add_a_row(context.store, max_queue=1000, max_owner=1000, **sizes).id
    upload = context.storage.new_upload()
    upload.write_bytes(scene)
    context.storage.adopt(upload, job_id)
    return job_id


def finish_a_job(context, state=State.SUCCEEDED):
    """Add a job that has succeeded, or that has also expired; return its id."""
    job_id = add_a_job(context)
    result = context.storage.result(job_id)
    result.mkdir()
    (result / "scene.zip").write_bytes(b"PK")
    number = context.store.claim().number
    context.store.move(number, State.SUCCEEDED, expires_at=context.clock() + 1000, result={"a": "b" * 1000})
    if state == State.EXPIRED:
        context.store.move(number, state)
    return job_id


@pytest.fixture(scope="module")
def sample_folder(tmp_path_factory):
    """Data folder with 12 succeeded jobs, whose database has several pages."""
    folder = tmp_path_factory.mktemp("sample") / "data"
    with service(folder) as context:
        for _ in range(12):
            finish_a_job(context)
    return folder


@pytest.fixture
def jobs_folder(sample_folder, tmp_path):
    shutil.copytree(sample_folder, tmp_path / "data")
    return tmp_path / "data"


def listing(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def names(folder):
    return {path.name for path in folder.iterdir()}


def database(folder, *statements):
    with contextlib.closing(sqlite3.connect(folder / "jobs.sqlite", timeout=300)) as found, found:
        for statement in statements:
            found.execute(statement)
