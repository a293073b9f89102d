"""The client, in Python and on the command line, with a real service; oracle: local kissgs.compress."""

import http.server
import json
import os
import re
import signal
import socket
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import httpx
import pytest
from helpers.command_line import KISSGS, run
from helpers.running import wait_until
from helpers.service import SMALL, ServiceProcess, keys_of, scene_bytes
from helpers.thread_runner import HELD_SEED

import kissgs
from kissgs import client


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "Schloß 1.ply"
    path.write_bytes(SMALL)
    return path


FAST = kissgs.Settings(preset="fast")
HELD = kissgs.Settings.from_preset("fast", seed=HELD_SEED)


def test_remote_compression_equals_local_compression(service, scene, tmp_path):
    received = []

    def progress(stage, fraction, note="", seconds_left=None):
        received.append((stage, fraction, seconds_left))
        if fraction == 1:
            raise kissgs.Cancelled  # too late: the work is done

    with kissgs.Remote(service.url) as remote:
        status = remote.compress(scene, tmp_path / "remote.zip", settings=FAST, progress=progress)
    kissgs.compress(scene, tmp_path / "local.zip", settings=FAST)
    assert (tmp_path / "remote.zip").read_bytes() == (tmp_path / "local.zip").read_bytes()
    assert (status["state"], status["name"], status["gaussians"]) == ("succeeded", "Schloß 1", 300)
    stages = list(dict.fromkeys(stage for stage, _, _ in received))
    in_order = ["upload", "queue", "read", "images", "download"]
    assert [stage for stage in stages if stage in in_order] == in_order
    fractions = [fraction for _, fraction, _ in received]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-2] < fractions[-1] == 1
    assert any(left is not None for _, _, left in received)


@pytest.mark.parametrize(
    ("data", "kind", "message"),
    [
        (b"hello", kissgs.InvalidSceneError, "not a PLY file"),
        (scene_bytes(20_001, 0), kissgs.UnsupportedError, "20,001 Gaussians"),
        (SMALL + bytes(5_000_000), kissgs.RemoteError, "4,000,000 bytes"),
    ],
)
def test_refusals_raise_exceptions(service, tmp_path, data, kind, message):
    path = tmp_path / "x.ply"
    path.write_bytes(data)
    with kissgs.Remote(service.url) as remote, pytest.raises(kind, match=message):
        remote.compress(path, tmp_path / "x.zip")
    assert not (tmp_path / "x.zip").exists()


def test_local_errors(service, scene, tmp_path):
    with kissgs.Remote(service.url) as remote:
        with pytest.raises(kissgs.InvalidSceneError, match="no such file"):
            remote.compress(tmp_path / "nothing.ply", tmp_path / "x.zip")
        (tmp_path / "x.zip").write_text("existing")
        with pytest.raises(kissgs.OutputError, match="exists already"):
            remote.compress(scene, tmp_path / "x.zip", settings=FAST)
        assert (tmp_path / "x.zip").read_text() == "existing"
        with pytest.raises(kissgs.RemoteError, match="no job"):
            remote.status("0" * 32)
    for address in ("localhost:8000", "ftp://x", "http://[x"):
        with pytest.raises(kissgs.UnsupportedError, match="address"):
            kissgs.Remote(address)


@pytest.fixture
def unreachable():
    """Address where nothing listens."""
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        yield f"http://127.0.0.1:{unused.getsockname()[1]}"


def test_the_note_about_a_service_that_is_down_leaves_its_address_to_the_command(unreachable, scene, tmp_path):
    """Regression: the command printed the address before the note, which had it once more."""

    def stop(stage, fraction, note=""):
        raise kissgs.Cancelled(note)

    expected = pytest.raises(kissgs.Cancelled, match=r"^not ready \(cannot reach it: .*refused.*\)")
    with kissgs.Remote(unreachable) as remote, expected as raised:
        remote.compress(scene, tmp_path / "x.zip", progress=stop)
    assert unreachable not in str(raised.value)


def test_cancellation_by_either_side(service, scene, tmp_path):
    """``Cancelled`` raised by progress cancels the job, and a job that is cancelled on the server ends the client."""

    def stop(stage, fraction):
        if stage == "order":
            raise kissgs.Cancelled("enough")

    def cancel(stage, fraction):
        if stage == "order":
            service.cancel(service.newest())

    with kissgs.Remote(service.url) as remote:
        with pytest.raises(kissgs.Cancelled):
            remote.compress(scene, tmp_path / "x.zip", settings=HELD, progress=stop)
        stopped = service.newest()
        assert stopped["state"] == "cancelled"
        with pytest.raises(kissgs.RemoteError, match="cancelled"):
            remote.compress(scene, tmp_path / "x.zip", settings=HELD, progress=cancel)
        assert service.newest()["id"] != stopped["id"]


@pytest.mark.quick(0)
def test_the_service_restarts_during_a_job(tmp_path):
    """The client continues when a killed service is back at its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    scene = tmp_path / "scene.ply"
    scene.write_bytes(scene_bytes(6_000, 2))
    with ServiceProcess(tmp_path / "data", KISSGS_PORT=port) as service:

        def run():
            with kissgs.Remote(service.url) as remote:
                remote.compress(scene, tmp_path / "x.zip", settings=FAST)

        with ThreadPoolExecutor() as pool:
            client = pool.submit(run)
            while not service.children():
                time.sleep(0.02)
            service.kill(signal.SIGKILL)
            time.sleep(0.5)
            service.restart()
            client.result(60)
    assert (tmp_path / "x.zip").read_bytes() == kissgs.compress(scene, settings=FAST).to_zip()


def test_a_container_damaged_in_transit(service, scene, tmp_path, monkeypatch):
    real, fractions = httpx.Response.iter_bytes, []

    def damaged(self, *arguments):
        for block in real(self, *arguments):
            yield block[:-1] + bytes([block[-1] ^ 1])

    with kissgs.Remote(service.url) as remote:
        status = remote.follow(remote.submit(scene, settings=FAST)["id"])
        monkeypatch.setattr(httpx.Response, "iter_bytes", damaged)
        with pytest.raises(kissgs.RemoteError, match="damaged"):
            remote.download(status, tmp_path / "x.zip", progress=lambda stage, fraction: fractions.append(fraction))
    assert list(tmp_path.glob("*zip*")) == []
    assert max(fractions) < 1


def kissgs_command(*arguments, group=("remote",), cwd=None, **settings):
    """Run ``kissgs remote`` with these environment variables; return exit code, output and errors."""
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("KISSGS_")]:
            patch.delenv(name)
        for name, value in settings.items():
            patch.setenv(name, value)
        done = run(*group, *arguments, cwd=cwd)
    return SimpleNamespace(returncode=done.returncode, stdout=done.stdout.decode(), stderr=done.stderr.decode())


def test_the_command(service, scene, tmp_path):
    done = kissgs_command("compress", scene, "--server", service.url, "-p", "fast", "--set", "seed=3")
    assert (done.returncode, done.stderr) == (0, "")
    expected = kissgs.compress(scene, settings=kissgs.Settings.from_preset("fast", seed=3)).to_zip()
    assert (tmp_path / "Schloß 1.zip").read_bytes() == expected
    local = kissgs_command("compress", scene, "-fp", "fast", "--set", "seed=3", group=())
    printed = [re.sub(r"; [0-9.]+ s .*", "", text) for text in (done.stdout, local.stdout)]  # but for the time
    assert printed[0] == printed[1]
    again = kissgs_command("compress", scene, "-p", "fast", KISSGS_SERVER=service.url)
    assert (again.returncode, "exists already" in again.stderr) == (2, True)
    as_json = kissgs_command("compress", scene, "-p", "fast", "--json", "-f", KISSGS_SERVER=service.url)
    assert json.loads(as_json.stdout)["state"] == "succeeded"


class Answers:
    """A server that gives these answers, pairs of a status and a document or the lines of a stream, in order."""

    def __init__(self, *answers):
        self.requests, left = [], list(answers)

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_POST(handler):  # noqa: N805
                handler.rfile.read(int(handler.headers["Content-Length"]))
                handler.do_GET()

            def do_GET(handler):  # noqa: N805
                self.requests.append(handler.path)
                status, content = left.pop(0)
                body = (content if isinstance(content, str) else json.dumps(content)).encode()
                handler.send_response(status)
                if status in (429, 503):
                    handler.send_header("Retry-After", "1")
                handler.send_header("Content-Length", str(len(body)))
                handler.end_headers()
                handler.wfile.write(body)

            def log_message(self, *arguments):
                pass

        self.server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"

    def __enter__(self):
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()
        return self

    def __exit__(self, *error):
        self.server.shutdown()
        self.thread.join()
        self.server.server_close()


@pytest.mark.quick(1)
@pytest.mark.parametrize("words", [(), ("--quiet",), ("--json",)])
def test_the_command_says_once_that_the_service_refuses_and_why(scene, words):
    """Oracle: a server that refuses twice for a while, as a service without its storage does, and then for good."""
    busy, end = (
        (503, {"code": "storage", "detail": "the storage is down"}),
        (410, {"code": "gone", "detail": "the end"}),
    )
    with Answers(busy, busy, end) as server:
        done = kissgs_command("compress", scene, "--server", server.url, *words)
    said = f"kissgs: {server.url}: not ready (the storage is down); trying again for 5 minutes\n"
    assert done.stderr == ("" if words == ("--quiet",) else said) + "kissgs: the end\n"
    assert (done.returncode, len(server.requests)) == (2, 3)


def fractions_of(act):
    found = []
    act(lambda stage, fraction, note="": found.append(fraction))
    return found


def test_uploads_that_are_repeated_never_go_back(scene, tmp_path):
    """Once as the service is overloaded, and once as it has no longer the capture."""
    (tmp_path / "capture.zip").write_bytes(bytes(100))
    busy, gone = (429, {"code": "queue-full", "detail": "full"}), (410, {"code": "gone", "detail": "gone"})
    with Answers(busy, gone, (202, {"id": "1"})) as server, kissgs.Remote(server.url) as remote:
        capture = tmp_path / "capture.zip"
        found = fractions_of(
            lambda progress: remote.submit(scene, capture=capture, force_views=True, progress=progress)
        )
    assert found == sorted(found)
    assert found[-1] == 1.0
    sent = [json.loads(httpx.URL(request).params["options"]) for request in server.requests]
    assert [options["force_views"] for options in sent] == [True] * 3


def test_a_job_that_starts_again_never_goes_back_here(scene):
    events = [("state", {"state": "queued"}), ("progress", {"stage": "order", "fraction": 0.5})] * 2
    events += [("progress", {"stage": "read", "fraction": 0.1}), ("progress", {"stage": "write", "fraction": 1.0})]
    stream = "".join(f"id: {at}\nevent: {name}\ndata: {json.dumps(data)}\n\n" for at, (name, data) in enumerate(events))
    with Answers((200, stream), (200, {"state": "succeeded"})) as server, kissgs.Remote(server.url) as remote:
        assert fractions_of(lambda progress: remote.follow("1", progress)) == [0.0, 0.5, 0.5, 0.5, 0.5, 1.0]


def test_the_command_checks_everything_before_it_packs_photographs(unreachable, scene, tmp_path):
    """The photographs are missing, which packing would say."""
    words = ("compress", "--views", tmp_path / "photographs", "--server")
    done = kissgs_command(*words, unreachable, scene)
    assert (done.returncode, "cannot reach" in done.stderr) == (2, True)
    done = kissgs_command(*words, unreachable, tmp_path / "none.ply")
    assert (done.returncode, "none.ply: there is no such file" in done.stderr) == (2, True)
    (tmp_path / "Schloß 1.zip").write_text("existing")
    done = kissgs_command(*words, unreachable, scene)
    assert (done.returncode, "exists already" in done.stderr) == (2, True)


@pytest.mark.quick(0)
def test_the_command_with_keys(start, scene):
    service = start(KISSGS_KEYS=keys_of(alice="secret"))
    without = kissgs_command("compress", scene, "--server", service.url)
    assert (without.returncode, "requires a key" in without.stderr) == (2, True)
    assert kissgs_command("compress", scene, "--server", service.url, KISSGS_KEY="secret").returncode == 0


def test_invalid_commands(scene):
    for words in ("--server nonsense", "-p tiny", "--set x=1", "-o -", "--target-size large"):
        done = kissgs_command("compress", scene, *words.split())
        assert done.returncode == 2
        assert done.stderr.startswith("kissgs: ")
        assert len(done.stderr.splitlines()) == 1


def test_interrupting_the_command_cancels_the_job(service, job, scene):
    words = ["remote", "compress", scene, "-p", "fast", "--set", f"seed={HELD_SEED}", "--server", service.url]
    running = subprocess.Popen([KISSGS, *words], stderr=subprocess.PIPE, text=True)
    wait_until(lambda: service.newest()["state"] == "running")
    time.sleep(1)  # until the client has received the job's id
    running.send_signal(signal.SIGINT)
    assert running.wait(20) == 130
    assert "interrupted" in running.stderr.read()
    running.stderr.close()
    assert service.newest()["state"] == "cancelled"
    assert list(scene.parent.glob("*.zip")) == []


@pytest.mark.quick(0)
def test_the_ending_chooses_the_container(service, scene, tmp_path):
    expected = kissgs.compress(scene, settings=FAST, container="sog").to_zip()
    done = kissgs_command("compress", scene, "-p", "fast", "-o", tmp_path / "a.sog", KISSGS_SERVER=service.url)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "a.sog").read_bytes() == expected
    folder = ("-o", f"{tmp_path}/out/", "--container", "sog", "--json")
    done = kissgs_command("compress", scene, "-p", "fast", *folder, KISSGS_SERVER=service.url)
    assert (tmp_path / "out" / "Schloß 1.sog").read_bytes() == expected
    job = json.loads(done.stdout)["id"]
    assert kissgs_command("get", job, cwd=tmp_path, KISSGS_SERVER=service.url).returncode == 0
    assert (tmp_path / "Schloß 1.sog").read_bytes() == expected
    refused = kissgs_command("get", job, "-o", tmp_path / "b.zip", KISSGS_SERVER=service.url)
    assert (refused.returncode, "end it in .sog" in refused.stderr) == (2, True)
    other = service.ended(service.submit(options='{"format": "spz"}'))
    refused = kissgs_command("get", other["id"], "-o", tmp_path / "b.zip", KISSGS_SERVER=service.url)
    assert (refused.returncode, "end it in .spz" in refused.stderr) == (2, True)
    assert kissgs_command("get", other["id"], "-o", folder[1] + "a.spz", KISSGS_SERVER=service.url).returncode == 0
    assert (tmp_path / "out" / "a.spz").read_bytes() == service.http.get(other["links"]["result"]).content
    with kissgs.Remote(service.url) as remote:
        assert remote.compress(scene, tmp_path / "b.sog", settings=FAST)["options"]["format"] == "sog"
        with pytest.raises(kissgs.UnsupportedError, match=r"end it in \.zip"):
            remote.compress(scene, tmp_path / "c.sog", settings=FAST, container="sogxt")
        for name in ("meta.json", "city.sogxt", "city/lod-meta.json"):
            with pytest.raises(kissgs.UnsupportedError, match=f"{name} is not the name of a container"):
                remote.compress(scene, tmp_path / name)
            refused = kissgs_command("compress", scene, "-o", tmp_path / name, KISSGS_SERVER=service.url)
            assert (refused.returncode, f"{name} is not the name" in refused.stderr) == (2, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Schloß 1.ply", "Schloß 1.sog", "a.sog", "b.sog", "out"]
    assert (tmp_path / "b.sog").read_bytes() == expected


def test_values_of_the_preset_are_left_to_the_server():
    """A server of another version may have others, and would refuse those of the client."""
    sent = client._given(kissgs.Settings(preset="balanced", encode={"target_size": "1MB"}))
    assert (sent["preset"], sent["encode"]["target_size"]) == ("balanced", 1_000_000)
    assert "sh_step" not in sent["encode"]
    assert client._given(kissgs.Settings.research("balanced", sh_step=1.0))["encode"]["sh_step"] == 1.0
