"""Fixtures that all tests of the browser's side share: a browser and an HTTP server."""

import pytest
from helpers.viewers import chromium
from helpers.web_tools import Site


@pytest.fixture(scope="package")
def browser():
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="package")
def site():
    site = Site()
    yield site
    site.close()
