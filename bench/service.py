"""Costs of the service beyond the compression itself, measured on one that is started and stopped.

python bench/service.py
"""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

from bench.common import parser_of, run, write
from kissgs import KissgsError, sample_scene, save

POLLS = 600


def main() -> None:
    """Print the time of status requests, and the memory of the server."""
    parser = parser_of(__doc__)
    parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with service(folder / "data") as (url, pid), httpx.Client(base_url=url, trust_env=False) as http:
            latency(http, folder)
            write(f"memory of the server: {peak_memory(pid) / 2**20:.0f} MiB")


def latency(http: httpx.Client, folder: Path) -> None:
    """Print the milliseconds of status requests while a job runs."""
    save(sample_scene(400_000), folder / "big.ply")
    job = http.post("/v1/jobs", content=(folder / "big.ply").read_bytes(), timeout=60).json()["id"]
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
    median, late = spent[len(spent) // 2], spent[int(0.99 * len(spent))]
    write(f"status while a job runs: p50 {median:.1f} ms, p99 {late:.1f} ms ({len(spent)} requests)")


def peak_memory(pid: int) -> int:
    """Return the largest resident set of a process of Linux, bytes."""
    text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    return int(text.partition("VmHWM:")[2].split()[0]) << 10


@contextlib.contextmanager
def service(folder: Path) -> Iterator[tuple[str, int]]:
    """Start a service; yield its address and its process id."""
    kept = {name: value for name, value in os.environ.items() if not name.upper().startswith("KISSGS_")}
    log = folder.with_suffix(".log")
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "kissgs_service"],
            env={**kept, "KISSGS_PORT": "0", "KISSGS_DATA_DIR": str(folder)},
            stderr=errors,
        )
    try:
        while not (found := re.search(r"listening on (http://\S+)", log.read_text(encoding="utf-8"))):
            if process.poll() is not None:
                raise KissgsError(log.read_text(encoding="utf-8"))
            time.sleep(0.05)
        yield found[1], process.pid
    finally:
        process.terminate()
        process.wait()


if __name__ == "__main__":
    run(main)
