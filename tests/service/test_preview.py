"""The preview page as served; oracle: its files, and for the content security policy Chromium."""

import asyncio
import base64
import hashlib
import shutil
from pathlib import Path

import httpx
import pytest
from helpers.service import keys_of, problem, read_response

from service.core.settings import ServiceSettings
from service.http.app import create_app
from service.http.routes import page

IMPORTS = '\n{"imports": {"three": "./vendor/three/build/three.module.min.js"}}\n'
FILES = {
    "preview.html": f'<script type="importmap">{IMPORTS}</script>\n<script type="module" src="./x.js"></script>',
    "preview.js": "js",
    "preview.css": "css",
    "preview/scene-parts.js": "js",
    "vendor/versions.json": "{}",
    "vendor/three/LICENSE": "MIT",
    "vendor/three/build/three.module.min.js": "three",
}
UNSERVED = (
    *("package.json", "README.md", ".npmrc", "webp.test.js", "eslint.config.js", "tests/webp.js", "preview/tests/x.js"),
    *("vendor-lock/package.json", "vendor/three/package.json", "vendor/.hidden/x.js", "node_modules/three/x.js"),
    *("preview/preview.html", "../outside.js", "vendor/../../outside.js"),
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Copy of web_decoder with small files, some of which must not be served."""
    folder = tmp_path / "web_decoder"
    for name in (*FILES, *UNSERVED):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(FILES.get(name, "secret"))
    monkeypatch.setattr(page, "WEB_DECODER", folder)
    return folder


@pytest.fixture(scope="module")
def app(tmp_path_factory):
    app = create_app(ServiceSettings(data_dir=tmp_path_factory.mktemp("app") / "data"))
    yield app
    app.state.context.close()


@pytest.fixture
def ask(app, folder):
    """``ask(path)`` sends a request to an application that serves this folder."""

    def request(path, method="GET", **headers):
        async def once():
            transport = httpx.ASGITransport(app)
            async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
                return await client.request(method, path, headers=headers)

        return asyncio.run(once())

    return request


def stable_headers(answer):
    return {name: value for name, value in answer.headers.items() if name not in ("date", "x-request-id")}


@pytest.mark.parametrize("path", ["/preview/", "/preview/preview.html", "/preview/" + "0a" * 16])
def test_the_page_and_its_policy(ask, path):
    """Chromium draws with this policy in test_preview_page.py."""
    answer = ask(path)
    assert (answer.status_code, answer.text) == (200, FILES["preview.html"])
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["cache-control"] == "no-cache"
    assert answer.headers["x-content-type-options"] == "nosniff"
    policy = dict(part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; "))
    digest = base64.b64encode(hashlib.sha256(IMPORTS.encode()).digest()).decode()
    assert policy.pop("script-src") == f"'self' 'wasm-unsafe-eval' 'sha256-{digest}'"
    assert policy.pop("worker-src") == "'self' blob:"
    assert policy.pop("img-src") == "'self' data:"
    assert {policy.pop(name) for name in ("style-src", "connect-src")} == {"'self'"}
    assert policy == dict.fromkeys(("default-src", "form-action", "base-uri", "frame-ancestors"), "'none'")
    assert stable_headers(ask(path, "HEAD")) == stable_headers(answer)


def test_the_policy_follows_the_page(ask, folder):
    """Browsers hash the text with normalised line ends."""
    before = ask("/preview/").headers["content-security-policy"]
    (folder / "preview.html").write_bytes(FILES["preview.html"].replace("\n", "\r\n").encode())
    assert ask("/preview/").headers["content-security-policy"] == before
    (folder / "preview.html").write_text(FILES["preview.html"].replace("three.module", "three.other"))
    assert ask("/preview/").headers["content-security-policy"] != before


MEDIA_TYPES = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8", ".json": "application/json"}


@pytest.mark.parametrize("name", [name for name in FILES if name != "preview.html"])
def test_served_files(ask, name):
    answer = ask(f"/preview/{name}")
    assert (answer.status_code, answer.text) == (200, FILES[name])
    assert answer.headers["content-type"] == MEDIA_TYPES.get(Path(name).suffix, "text/plain; charset=utf-8")
    assert answer.headers["cache-control"] == "no-cache"
    assert "unsafe" not in answer.headers["content-security-policy"]
    same = ask(f"/preview/{name}", **{"If-None-Match": answer.headers["etag"]})
    assert (same.status_code, same.content, same.headers["cache-control"]) == (304, b"", "no-cache")
    assert stable_headers(ask(f"/preview/{name}", "HEAD")) == stable_headers(answer)


def test_other_paths_are_not_served(ask):
    for name in (*UNSERVED, "none.js", "0a" * 15, "0A" * 16, "0a" * 16 + "/", "preview"):
        for written in {name, name.replace("..", "%2e%2e"), name.replace("/", "%2F")}:
            answer = ask(f"/preview/{written}")
            problem(answer, 404, "not-found")
            assert "secret" not in answer.text
            assert ask(f"/preview/{written}", "HEAD").status_code == 404


def test_missing_files_are_not_found(ask, folder):
    """The service works without the vendor folder and without the page."""
    shutil.rmtree(folder / "vendor")
    problem(ask("/preview/vendor/three/build/three.module.min.js"), 404, "not-found")
    assert ask("/preview/").status_code == 200
    shutil.rmtree(folder)
    assert "without its preview page" in problem(ask("/preview/"), 404, "not-found")["detail"]
    problem(ask("/preview/preview.js"), 404, "not-found")


def test_redirect_to_the_folder(ask):
    for method in ("GET", "HEAD"):
        answer = ask("/preview", method)
        assert (answer.status_code, answer.headers["location"]) == (307, "preview/")
    answer = ask("/preview/", "POST")
    problem(answer, 405, "method-not-allowed")
    assert answer.headers["allow"] == "GET, HEAD"


def test_paths_outside_the_folder(service):
    """The request is written to the socket, because clients normalise paths."""
    for path in (
        *("../v1/limits", "../../pyproject.toml", "%2e%2e/pyproject.toml", "vendor/../../pyproject.toml"),
        *("%2Fetc%2Fpasswd", "/etc/passwd", "..%2f..%2fetc/passwd", "..%5c..%5cpyproject.toml"),
        *("preview.js%00.css", "vendor/%2e%2e/%2e%2e/service/app.py"),
    ):
        request = f"GET /preview/{path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
        with service.raw(request.encode()) as connection:
            answer = read_response(connection)
        assert answer.startswith((b"HTTP/1.1 404", b"HTTP/1.1 400")), path
        assert b"[project]" not in answer


def test_the_page_does_not_reveal_whether_a_job_exists(start):
    """The response is the same for an existing and a missing job, without a key."""
    service = start(KISSGS_KEYS=keys_of(alice="secret"))
    job = service.submit(Authorization="Bearer secret")
    existing, missing = (service.http.get(f"/preview/{id}") for id in (job["id"], "0" * 32))
    assert existing.status_code == missing.status_code == 200
    assert existing.content == missing.content
    assert stable_headers(existing) == stable_headers(missing)
