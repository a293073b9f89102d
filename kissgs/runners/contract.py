"""``Runner``: what every engine that runs work items has in common."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, Protocol, Self

from kissgs.core.errors import KissgsError, RunnerError
from kissgs.core.progress import Progress, silent

log = logging.getLogger("kissgs.runners")

MEMORY_LIMIT, TIME_LIMIT, INTERNAL, CRASHED = "memory-limit", "time-limit", "internal", "crashed"
LOST, UNREACHABLE, NOT_STARTED = "node-lost", "cluster-unreachable", "not-started"
NODE_UNUSABLE = "node-unusable"
"""Codes of outcomes beside those of :class:`kissgs.KissgsError`. UNREACHABLE and NOT_STARTED are of "lost" items that
have not caused it: the cluster was lost, or a machine had no resources for one more process. NODE_UNUSABLE is of an
"error" that only another node may not meet: this one cannot use the item's folder, or this version of kissgs."""


@dataclass(frozen=True, slots=True)
class Resources:
    """Request of an item: it starts where at least this much is free, and no other item gets that share.

    Attributes:
        cpus: processors.
        memory: bytes.
        gpus: GPUs; a fraction shares one.
    """

    cpus: float = 1.0
    memory: int = 0
    gpus: float = 0.0

    def fits(self, free: Resources) -> bool:
        """Whether ``free`` resources suffice."""
        return self.cpus <= free.cpus and self.memory <= free.memory and self.gpus <= free.gpus

    def __str__(self) -> str:
        parts = [f"{self.cpus:g} CPUs", f"{self.memory / 1e9:.2g} GB of memory", f"{self.gpus:g} GPUs"]
        return " and ".join(part for part in parts if not part.startswith("0 "))


@dataclass(frozen=True, slots=True)
class WorkItem:
    """One piece of work, as JSON: small, and the same on every machine.

    Attributes:
        function: ``"module:name"`` of a function ``(arguments, progress) -> result``, which every node can import.
            It may run more than once, if a node is lost, and must therefore write its files atomically.
        arguments: JSON arguments. Files are named by paths that every node sees, or that are relative to ``folder``.
        resources: what the item requests.
        seconds: limit of its time since its process was started; None for no limit.
        memory_limit: limit of the memory of its process, bytes, enforced on Linux; None for no limit.
        folder: current folder of its process; None for a new temporary one on the machine that runs it, which is
            removed when the process has ended, also after a kill.
        files: names of the files in ``folder`` that the function reads. On a node that does not see the folder they are
            copied to a temporary one, and what is new or changed there comes back, all through Ray's object store:
            now and then the files directly in it, which the function must write atomically, and after success those
            in its folders, too. Without files, the node must see the folder.
        retries: number of times that it is started again after its node was lost.
    """

    function: str
    arguments: dict[str, Any] = field(default_factory=dict)
    resources: Resources = Resources()
    seconds: float | None = None
    memory_limit: int | None = None
    folder: str | None = None
    files: tuple[str, ...] = ()
    retries: int = 3

    def as_dict(self) -> dict[str, Any]:
        """Return all fields for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Return the item with these fields, see :meth:`as_dict`."""
        return cls(**{**values, "resources": Resources(**values["resources"]), "files": tuple(values["files"])})


@dataclass(frozen=True, slots=True)
class Outcome:
    """How an item ended.

    Attributes:
        kind: "done" after success; "error" after an expected error, which another attempt would meet again; "crashed"
            if its process was ended by a signal; "lost" if its node or the whole cluster was lost, or no process could
            be started; "cancelled" after :meth:`Runner.cancel`.
        result: what the function returned, for "done".
        code: stable code of the error: that of a :class:`kissgs.KissgsError`, or one of this module.
        message: one sentence for the user.
        log: end of the standard error of the process, where that explains a crash or a bug.
        node: address of the node that ran the item; empty if that is this machine or none.
        starts: number of times that the item was started.
    """

    kind: Literal["done", "error", "crashed", "lost", "cancelled"]
    result: dict[str, Any] = field(default_factory=dict)
    code: str = ""
    message: str = ""
    log: str = ""
    node: str = ""
    starts: int = 1


@dataclass(frozen=True, slots=True)
class RunHandle:
    """An item that was submitted.

    Attributes:
        id: for :meth:`Runner.cancel`.
        outcome: future of its outcome, which is set once its process has ended. It never has an exception, and it is
            cancelled through the runner only.
    """

    id: str
    outcome: Future[Outcome]


@dataclass(frozen=True, slots=True)
class NodeResources:
    """A node of a runner.

    Attributes:
        address: of the node; empty for this machine.
        total: its resources.
    """

    address: str
    total: Resources


@dataclass(frozen=True, slots=True)
class RunnerStats:
    """State of a runner.

    Attributes:
        waiting: items that have not been started, or wait for a node again.
        running: items whose process runs.
        nodes: nodes that can run items.
    """

    waiting: int
    running: int
    nodes: tuple[NodeResources, ...]

    @property
    def cpus(self) -> float:
        """Processors of all nodes."""
        return sum(node.total.cpus for node in self.nodes)

    @property
    def smallest_cpus(self) -> float:
        """Processors of the node that has fewest."""
        return min((node.total.cpus for node in self.nodes), default=0.0)


class Runner(Protocol):
    """Engine that runs work items, each in a process of its own, as many at a time as their requests allow.

    It keeps nothing on disk: whoever submits items and is ended submits them again. All methods may be called from any
    thread. Items that no node can run wait until there is one; :meth:`refusal` says so beforehand.
    """

    def submit(self, item: WorkItem, progress: Progress = silent) -> RunHandle:
        """Queue an item; items of equal requests start in the order in which they were submitted.

        Args:
            item: the work.
            progress: receives the item's events in order, in a thread of the runner, and none after the outcome is
                set; an item that is started again begins again. It must not raise.
        """

    def cancel(self, item_id: str) -> None:
        """End an item, whether it waits or runs; do nothing if it has ended. Its outcome is then "cancelled"."""

    def refusal(self, resources: Resources) -> str | None:
        """Return a sentence about why no node could run an item with this request; None if one could."""

    def stats(self) -> RunnerStats:
        """Return the number of items and the nodes."""

    def health_problem(self) -> str | None:
        """Return a sentence about why items cannot run now; None if they can. A lost cluster is connected again."""

    def close(self) -> None:
        """Cancel all items, wait for their ends, and release everything; the runner cannot be used afterwards."""


def report(progress: Progress, stage: str, fraction: float, note: str) -> None:
    """Pass an event to a receiver; an exception of it is logged, and the work goes on."""
    try:
        progress(stage, fraction, note)
    except Exception:
        log.exception("a receiver of progress events failed")


def refusal_of(resources: Resources, nodes: Iterable[NodeResources]) -> str | None:
    """Return why none of these nodes could ever run an item with this request; None if one could."""
    known = list(nodes)
    if any(resources.fits(node.total) for node in known):
        return None
    if not known:
        return "no node can run work at the moment"
    largest = max(known, key=lambda node: (node.total.gpus, node.total.cpus, node.total.memory)).total
    return f"no node has {resources}; the largest has {largest}"


def error_of(outcome: Outcome) -> KissgsError:
    """Return the exception for an outcome that is not "done", of the class that its code belongs to."""
    classes, found = [KissgsError], list[type[KissgsError]]()
    while classes:
        found.append(classes.pop())
        classes += found[-1].__subclasses__()
    for known in found:
        if known.code == outcome.code:
            return known(outcome.message)
    error = RunnerError(outcome.message)
    error.code = outcome.code
    return error
