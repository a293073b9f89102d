"""Chromium without WebGL, and common actions of the tests of the service's page."""

import json
from urllib.parse import parse_qs, urlsplit

import pytest

from helpers.viewers import NO_GPU, chromium


@pytest.fixture(scope="module")
def browser():
    with chromium(NO_GPU) as browser:
        yield browser


@pytest.fixture
def visit(browser, service):
    """``visit(at=service)`` opens the page; errors and requests to other hosts fail the test."""
    contexts, errors = [], []

    def begin(at=service, **options):
        context = browser.new_context(**options)
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(20_000)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda line: errors.append(line.text) if "Content Security Policy" in line.text else None)
        page.on("request", lambda sent: errors.append(sent.url) if not sent.url.startswith((at.url, "blob:")) else None)
        page.goto(at.url)
        return page

    yield begin
    for context in contexts:
        context.close()
    assert errors == []


def sent_options(page):
    """Send the form in vain; return the options of the job."""
    page.route("**/v1/jobs?**", lambda route: route.abort())
    with page.expect_request("**/v1/jobs?**") as sent:
        page.get_by_role("button", name="Compress").click()
    return json.loads(parse_qs(urlsplit(sent.value.url).query)["options"][0])
