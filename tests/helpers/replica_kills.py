"""Two replicas of which one after the other is killed at random moments, while jobs run and wait."""

from __future__ import annotations

import random
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path

import kissgs
from helpers.s3_server import Bucket
from helpers.service import Replicas, scene_bytes


@dataclass
class Kills:
    """Findings after the kills.

    Attributes:
        lost: number of jobs that did not succeed.
        different: number of containers that are not those of ``kissgs.compress``.
        starts: number of starts of each job.
        leftovers: keys and files that no job has.
    """

    lost: int = 0
    different: int = 0
    starts: list[int] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)


def kill_at_random_moments(folder: Path, bucket: Bucket, database: str, *, kills: int, jobs: int, seed: int) -> Kills:
    """Kill a replica at ``kills`` random moments, start it again each time, and wait for the end of all ``jobs``."""
    rng, found = random.Random(seed), Kills()
    scenes = [scene_bytes(rng.randrange(300, 6000), rng.randrange(3), seed=i) for i in range(jobs)]
    with Replicas(folder, 2, bucket, database, KISSGS_JOB_STARTS=1000, KISSGS_JOB_THREADS=1) as it:
        submitted = [it.submit(scene) for scene in scenes]
        for _ in range(kills):
            time.sleep(rng.uniform(0.0, 2.5))
            dead, alive = rng.sample(it.replicas, 2)
            dead.kill(signal.SIGKILL)
            listed = alive.http.get("/v1/jobs", params={"limit": 100}).json()["jobs"]
            assert len(listed) == jobs
            dead.restart()
            submitted.append(it.submit(scenes[0]))
            scenes.append(scenes[0])
            jobs += 1
        ended = [it.ended(job, seconds=300) for job in submitted]
        for job, scene in zip(ended, scenes, strict=True):
            found.lost += job["state"] != "succeeded"
            found.starts.append(job["starts"])
            if job["state"] == "succeeded":
                expected = kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip()
                found.different += it.http.get(job["links"]["result"]).content != expected
        time.sleep(1)  # what follows the end of the last job
        found.leftovers = it.leftovers()
    return found
