"""``Service`` and ``ServiceProcess``: a service on the loopback interface, in this process or in one of its own."""

from __future__ import annotations

import asyncio
import contextlib
import copy
import functools
import hashlib
import io
import json
import logging
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

import kissgs
from helpers.running import wait_until
from helpers.thread_runner import HELD_SEED, ThreadRunner
from kissgs.io.ply import write_ply
from service.core.settings import ServiceSettings
from service.http.app import create_app
from service.http.server import Server, listen

ROOT = Path(__file__).parents[2]


def ply_bytes(splats):
    file = io.BytesIO()
    write_ply(file, splats)
    return file.getvalue()


@functools.cache
def scene_bytes(gaussians=300, degree=1, seed=0):
    return ply_bytes(kissgs.sample_scene(gaussians, sh_degree=degree, seed=seed))


SMALL = scene_bytes()
"""Scene whose job takes hardly longer than its start."""

MESH = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""

FAST = json.dumps({"preset": "fast"})
SLOW = json.dumps(
    {
        "preset": "paper",
        "encode": {"seed": HELD_SEED, "plas_radius_decay": 0.99, "sh_kmeans_iterations": 50},
        "for_research": True,
    }
)
"""Settings that keep a worker busy: a process for long, a thread until the job is cancelled."""


def keys_of(**keys):
    """Return the setting KISSGS_KEYS for keys by owner."""
    return ", ".join(f"{owner}:{hashlib.sha256(key.encode()).hexdigest()}" for owner, key in keys.items())


class Service:
    """Service for use as ``with Service(folder, KISSGS_X=…) as service``; ``service.http`` is its HTTP client.

    It runs in a thread of this process, with a server as ``kissgs-serve`` has it; its jobs are threads, too, or with
    ``processes`` processes. Settings in small letters are constants of ``ServiceSettings``, such as ``sync_seconds=2``.
    """

    def __init__(self, folder, *, processes=False, **settings):
        self.folder, self.processes = folder, processes
        self.constants = {name: value for name, value in settings.items() if name.islower()}
        self.settings = {
            "KISSGS_PORT": 0,
            "KISSGS_DATA_DIR": folder,
            "KISSGS_MIN_FREE_BYTES": 0,
            **{name: value for name, value in settings.items() if not name.islower()},
        }
        self.log = folder.parent / f"{folder.name}.log"

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *error):
        self.http.close()
        self.stop()

    def start(self):
        model = type("Settings", (ServiceSettings,), {**self.constants, "__module__": __name__})
        settings = model(**{name.removeprefix("KISSGS_").lower(): value for name, value in self.settings.items()})
        self._handler = logging.FileHandler(self.log)
        logger = logging.getLogger("kissgs")
        logger.addHandler(self._handler)
        logger.setLevel(logging.INFO)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(FastAPI, "openapi", _openapi)
            if not self.processes:
                patch.setattr("service.jobs.process.LocalRunner", ThreadRunner)
            app = create_app(settings)
        listener = listen(settings)
        self._server = _Server(app, app.state.context)
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [listener]})
        self._thread.start()
        assert self._server.listening.wait(60)
        self._connect(listener.getsockname()[1])
        return self

    def interrupt(self):
        """Ask the service to end, as Ctrl-C does: the first time soon, the second time at once."""
        with contextlib.suppress(RuntimeError):  # its loop has ended
            self._server.loop.call_soon_threadsafe(self._server.handle_exit, signal.SIGINT, None)

    def join(self, seconds=300):
        """Wait for the end of a service that was interrupted."""
        self._thread.join(seconds)
        assert not self._thread.is_alive()
        logging.getLogger("kissgs").removeHandler(self._handler)
        self._handler.close()

    def stop(self):
        """End all jobs and the service."""
        while self._thread.is_alive():
            self.interrupt()
            self._thread.join(0.1)
        self.join()

    def restart(self):
        """Start a service that has ended once more."""
        self.http.close()
        return self.start()

    def _connect(self, port):
        self.url, self.port = f"http://127.0.0.1:{port}", port
        self.http = httpx.Client(base_url=self.url, timeout=300, trust_env=False)

    # Common actions of tests ---------------------------------------------------------------------------------

    def submit(self, data=SMALL, options=FAST, **headers):
        answer = self.http.post(
            "/v1/jobs", content=data, params={"options": options, "name": "a scene.ply"}, headers=headers
        )
        assert answer.status_code == 202, answer.text
        return answer.json()

    def newest(self):
        """Return the status of the latest job."""
        return self.http.get("/v1/jobs", params={"limit": 1}).json()["jobs"][0]

    def cancel(self, job):
        answer = self.http.post(f"/v1/jobs/{job['id']}/cancel")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def status(self, job, wait=0):
        answer = self.http.get(f"/v1/jobs/{job['id']}", params={"wait": wait})
        assert answer.status_code == 200, answer.text
        return answer.json()

    def ended(self, job, seconds=600):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            status = self.status(job, wait=5)
            if status["state"] not in ("queued", "running"):
                return status
        raise AssertionError(f"job {job['id']} has not ended: {status}")

    def only_result(self, job):
        """Return the container of a job, which must succeed and leave no temporary files."""
        status = self.ended(job)
        assert status["state"] == "succeeded", status
        assert self.leftovers() == [], self.leftovers()
        return self.http.get(status["links"]["result"]).content

    def running(self, job, stage=None, seconds=300):
        """Wait until the job runs, in ``stage`` if given; return the status."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            status = self.status(job)
            progress = status.get("progress")
            started = status["state"] == "running" and progress and stage in (None, progress["stage"])
            if started and (not self.processes or self.children()):
                return status
            assert status["state"] in ("queued", "running"), status
            time.sleep(0.02)
        raise AssertionError(f"job {job['id']} does not run: {status}\n{self.log.read_text()[-3000:]}")

    def hold(self):
        """Submit a job that keeps the worker busy, and return its status once it runs."""
        return self.running(self.submit(scene_bytes(20_000, 3) if self.processes else SMALL, SLOW))

    def children(self):
        """Return the ids of all job processes, which work in the folders of their jobs."""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                if (process / "cwd").readlink().is_relative_to(self.folder / "jobs"):
                    found.append(int(process.name))
        return found

    def stored(self):
        """Return the ids of all jobs that have files."""
        return {path.name for path in (self.folder / "jobs").iterdir()}

    def wait_for_uploads(self, count):
        """Wait until so many uploads are in progress."""
        wait_until(lambda: f"kissgs_uploads_in_flight {count:.1f}" in self.http.get("/metrics").text)

    def uploads(self):
        """Return the names of uploads in progress."""
        return [path.name for path in (self.folder / "incoming").iterdir()]

    def leftovers(self):
        """Return the paths of temporary files."""
        jobs = self.folder / "jobs"
        found = [*(self.folder / "incoming").iterdir(), *jobs.glob("*/work-*"), *jobs.glob("*/.*")]
        return [str(path.relative_to(self.folder)) for path in found]

    def raw(self, data):
        """Open a connection and send these bytes."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=300)
        connection.sendall(data)
        return connection


_generate, _generated = FastAPI.openapi, {}


def _openapi(app):
    """Return the OpenAPI document, which takes most of the time of a start, and is the same for all services."""
    if not _generated:
        _generated.update(copy.deepcopy(_generate(app)))
    return copy.deepcopy(_generated)


class _Server(Server):
    """Server that says when it listens."""

    def __init__(self, app, context):
        super().__init__(app, context)
        self.listening = threading.Event()

    async def startup(self, sockets=None):
        self.loop = asyncio.get_running_loop()
        await super().startup(sockets)
        self.listening.set()


class ServiceProcess(Service):
    """Service in a process of its own, ``python -m service``, which can be killed and started again."""

    process: subprocess.Popen | None = None

    def __init__(self, folder, **settings):
        super().__init__(folder, processes=True, **settings)

    def start(self):
        begin = self.log.stat().st_size if self.log.exists() else 0
        kept = {name: value for name, value in os.environ.items() if not name.startswith("KISSGS_")}
        chosen = {name: str(value) for name, value in self.settings.items()}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-P", *self._program()],
                env={**kept, "PYTHONPATH": str(ROOT), **chosen},
                stdout=log,
                stderr=log,
            )
        for _ in range(6000):
            output = self.log.read_bytes()[begin:].decode(errors="replace")
            if found := re.search(r"listening on http://127\.0\.0\.1:([0-9]+)", output):
                self._connect(int(found[1]))
                return self
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        raise AssertionError(f"the service did not start: {self.log.read_text()[-3000:]}")

    def _program(self):
        if not self.constants:
            return ["-m", "service"]
        changes = "".join(f"ServiceSettings.{name} = {value!r}\n" for name, value in self.constants.items())
        imports = "from service.__main__ import main\nfrom service.core.settings import ServiceSettings\n"
        return ["-c", f"{imports}{changes}main()"]

    def stop(self):
        self.kill(signal.SIGKILL)

    def kill(self, number):
        """Send a signal, wait for the end, and return the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=300)

    def memory(self):
        """Return the peak resident memory of the server process, bytes."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmHWM:\s+([0-9]+) kB", text)[1]) << 10


def read_response(connection):
    """Return one HTTP response from a connection."""
    answer = b""
    with contextlib.suppress(ConnectionError):
        while block := connection.recv(65536):
            answer += block
            head, end, body = answer.partition(b"\r\n\r\n")
            length = re.search(rb"content-length: ([0-9]+)", head)
            if end and length and len(body) >= int(length[1]):
                break
    return answer


def problem(answer, status, code):
    """Return the problem document of a response, which must have this status and code."""
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), answer.text
    found = answer.json()
    assert found["code"] == code, found
    assert found["status"] == status
    assert found["type"] == f"/v1/problems/{code}"
    assert set(found) <= {"type", "title", "status", "detail", "code", "retryable", "errors"}
    assert "Traceback" not in found["detail"]
    return found


def events(text):
    """Return id, kind and data of each server-sent event of a stream."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "data" in fields:
            found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return found
