"""Costs of the service beyond the compression itself, measured on one that is started and stopped.

python bench/serving.py
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.service import ServiceProcess, scene_bytes

from bench.common import parser_of, run, write

POLLS = 600


def main() -> None:
    """Print the milliseconds of status requests while a job runs, and the memory of the server."""
    parser_of(__doc__).parse_args()
    with tempfile.TemporaryDirectory() as folder, ServiceProcess(Path(folder, "data")) as service:
        job = service.submit(scene_bytes(400_000, 3), options="{}")
        service.running(job)
        spent = []
        for _ in range(POLLS):
            begun = time.perf_counter()
            state = service.status(job)["state"]
            spent.append(1e3 * (time.perf_counter() - begun))
            if state != "running":
                break
            time.sleep(0.01)
        service.cancel(job)
        spent.sort()
        median, late = spent[len(spent) // 2], spent[int(0.99 * len(spent))]
        write(f"status while a job runs: p50 {median:.1f} ms, p99 {late:.1f} ms ({len(spent)} requests)")
        write(f"memory of the server: {service.memory() / 2**20:.0f} MiB")


if __name__ == "__main__":
    run(main)
