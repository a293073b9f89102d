"""``kissgs-serve bench``: what the service costs beyond the compression itself, measured on a service of its own."""

from __future__ import annotations

import contextlib
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx

import kissgs

from ..core.settings import SettingsError

UPLOAD_BYTES = 500_000_000
POLLS = 600
REPEATS = 5


@dataclass(frozen=True, slots=True)
class Running:
    """A service that this command has started."""

    url: str
    pid: int

    def peak_memory(self) -> int:
        """Bytes, the most that the server itself has had resident; 0 where the system does not say."""
        try:
            text = Path(f"/proc/{self.pid}/status").read_text(encoding="ascii")
        except OSError:
            return 0
        return int(text.partition("VmHWM:")[2].split()[0]) << 10


def bench(scene: Path | None) -> None:
    """Measure and print a table."""
    with tempfile.TemporaryDirectory(prefix="kissgs-bench-") as name:
        folder = Path(name)
        if scene is None:
            scene = folder / "sample.ply"
            kissgs.save(kissgs.sample_scene(), scene)
        with _service(folder / "data") as service, httpx.Client(base_url=service.url, trust_env=False) as http:
            _print("status while a job uses every processor", _latency(http, folder))
            _print("server memory", _upload_memory(service, http, folder))
            _print(f"over `kissgs compress`, {scene.name}", _overhead(service, scene, folder))


def _latency(http: httpx.Client, folder: Path) -> str:
    big = folder / "big.ply"
    kissgs.save(kissgs.sample_scene(400_000), big)
    with big.open("rb") as file:
        job = http.post("/v1/jobs", content=file, timeout=60).json()["id"]
    while "progress" not in http.get(f"/v1/jobs/{job}").json():
        time.sleep(0.05)
    spent = []
    for _ in range(POLLS):
        begun = time.perf_counter()
        state = http.get(f"/v1/jobs/{job}").json()["state"]
        spent.append(1e3 * (time.perf_counter() - begun))
        if state != "running":
            break
        time.sleep(0.01)
    http.delete(f"/v1/jobs/{job}", timeout=10)
    spent.sort()
    middle, late = spent[len(spent) // 2], spent[int(0.99 * len(spent))]
    return f"p50 {middle:.1f} ms, p99 {late:.1f} ms, max {spent[-1]:.1f} ms ({len(spent)} requests)"


def _upload_memory(service: Running, http: httpx.Client, folder: Path) -> str:
    path = folder / "upload.ply"
    size = _write_scene(path, UPLOAD_BYTES)
    before = service.peak_memory()
    said = []
    for name in ("body", "form"):
        begun = time.perf_counter()
        with path.open("rb") as file:
            body = {"content": file} if name == "body" else {"files": {"file": file}}
            answer = http.post("/v1/jobs", params={"options": '{"preset": "fast"}'}, timeout=600, **body)
        spent = time.perf_counter() - begun
        http.delete(answer.raise_for_status().json()["links"]["self"], timeout=10)
        said.append(f"{size / spent / 1e6:.0f} MB/s as a {name}")
    grown = service.peak_memory() - before
    return f"{before / 2**20:.0f} MiB, {grown / 2**20:+.1f} MiB while {size / 1e6:.0f} MB arrive ({', '.join(said)})"


def _write_scene(path: Path, size: int) -> int:
    """A valid ``.ply`` of about ``size`` bytes: the sample's rows again and again."""
    kissgs.save(kissgs.sample_scene(20_000), path)
    data = path.read_bytes()
    head, end, rows = data.partition(b"end_header\n")
    times = round(size / len(rows))
    with path.open("wb") as file:
        file.write(head.replace(b"vertex 20000\n", b"vertex %d\n" % (20_000 * times)) + end)
        for _ in range(times):
            file.write(rows)
    return path.stat().st_size


def _overhead(service: Running, scene: Path, folder: Path) -> str:
    here, there, uploads = [], [], []
    settings, target = kissgs.Settings(preset=kissgs.Preset.FAST), folder / "out.zip"
    command = [
        sys.executable,
        "-c",
        "from kissgs.cli.main import main; main()",
        "compress",
        str(scene),
        "-p",
        "fast",
        "-q",
    ]
    with kissgs.Remote(service.url) as remote:
        for repeat in range(REPEATS + 1):
            begun = time.perf_counter()
            subprocess.run([*command, "-f", "-o", str(target)], check=True)
            middle = time.perf_counter()
            job = remote.submit(scene, settings=settings)
            uploaded = time.perf_counter()
            remote.download(remote.follow(job["id"]), target, overwrite=True)
            if repeat:  # the first warms the caches of both
                here.append(middle - begun)
                uploads.append(uploaded - middle)
                there.append(time.perf_counter() - uploaded)
    more = statistics.median(t - h for t, h in zip(there, here, strict=True))
    return (
        f"{more:+.2f} s and {statistics.median(uploads):.2f} s of upload "
        f"(here {statistics.median(here):.2f} s, there {statistics.median(there):.2f} s; medians of {REPEATS})"
    )


@contextlib.contextmanager
def _service(folder: Path) -> Iterator[Running]:
    kept = {name: value for name, value in os.environ.items() if not name.upper().startswith("KISSGS_")}
    environment = {**kept, "KISSGS_PORT": "0", "KISSGS_DATA_DIR": str(folder)}
    log = folder.with_suffix(".log")
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", __package__.partition(".")[0]], env=environment, stderr=errors
        )
    try:
        yield Running(_address(process, log), process.pid)
    finally:
        process.terminate()
        process.wait()


def _address(process: subprocess.Popen[bytes], log: Path) -> str:
    while process.poll() is None:
        found = re.search(r"listening on (http://\S+)", log.read_text(encoding="utf-8"))
        if found:
            return found[1]
        time.sleep(0.05)
    raise SettingsError(log.read_text(encoding="utf-8"))


def _print(what: str, found: str) -> None:
    sys.stdout.write(f"{what}: {found}\n")
    sys.stdout.flush()
