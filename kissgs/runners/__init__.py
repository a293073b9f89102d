"""Runners of work items: separate processes on this machine, or a Ray cluster. In: a :class:`WorkItem`, a function by
name with JSON arguments, and its request. Out: progress and an ``Outcome``."""

from kissgs.runners.contract import (
    INTERNAL,
    MEMORY_LIMIT,
    NODE_UNUSABLE,
    NOT_STARTED,
    TIME_LIMIT,
    UNREACHABLE,
    Outcome,
    Resources,
    RunHandle,
    Runner,
    WorkItem,
    error_of,
)
from kissgs.runners.process import LocalRunner
from kissgs.runners.ray_runner import RayRunner

__all__ = [
    "INTERNAL",
    "MEMORY_LIMIT",
    "NODE_UNUSABLE",
    "NOT_STARTED",
    "TIME_LIMIT",
    "UNREACHABLE",
    "LocalRunner",
    "Outcome",
    "RayRunner",
    "Resources",
    "RunHandle",
    "Runner",
    "WorkItem",
    "error_of",
]
