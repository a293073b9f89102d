"""Simulation of clusters: scenes beyond the size of one machine, and services with many jobs.

Costs are measured on this machine (:mod:`kissgs.benchmark.streaming_costs`, :mod:`kissgs.benchmark.service_load`); the
simulation places the work items of a scene, or the jobs of a day, on the processors of all nodes. It leaves out nodes
that fail, processors that slow each other down, and a storage that is slower than the networks of the nodes together.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from kissgs.benchmark.streaming_costs import StreamingCosts
from kissgs.core.array_types import Float64
from kissgs.streaming.build import CHUNK, COARSEST, leaf_size
from kissgs.streaming.layout import CONTEXT
from kissgs.streaming.levels import level_count
from kissgs.streaming.partition import chunk_depth

MANIFEST_BYTES = 105
"""Size of one level of one leaf in ``lod-meta.json``, bytes: 535,211 bytes for 512 leaves and 10 levels."""

ITEM_SECONDS = 1.5
"""Seconds for the start of a work item: 0.18 by Ray (``python -m kissgs.benchmark.runner_overhead``, one node), and 1.3
of its process, for ``import kissgs.streaming.items``."""

EVENTS = 4.0
"""Progress events of a job per second, each a transaction (:data:`kissgs.runners.item_process.EVENT_SECONDS`)."""

FRONT_SECONDS, FRONT_SECONDS_PER_BYTE, TRANSACTIONS = 0.168, 8.31e-9, 102
"""CPU seconds of the service for each job and each byte of its upload, and transactions of its database for a short job
(``python -m kissgs.benchmark.service_load``, one replica with PostgreSQL and a bucket)."""

JOBS = 20_000
"""Number of jobs of a simulation."""

SPREAD = 1.0
"""Standard deviation of the logarithm of a job's size."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Node:
    """A machine of a cluster.

    Attributes:
        cpus: processors, each as fast as those of this machine.
        network_bytes: bytes per second between the node and the storage.
        dollars: cost of an hour.
    """

    cpus: int
    network_bytes: float
    dollars: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneRun:
    """A streamed scene on a cluster.

    Attributes:
        gaussians: number of Gaussians.
        nodes: number of nodes.
        seconds: wall time of each stage.
        network_share: share of the network in the processors' time during "merge" and "images", 0 to 1.
        dollars: cost of all nodes until the end.
        first_bytes: size of the manifest and the coarsest level, which a viewer's first image needs.
    """

    gaussians: int
    nodes: int
    seconds: dict[str, float]
    network_share: float
    dollars: float
    first_bytes: float

    @property
    def total_seconds(self) -> float:
        """Wall time."""
        return sum(self.seconds.values())

    @property
    def limit(self) -> str:
        """Part that takes most of the time: "partition", "cameras" (both by one process), "processors" or "network"."""
        items = self.seconds["merge"] + self.seconds["images"]
        parts = {
            "partition": self.seconds["partition"],
            "cameras": self.seconds["cameras"],
            "network": self.network_share * items,
            "processors": (1 - self.network_share) * items,
        }
        return max(parts, key=parts.__getitem__)


def simulate_scene(costs: StreamingCosts, node: Node, nodes: int, gaussians: int) -> SceneRun:
    """Simulate a streamed scene, one stage after another.

    Args:
        costs: measured costs.
        node: one of the nodes, which are all equal.
        nodes: number of nodes.
        gaussians: number of Gaussians.
    """
    depth, levels = chunk_depth(gaussians, CHUNK), level_count(gaussians, COARSEST)
    files = [1 << max(0, depth - level) for level in range(levels)]
    sizes = [gaussians / 2**level / count for level, count in enumerate(files)]
    context = min(CONTEXT, gaussians) if costs.camera_seconds else 0
    rate = node.network_bytes / node.cpus

    def item(cpu_seconds: float, moved: float) -> tuple[float, float]:
        return cpu_seconds, moved / rate

    merge = [item(sizes[0] * costs.merge_seconds, 3 * sizes[0] * costs.source_bytes)] * files[0]  # reads 1, writes 2
    images = [
        item(size * costs.file_seconds, (size + context) * costs.source_bytes + size * costs.file_bytes)
        for size, count in zip(sizes, files, strict=True)
        for _ in range(count)
    ]
    slots = nodes * node.cpus
    moved = 3 * gaussians * costs.source_bytes / node.network_bytes  # reads 2, writes 1
    seconds = {
        "partition": gaussians * costs.partition_seconds + moved,
        "merge": makespan((sum(each) + ITEM_SECONDS for each in merge), slots),
        "cameras": costs.camera_seconds,
        "images": makespan((sum(each) + ITEM_SECONDS for each in images), slots),
    }
    parts = sizes[0] / leaf_size(gaussians, files[0], levels)
    leaves = files[0] << max(0, math.ceil(math.log2(parts)))
    return SceneRun(
        gaussians=gaussians,
        nodes=nodes,
        seconds=seconds,
        network_share=sum(each[1] for each in merge + images) / sum(sum(each) for each in merge + images),
        dollars=nodes * node.dollars * sum(seconds.values()) / 3600,
        first_bytes=leaves * levels * MANIFEST_BYTES + sizes[-1] * costs.file_bytes,
    )


def makespan(items: Iterable[float], slots: int) -> float:
    """Return the end of the last of items, in seconds, each started in order where a slot is free first."""
    free = [0.0] * slots
    for seconds in items:
        heapq.heapreplace(free, free[0] + seconds)
    return max(free)


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRun:
    """Jobs of a service on a cluster.

    Attributes:
        jobs_per_day: mean number of jobs in a day.
        nodes: number of nodes.
        busy: share of the processors' time that jobs take, 0 to 1.
        median_wait, longest_wait: seconds until a job starts: of half the jobs and of 95 % at most.
        front_cpus: processors that replicas of the service keep busy.
        upload_bytes: bytes per second of all uploads.
        transactions: transactions of the database per second.
    """

    jobs_per_day: float
    nodes: int
    busy: float
    median_wait: float
    longest_wait: float
    front_cpus: float
    upload_bytes: float
    transactions: float


@dataclass(frozen=True, slots=True, kw_only=True)
class JobCosts:
    """Mean costs of a job.

    Attributes:
        seconds: CPU seconds of its compression.
        upload_bytes: size of its scene.
    """

    seconds: float
    upload_bytes: float


def simulate_jobs(costs: JobCosts, node: Node, nodes: int, jobs_per_day: float, seed: int = 0) -> JobRun:
    """Simulate the queue of a service: jobs arrive at random, and each takes one processor.

    Args:
        costs: mean costs of a job; sizes are log-normal, see :data:`SPREAD`.
        node: one of the nodes, which are all equal.
        nodes: number of nodes.
        jobs_per_day: mean number of jobs in a day.
        seed: of arrivals and sizes.
    """
    random, rate = np.random.default_rng(seed), jobs_per_day / 86_400
    fetch = costs.upload_bytes / (node.network_bytes / node.cpus)
    mean = costs.seconds + fetch
    arrivals = np.cumsum(random.exponential(1 / rate, JOBS))
    seconds = mean * random.lognormal(-(SPREAD**2) / 2, SPREAD, JOBS) + ITEM_SECONDS
    waits = queue_waits(arrivals, seconds, nodes * node.cpus)
    return JobRun(
        jobs_per_day=jobs_per_day,
        nodes=nodes,
        busy=rate * (mean + ITEM_SECONDS) / (nodes * node.cpus),
        median_wait=float(np.median(waits)),
        longest_wait=float(np.quantile(waits, 0.95)),
        front_cpus=rate * (FRONT_SECONDS + costs.upload_bytes * FRONT_SECONDS_PER_BYTE),
        upload_bytes=rate * costs.upload_bytes,
        transactions=rate * (TRANSACTIONS + EVENTS * mean),
    )


def queue_waits(
    arrivals: Float64[np.ndarray, " jobs"], seconds: Float64[np.ndarray, " jobs"], slots: int
) -> Float64[np.ndarray, " jobs"]:
    """Return how long each job waits until one of the slots is free; jobs start in the order of their arrival.

    Args:
        arrivals: time of each job's arrival, ascending, seconds.
        seconds: duration of each job.
        slots: number of jobs that run simultaneously.
    """
    free, waits = [0.0] * slots, np.empty(len(arrivals))
    for at, (arrival, duration) in enumerate(zip(arrivals, seconds, strict=True)):
        start = max(arrival, free[0])
        waits[at] = start - arrival
        heapq.heapreplace(free, start + duration)
    return waits


def needed_nodes(costs: JobCosts, node: Node, jobs_per_day: float, wait: float) -> JobRun:
    """Return the smallest cluster on which 95 % of the jobs wait for at most ``wait`` seconds."""
    nodes = 1
    while (run := simulate_jobs(costs, node, nodes, jobs_per_day)).busy >= 1 or run.longest_wait > wait:
        nodes = max(nodes + 1, math.ceil(nodes * run.busy))
    return run
