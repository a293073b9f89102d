"""The server of ``kissgs view``, by requests over TCP; oracle: the files of its folder."""

import http.client
import re
import socket
import threading
import time

import pytest
from helpers.small_page import FILES, UNSERVED

from kissgs import preview as server_module
from kissgs.core.errors import UnsupportedError
from kissgs.preview import PageScene, PageServer, hash_source

NAME = "two words % & ü?.zip"


@pytest.fixture
def server(page_folder):
    with PageServer(PageScene(NAME, b"content", converted=False)) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def ask(server, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


@pytest.mark.parametrize(
    ("name", "media_type"),
    [
        ("", "text/html; charset=utf-8"),
        ("preview.html", "text/html; charset=utf-8"),
        ("preview.css", "text/css; charset=utf-8"),
        ("preview/sum.js", "text/javascript; charset=utf-8"),
        ("vendor/three/addons/Pass.js", "text/javascript; charset=utf-8"),
        ("vendor/three/LICENSE", "text/plain; charset=utf-8"),
    ],
)
def test_files_of_the_page(server, name, media_type):
    answer, body = ask(server, f"/{name}")
    assert (answer.status, body.decode()) == (200, FILES[name or "preview.html"])
    assert answer.headers["Content-Type"] == media_type
    assert answer.headers["X-Content-Type-Options"] == "nosniff"
    assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    head, nothing = ask(server, f"/{name}", "HEAD")
    assert (head.status, head.headers["Content-Length"], nothing) == (200, str(len(body)), b"")


def test_the_scene_at_the_address_that_the_page_is_given(server):
    """Browsers decode the query once, and take the rest as an address relative to the page."""
    source = re.fullmatch(r"http://127\.0\.0\.1:\d+/\?src=([\w%./-]+)", server.url)[1].replace("%25", "%")
    answer, body = ask(server, f"/{source}")
    assert (answer.status, body, answer.headers["Content-Type"]) == (200, b"content", "application/octet-stream")


def test_the_policy_allows_the_import_map_and_no_other_origin(server):
    answer, body = ask(server, "/")
    text = re.search('importmap">(.*?)</script>', body.decode(), re.DOTALL)[1]
    policy = dict(part.split(" ", 1) for part in answer.headers["Content-Security-Policy"].split("; "))
    assert policy.pop("script-src") == f"'self' 'wasm-unsafe-eval' {hash_source(text)}"
    assert set(" ".join(policy.values()).split()) <= {"'none'", "'self'", "data:", "blob:"}


@pytest.mark.parametrize(
    "path",
    [
        *(*UNSERVED, "../secret.js", "%2e%2e/secret.js", "preview/../../secret.js", "..%2Fsecret.js", "%00"),
        *("vendor", "vendor/", "preview/", "scene/", "scene", "vendor/versions.json", "scene/other.zip", "/etc/passwd"),
    ],
)
def test_nothing_else_is_served(server, path):
    answer, body = ask(server, f"/{path}")
    assert (answer.status, body) == (404, b"there is no such file\n")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:PORT", "127.0.0.1", "127.0.0.1:1", "localhost.evil:PORT", ""]
)
def test_other_hosts_are_refused(server, host):
    """A name that resolves to 127.0.0.1 would otherwise let a web site read the scene."""
    for path in ("/", "/scene/x.zip", "/preview.js"):
        answer, body = ask(server, path, Host=host.replace("PORT", str(server.port)))
        assert answer.status == 403
        assert b"content" not in body


def test_localhost_is_this_machine(server):
    assert ask(server, "/", Host=f"localhost:{server.port}")[0].status == 200


@pytest.mark.parametrize("method", ["POST", "OPTIONS"])
def test_other_methods_are_refused(server, method):
    assert ask(server, "/", method)[0].status == 501


def test_only_this_machine_can_connect(server):
    assert server.socket.getsockname()[0] == "127.0.0.1"


def test_silent_clients_are_disconnected(server, monkeypatch, capfd):
    monkeypatch.setattr(server_module._Handler, "timeout", 0.2)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
        client.sendall(b"GET / HTTP/1.1\r\n")
        assert client.recv(1) == b""
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as client:
        client.sendall(b"\x16\x03\x01 no request\r\n\r\n")
        assert client.recv(9).startswith(b"<!DOCTYPE")
    time.sleep(0.05)
    assert ask(server, "/")[0].status == 200
    assert capfd.readouterr() == ("", "")


def test_a_port_in_use(server):
    with pytest.raises(UnsupportedError, match=f"port {server.port}: address already in use; choose another --port"):
        PageServer(PageScene("x.ply", b"", converted=False), server.port)


def test_a_page_that_is_not_installed(page_folder):
    scene = PageScene("x.ply", b"", converted=False)
    (page_folder / "vendor" / "versions.json").unlink()
    with pytest.raises(UnsupportedError, match="add --fetch-viewer to download them once"):
        PageServer(scene)
    (page_folder / "preview.html").unlink()
    with pytest.raises(UnsupportedError, match=r"no preview page: .*preview\.html is missing; install kissgs again"):
        PageServer(scene)
