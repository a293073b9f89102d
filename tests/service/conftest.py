"""Fixtures: a service that tests share, and new ones, whose jobs are threads (processes: see tests/runners)."""

import pytest
from helpers.data_folders import jobs_folder, no_variables, sample_folder  # noqa: F401
from helpers.page_browser import browser, visit  # noqa: F401
from helpers.preview_browser import preview, software_browser  # noqa: F401
from helpers.service import SMALL, Service, ServiceProcess

import kissgs


@pytest.fixture(scope="package")
def service(tmp_path_factory):
    """Service shared by tests that do not restart it."""
    folder = tmp_path_factory.mktemp("shared") / "data"
    with Service(folder, KISSGS_MAX_UPLOAD_BYTES="4MB", KISSGS_MAX_GAUSSIANS=20000, max_capture_files=300) as it:
        yield it


@pytest.fixture(scope="package")
def job(service):
    """Status of a job that has succeeded."""
    return service.ended(service.submit())


@pytest.fixture(scope="session")
def local():
    """Compress the scene without a service."""
    return kissgs.compress(SMALL, settings=kissgs.Settings(preset="fast"))


@pytest.fixture
def start(tmp_path):
    """``start(KISSGS_X=…)`` starts a service, with ``processes=True`` one with job processes."""
    yield from _starter(tmp_path, Service)


@pytest.fixture
def start_process(tmp_path):
    """``start_process(KISSGS_X=…)`` starts a service in a process of its own, which tests may kill."""
    yield from _starter(tmp_path, ServiceProcess)


def _starter(folder, kind):
    started = []

    def begin(**settings):
        started.append(kind(folder / f"data{len(started)}", **settings))
        return started[-1].start()

    yield begin
    for service in started:
        service.__exit__()
