"""``Service``: a service in a separate process, on the loopback interface."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx

import kissgs
from kissgs.io.ply import write_ply

ROOT = Path(__file__).parents[2]


def scene_bytes(gaussians=300, degree=1, seed=0):
    file = io.BytesIO()
    write_ply(file, kissgs.sample_scene(gaussians, sh_degree=degree, seed=seed))
    return file.getvalue()


SMALL = scene_bytes()
"""Scene whose job takes hardly longer than the start of its process."""

FAST = json.dumps({"preset": "fast"})
SLOW = json.dumps(
    {"preset": "paper", "encode": {"plas_radius_decay": 0.99, "sh_kmeans_iterations": 50}, "for_research": True}
)
"""Settings that keep a worker busy."""


class Service:
    """Service for use as ``with Service(folder, KISSGS_X=…) as service``; ``service.http`` is its HTTP client.

    Settings in small letters are constants of ``ServiceSettings``, such as ``sync_seconds=2``.
    """

    def __init__(self, folder: Path, **settings: object) -> None:
        self.folder = folder
        self.constants = {name: value for name, value in settings.items() if name.islower()}
        self.settings = {
            "KISSGS_MIN_FREE_BYTES": 0,
            **{name: value for name, value in settings.items() if not name.islower()},
        }
        self.log = folder.parent / f"{folder.name}.log"
        self.process: subprocess.Popen | None = None

    def __enter__(self) -> Service:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.http.close()
        self.kill(signal.SIGKILL)

    def start(self) -> Service:
        begin = self.log.stat().st_size if self.log.exists() else 0
        kept = {name: value for name, value in os.environ.items() if not name.startswith("KISSGS_")}
        chosen = {"KISSGS_PORT": 0, "KISSGS_DATA_DIR": self.folder, **self.settings}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-P", *self._program()],
                env={**kept, "PYTHONPATH": str(ROOT), **{name: str(value) for name, value in chosen.items()}},
                stdout=log,
                stderr=log,
            )
        for _ in range(6000):
            output = self.log.read_bytes()[begin:].decode(errors="replace")
            found = re.search(r"listening on (http://127\.0\.0\.1:([0-9]+))", output)
            if found:
                self.url, self.port = found[1], int(found[2])
                self.http = httpx.Client(base_url=self.url, timeout=300, trust_env=False)
                return self
            if self.process.poll() is not None:
                break
            time.sleep(0.05)
        raise AssertionError(f"the service did not start: {self.log.read_text()[-3000:]}")

    def _program(self) -> list[str]:
        if not self.constants:
            return ["-m", "service"]
        changes = "".join(f"ServiceSettings.{name} = {value!r}\n" for name, value in self.constants.items())
        imports = "from service.__main__ import main\nfrom service.core.settings import ServiceSettings\n"
        return ["-c", f"{imports}{changes}main()"]

    def kill(self, number: int) -> int:
        """Send a signal, wait for the end, and return the exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout=300)

    def restart(self) -> Service:
        self.http.close()
        return self.start()

    # Common actions of tests ---------------------------------------------------------------------------------

    def submit(self, data: bytes = SMALL, options: str = FAST, **headers: str) -> dict:
        answer = self.http.post(
            "/v1/jobs", content=data, params={"options": options, "name": "a scene.ply"}, headers=headers
        )
        assert answer.status_code == 202, answer.text
        return answer.json()

    def status(self, job: dict, wait: float = 0) -> dict:
        answer = self.http.get(f"/v1/jobs/{job['id']}", params={"wait": wait})
        assert answer.status_code == 200, answer.text
        return answer.json()

    def ended(self, job: dict, seconds: float = 600) -> dict:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            status = self.status(job, wait=5)
            if status["state"] not in ("queued", "running"):
                return status
        raise AssertionError(f"job {job['id']} has not ended: {status}")

    def result(self, job: dict) -> bytes:
        """Return the container of a job, which must succeed."""
        status = self.ended(job)
        assert status["state"] == "succeeded", status
        return self.http.get(status["links"]["result"]).content

    def only_result(self, job: dict) -> bytes:
        """Return the container of a job, which must succeed and leave no temporary files."""
        content = self.result(job)
        assert self.leftovers() == []
        return content

    def running(self, job: dict, stage: str | None = None, seconds: float = 300) -> dict:
        """Wait until the job's process runs, in ``stage`` if given; return the status."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            status = self.status(job)
            progress = status.get("progress")
            if status["state"] == "running" and progress and stage in (None, progress["stage"]) and self.children():
                return status
            assert status["state"] in ("queued", "running"), status
            time.sleep(0.02)
        raise AssertionError(f"job {job['id']} does not run: {status}\n{self.log.read_text()[-3000:]}")

    workers = 1
    """Number of jobs that run simultaneously."""

    def occupy(self) -> list[dict]:
        """Submit a long job for each worker, and return them once all are running."""
        jobs = [self.submit(scene_bytes(20_000, 3), SLOW) for _ in range(self.workers)]
        return [self.running(job) for job in jobs]

    def children(self) -> list[int]:
        """Return the ids of all job processes."""
        with contextlib.suppress(OSError):
            tasks = Path(f"/proc/{self.process.pid}/task").iterdir()
            return [int(pid) for task in tasks for pid in (task / "children").read_text().split()]
        return []

    def memory(self) -> int:
        """Return the peak resident memory of the server process, bytes."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmHWM:\s+([0-9]+) kB", text)[1]) << 10

    def stored(self) -> set[str]:
        """Return the ids of all jobs that have files."""
        return {path.name for path in (self.folder / "jobs").iterdir()}

    def uploads(self) -> list[str]:
        """Return the names of uploads in progress."""
        return [path.name for path in (self.folder / "incoming").iterdir()]

    def leftovers(self) -> list[str]:
        """Return the paths of temporary files."""
        jobs = self.folder / "jobs"
        found = [*(self.folder / "incoming").iterdir(), *jobs.glob("*/work-*"), *jobs.glob("*/.*")]
        return [str(path.relative_to(self.folder)) for path in found]

    def raw(self, data: bytes) -> socket.socket:
        """Open a connection and send these bytes."""
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=300)
        connection.sendall(data)
        return connection


def read_response(connection: socket.socket) -> bytes:
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


def problem(answer: httpx.Response, status: int, code: str) -> dict:
    """Return the problem document of a response, which must have this status and code."""
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), answer.text
    found = answer.json()
    assert found["code"] == code, found
    assert found["status"] == status
    assert found["type"] == f"/v1/problems/{code}"
    assert set(found) <= {"type", "title", "status", "detail", "code", "retryable", "errors"}
    assert "Traceback" not in found["detail"]
    return found


def events(text: str) -> list[tuple[int, str, dict]]:
    """Return id, kind and data of each server-sent event of a stream."""
    found = []
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if not line.startswith(":"))
        if "data" in fields:
            found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
    return found
