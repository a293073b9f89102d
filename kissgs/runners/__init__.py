"""Runners of work items: separate processes on this machine, or a Ray cluster. In: a :class:`WorkItem`, a function by
name with JSON arguments, and its request. Out: progress and an :class:`Outcome`."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, Self

from kissgs.core.context import Progress, silent, with_seconds_left
from kissgs.core.errors import KissgsError, RunnerError

log = logging.getLogger("kissgs.runners")
Send = Callable[[dict[str, Any]], None]  # sends an event from one process to another

MEMORY_LIMIT, TIME_LIMIT, INTERNAL, CRASHED = "memory-limit", "time-limit", "internal", "crashed"
LOST, UNREACHABLE, NOT_STARTED = "node-lost", "cluster-unreachable", "not-started"
NODE_UNUSABLE = "node-unusable"
"""Codes of outcomes beside those of :class:`kissgs.KissgsError`. UNREACHABLE and NOT_STARTED are of "lost" items that
have not caused it: the cluster was lost, or a machine had no resources for one more process. NODE_UNUSABLE is of an
"error" that only another node may not meet: this one cannot use the item's folder, or this version of kissgs."""


PROCESS_BYTES = 500_000_000  # memory that any work needs, bytes: mostly the libraries


@dataclass(frozen=True, slots=True)
class Resources:
    """Request of an item, or what a node has. An item starts where this much is free, and no other gets that share."""

    cpus: float = 1.0
    memory: int = 0  # bytes
    gpus: float = 0.0  # a fraction shares one

    def fits(self, free: Resources) -> bool:
        """Whether ``free`` resources suffice."""
        return self.cpus <= free.cpus and self.memory <= free.memory and self.gpus <= free.gpus

    def __str__(self) -> str:
        parts = [f"{self.cpus:g} CPUs", f"{self.memory / 1e9:.2g} GB of memory", f"{self.gpus:g} GPUs"]
        return " and ".join(part for part in parts if not part.startswith("0 "))


@dataclass(frozen=True, slots=True)
class WorkItem:
    """One piece of work, as JSON: small, and the same on every machine."""

    function: str
    """``"module:name"`` of a function ``(arguments, progress) -> result``, which every node can import. It may run more
    than once, if a node is lost, and must therefore write its files atomically."""

    arguments: dict[str, Any] = field(default_factory=dict)  # JSON; paths are seen by every node, or relative to folder

    resources: Resources = Resources()

    seconds: float | None = None  # limit of the time since the start of its process
    memory_limit: int | None = None  # limit of the memory of its process, bytes, enforced on Linux

    folder: str | None = None
    """Current folder of its process; None for a new temporary one on the machine that runs it, which is removed when
    the process has ended, also after a kill."""

    files: tuple[str, ...] = ()
    """Names of the files in ``folder`` that the function reads. On a node that does not see the folder they are copied
    to a temporary one, and what is new or changed there comes back, all through Ray's object store: now and then the
    files directly in it, and after success those in its folders, too. Without files, the node must see the folder."""

    retries: int = 3  # number of times that it is started again after its node was lost

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the item with these fields, those of ``dataclasses.asdict``, also after a way through JSON."""
        return cls(**{**values, "resources": Resources(**values["resources"]), "files": tuple(values["files"])})


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an item ended. "error" is an expected error, which another attempt would meet again; an item "crashed" if its
    process was ended by a signal, and was "lost" if its node or the whole cluster was, or no process could be
    started."""

    kind: Literal["done", "error", "crashed", "lost", "cancelled"]
    result: dict[str, Any] = field(default_factory=dict)  # what the function returned
    code: str = ""  # of the error: that of a kissgs.KissgsError, or one of this module
    message: str = ""  # one sentence for the user
    log: str = ""  # end of the standard error of the process, where that explains a crash or a bug
    node: str = ""  # address of the node that ran the item; empty if that is this machine or none


class Runner(Protocol):
    """Engine that runs work items, each in a process of its own. It keeps nothing on disk: whoever submits items and is
    ended submits them again. All methods may be called from any thread. Items that no node can run wait until there is
    one; :meth:`refusal` says so beforehand."""

    @property
    def nodes(self) -> tuple[Resources, ...]:
        """Resources of the nodes that can run items; none for a runner whose caller limits the number of items."""
        return ()

    def submit(self, item: WorkItem, progress: Progress = silent) -> Future[Outcome]:
        """Queue an item; return its outcome, which is set once its process has ended and never is an exception.
        ``progress`` receives its events in order, in a thread of the runner, and none after that; an item that is
        started again begins again."""

    def cancel(self, outcome: Future[Outcome]) -> None:
        """End an item, whether it waits or runs; do nothing if it has ended. Its outcome is then "cancelled"."""

    def refusal(self, resources: Resources) -> str | None:
        """Return a sentence about why no node could run an item with this request; None if one could."""
        return None

    def health_problem(self) -> str | None:
        """Return a sentence about why items cannot run now; None if they can. A lost cluster is connected again."""

    def close(self) -> None:
        """Cancel all items, wait for their ends, and release everything; the runner cannot be used afterwards."""


def report(progress: Progress, stage: str, fraction: float, note: str, seconds_left: float | None) -> None:
    """Pass an event to a receiver; an exception of it is logged, and the work goes on."""
    try:
        with_seconds_left(progress)(stage, fraction, note, seconds_left)
    except Exception:
        log.exception("a receiver of progress events failed")


def event_sender(descriptor: int) -> Send:
    """Return a function that writes events to a file descriptor as lines of JSON, from any thread."""
    out, lock = os.fdopen(descriptor, "w", encoding="utf-8"), threading.Lock()

    def send(event: dict[str, Any]) -> None:
        with lock, contextlib.suppress(BrokenPipeError):  # nobody listens any more, and standard input has closed, too
            out.write(json.dumps(event) + "\n")
            out.flush()

    return send


def refusal_of(resources: Resources, nodes: Iterable[Resources]) -> str | None:
    """Return why none of these nodes could ever run an item with this request; None if one could."""
    known = list(nodes)
    if any(resources.fits(node) for node in known):
        return None
    if not known:
        return "no node can run work at the moment"
    largest = max(known, key=lambda node: (node.gpus, node.cpus, node.memory))
    return f"no node has {resources}; the largest has {largest}"


def error_of(outcome: Outcome) -> KissgsError:
    """Return the exception for an outcome that is not "done", of the class that its code belongs to."""
    classes: list[type[KissgsError]] = [KissgsError]
    for known in classes:  # which grows
        if known.code == outcome.code:
            return known(outcome.message)
        classes += known.__subclasses__()
    error = RunnerError(outcome.message)
    error.code = outcome.code
    return error
