"""Load of a service beside its jobs: ``python -m kissgs.benchmark.service_load URL PID [DATABASE]``.

PID is the process of the service on this machine, and DATABASE the address of its PostgreSQL database, if it has one.
The scenes are small, so that their jobs end soon; what is counted does not depend on how long jobs take, but for their
progress, which the service records up to four times a second.
"""

from __future__ import annotations

import io
import os
import sys
import time
from pathlib import Path

from kissgs.core.errors import UnsupportedError
from kissgs.io.ply import write_ply
from kissgs.synthetic.scene import sample_scene

JOBS = 10
SIZES = (1_000, 100_000)
"""Numbers of Gaussians, of degree 3, of the jobs whose difference is the cost of their bytes."""


def main() -> None:
    """Print the CPU seconds of the service per job and per GB that is uploaded, and the transactions per job."""
    url, pid = sys.argv[1], int(sys.argv[2])
    database = sys.argv[3] if len(sys.argv) > 3 else None
    found = []
    for gaussians in SIZES:
        file = io.BytesIO()
        write_ply(file, sample_scene(gaussians, sh_degree=3))
        scene = file.getvalue()
        _run_jobs(url, scene, 1)  # warm
        cpu, transactions = _cpu_seconds(pid), _transactions(database)
        _run_jobs(url, scene, JOBS)
        found.append((len(scene), (_cpu_seconds(pid) - cpu) / JOBS, (_transactions(database) - transactions) / JOBS))
    (small, base, per_job), (large, more, _) = found
    per_gb = (more - base) / (large - small) * 1e9
    base -= per_gb * small / 1e9
    text = f"{base:.3f} CPU s per job, {per_gb:.2f} CPU s per GB"
    sys.stdout.write(text + (f", {per_job:.0f} transactions per job\n" if database else "\n"))


def _run_jobs(url: str, scene: bytes, count: int) -> None:
    """Submit jobs one after another, each with its end awaited, its result fetched and the job deleted."""
    import httpx

    with httpx.Client(base_url=url, timeout=300, trust_env=False) as http:
        for _ in range(count):
            job = http.post("/v1/jobs", content=scene, params={"options": '{"preset": "fast"}', "name": "load.ply"})
            job.raise_for_status()
            link = f"/v1/jobs/{job.json()['id']}"
            while (status := http.get(link, params={"wait": 30}).json())["state"] in ("queued", "running"):
                pass
            if status["state"] != "succeeded":
                raise UnsupportedError(f"{url}: a job has {status['state']}; see {url}{link}")
            http.get(status["links"]["result"]).raise_for_status()
            http.delete(link).raise_for_status()


def _cpu_seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _transactions(database: str | None) -> int:
    """Return the number of transactions of a database so far, which its statistics know after a second."""
    if database is None:
        return 0
    import psycopg

    time.sleep(1.5)
    with psycopg.connect(database.replace("+psycopg", "")) as connection:
        row = connection.execute(
            "SELECT xact_commit + xact_rollback FROM pg_stat_database WHERE datname = current_database()"
        ).fetchone()
    return 0 if row is None else int(row[0])


if __name__ == "__main__":
    main()
