"""The server of ``kissgs view`` and its scenes, by requests over TCP; oracles: the files of its folder,
``kissgs.load``."""

import re
import socket
import time
import zipfile
from io import BytesIO

import numpy as np
import pytest
from helpers.fewer_cameras import try_fewer
from helpers.page_server import ask, serving
from helpers.small_page import FILES, UNSERVED

import kissgs
from kissgs import preview as server_module
from kissgs.core.errors import InvalidContainerError, InvalidSceneError, UnsupportedError
from kissgs.preview import PageScene, PageServer, hash_source, page_container, page_scene

NAME = "two words % & ü?.zip"


@pytest.fixture
def server(page_folder):
    with serving(PageScene(NAME, b"content", converted=False)) as server:
        yield server


MEDIA_TYPES = {
    "": "text/html; charset=utf-8",
    "preview.html": "text/html; charset=utf-8",
    "preview.css": "text/css; charset=utf-8",
    "preview/sum.js": "text/javascript; charset=utf-8",
    "vendor/three/addons/Pass.js": "text/javascript; charset=utf-8",
    "vendor/three/LICENSE": "text/plain; charset=utf-8",
}


def test_files_of_the_page(server):
    for name, media_type in MEDIA_TYPES.items():
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


OTHER_PATHS = (
    *(*UNSERVED, "../secret.js", "%2e%2e/secret.js", "preview/../../secret.js", "..%2Fsecret.js", "%00"),
    *("vendor", "vendor/", "preview/", "scene/", "scene", "vendor/versions.json", "scene/other.zip", "/etc/passwd"),
)
OTHER_HOSTS = ("evil.example", "evil.example:PORT", "127.0.0.1", "127.0.0.1:1", "localhost.evil:PORT", "")


def test_nothing_else_is_served(server):
    for path in OTHER_PATHS:
        answer, body = ask(server, f"/{path}")
        assert (answer.status, body) == (404, b"there is no such file\n"), path
    for method in ("POST", "OPTIONS"):
        assert ask(server, "/", method)[0].status == 501


def test_other_hosts_are_refused(server):
    """A name that resolves to 127.0.0.1 would otherwise let a web site read the scene."""
    for host in OTHER_HOSTS:
        for path in ("/", "/scene/x.zip", "/preview.js"):
            answer, body = ask(server, path, Host=host.replace("PORT", str(server.port)))
            assert answer.status == 403, host
            assert b"content" not in body
    assert ask(server, "/", Host=f"localhost:{server.port}")[0].status == 200


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


FAST = kissgs.Settings(preset="fast")


@pytest.fixture(scope="module")
def splats():
    return kissgs.sample_scene(65, sh_degree=2)


def test_a_container_is_taken_as_it_is(tmp_path, splats):
    for path in (tmp_path / "scene.zip", tmp_path / "scene.sog"):
        kissgs.compress(splats, path, settings=FAST)
        for prepare in (page_scene, page_container):
            found = prepare(path)
            assert (found.name, found.data, found.converted) == (path.name, path.read_bytes(), False)
            assert prepare(path.read_bytes()).data == path.read_bytes()


def test_a_folder_is_packed(tmp_path, splats):
    folder = tmp_path / "scene.of.mine"
    kissgs.compress(splats, f"{folder}/", settings=FAST)
    (folder / "notes.txt").write_text("private")
    expected = {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "notes.txt"}
    for path in (folder, folder / "meta.json"):
        found = page_scene(path)
        assert found.name == "scene.of.mine.zip"
        with zipfile.ZipFile(BytesIO(found.data)) as archive:
            assert {name: archive.read(name) for name in archive.namelist()} == expected


def test_other_formats_become_an_exact_ply_or_a_container(tmp_path, splats, monkeypatch):
    try_fewer(monkeypatch)
    for path in (tmp_path / "scene.ply", tmp_path / "scene.spz"):
        kissgs.save(splats, path)
        found = page_scene(path)
        assert (found.name, found.converted) == ("scene.ply", path.suffix != ".ply")
        (tmp_path / "page.ply").write_bytes(found.data)
        expected, decoded = kissgs.load(path), kissgs.load(tmp_path / "page.ply")
        for name in ("means", "quats", "scales", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(decoded, name), getattr(expected, name), err_msg=name)
    packed = page_container(tmp_path / "scene.ply")
    assert (packed.name, packed.converted) == ("scene.zip", True)
    assert packed.data == kissgs.compress(tmp_path / "scene.ply").to_zip()


def test_unreadable_scenes(tmp_path, splats):
    (tmp_path / "text.ply").write_text("no scene")
    damaged = bytearray(kissgs.compress(splats, container="sog", settings=FAST).to_zip())
    damaged[100] ^= 255
    (tmp_path / "damaged.sog").write_bytes(damaged)
    for prepare in (page_scene, page_container):
        with pytest.raises(InvalidSceneError):
            prepare(tmp_path / "text.ply")
        with pytest.raises(InvalidContainerError):
            prepare(tmp_path / "damaged.sog")


def test_names_that_are_no_text(tmp_path, splats):
    path = tmp_path / "a\udcffb.ply"
    kissgs.save(splats, path)
    assert page_scene(path).name == "a\ufffdb.ply"
