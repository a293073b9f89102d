"""Runners of work items: separate processes on this machine, or a Ray cluster.

In: a :class:`WorkItem`, a function by name with JSON arguments that name files, and the resources that it requests.
Out: progress events and one :class:`Outcome`. Scenes and results are named by their paths; only on a node of a cluster
that does not see an item's folder are its files copied.
"""

from kissgs.runners.contract import (
    INTERNAL,
    LOST,
    MEMORY_LIMIT,
    NODE_UNUSABLE,
    NOT_STARTED,
    TIME_LIMIT,
    UNREACHABLE,
    NodeResources,
    Outcome,
    Resources,
    RunHandle,
    Runner,
    RunnerStats,
    WorkItem,
    error_of,
)
from kissgs.runners.factory import open_runner

__all__ = [
    "INTERNAL",
    "LOST",
    "MEMORY_LIMIT",
    "NODE_UNUSABLE",
    "NOT_STARTED",
    "TIME_LIMIT",
    "UNREACHABLE",
    "NodeResources",
    "Outcome",
    "Resources",
    "RunHandle",
    "Runner",
    "RunnerStats",
    "WorkItem",
    "error_of",
    "open_runner",
]
