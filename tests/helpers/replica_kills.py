"""Replicas, or nodes that work for them, of which one after the other is killed at random moments, while jobs run."""

from __future__ import annotations

import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import kissgs
from helpers.ray_cluster import kill_tree
from helpers.ray_service import RayReplicas
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


SETTINGS = {"KISSGS_JOB_STARTS": 1000, "KISSGS_JOB_THREADS": 1}
"""Settings of the replicas: nothing fails because of too many kills."""


def kill_a_replica(it: Replicas, rng: random.Random) -> None:
    """Kill a replica, look at the jobs through the other one, and start it again."""
    dead, alive = rng.sample(it.replicas, 2)
    dead.kill(signal.SIGKILL)
    assert alive.http.get("/v1/jobs").status_code == 200
    dead.restart()


def kill_a_node(it: RayReplicas, rng: random.Random) -> None:
    """Kill a node of the cluster, as if its machine had lost its power, and add another one."""
    kill_tree(rng.choice(it.cluster.nodes))
    it.cluster.restore()


def kill_at_random_moments(
    it: Replicas, kill: Callable[[Replicas, random.Random], None], *, kills: int, jobs: int, seed: int
) -> Kills:
    """Start replicas and ``kills`` times, at a random moment, ``kill`` something; wait for the end of all ``jobs``."""
    rng, found = random.Random(seed), Kills()
    scenes = [scene_bytes(rng.randrange(300, 6000), rng.randrange(3), seed=i) for i in range(jobs)]
    with it:
        submitted = [it.submit(scene) for scene in scenes]
        for _ in range(kills):
            time.sleep(rng.uniform(0.0, 2.5))
            kill(it, rng)
            assert len(it.http.get("/v1/jobs", params={"limit": 100}).json()["jobs"]) == len(submitted)
            submitted.append(it.submit(scenes[0]))
            scenes.append(scenes[0])
        ended = [it.ended(job) for job in submitted]
        for job, scene in zip(ended, scenes, strict=True):
            found.lost += job["state"] != "succeeded"
            found.starts.append(job["starts"])
            if job["state"] == "succeeded":
                expected = kissgs.compress(scene, settings=kissgs.Settings(preset="fast")).to_zip()
                found.different += it.http.get(job["links"]["result"]).content != expected
        time.sleep(1)  # what follows the end of the last job
        found.leftovers = it.leftovers()
    return found
