"""Driver process of :class:`kissgs.runners.ray_runner.RayRunner`: ``python -m kissgs.runners.ray_driver ADDRESS``.
Lines of JSON: items to submit and to cancel come from standard input, nodes and events of items go to standard output.
When standard input closes, it ends all items and exits."""

from __future__ import annotations

import asyncio
import json
import math
import os
import secrets
import shutil
import signal
import socket
import sys
import tempfile
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError, TaskCancelledError

from kissgs._version import __version__
from kissgs.core.errors import OutputError, RunnerError
from kissgs.runners import INTERNAL, LOST, NODE_UNUSABLE, Outcome, Send, WorkItem, event_sender, ray_node

CONNECT_SECONDS = 5.0  # maximum seconds for a connection to the head's port
OBJECT_STORE_BYTES = 80 << 20  # of a cluster that is started here: nearly the smallest; nothing is kept there
NODES_SECONDS = 1.0  # seconds between two looks at the cluster's nodes
RETRY_SECONDS = 1.0  # seconds before an item whose node was lost is started again: Ray may not know of the loss yet
FORCE_SECONDS = 5.0  # seconds after which a cancelled task that has not ended is killed
EVENTS_AHEAD = 4  # events of a start that have not been read, beyond which its task waits: they may be blocks of files
LOCAL = "local"  # argument instead of an address: start a cluster on this machine


def main() -> None:
    """Connect, run items until standard input closes, and disconnect."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    out = os.dup(1)
    send = event_sender(out)
    os.dup2(2, 1)  # for what Ray prints
    address = sys.argv[1]
    folder = tempfile.mkdtemp(prefix="kissgs-ray-") if address == LOCAL else None
    try:
        if folder is not None:
            start_here(folder)
        elif not connect(address):
            # Replace this process by one that starts a cluster on this machine, with a token of its own: without one,
            # Ray would let everyone in who reaches its ports, or write one to the home folder. It reads its environment
            # when it is imported, so that this process cannot set one.
            os.dup2(out, 1)
            protected = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
            os.execve(sys.executable, [sys.executable, "-P", "-m", f"{__package__}.ray_driver", LOCAL], protected)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # standard input closes when items shall end; Ray sets a handler
        send({"nodes": _nodes()})
        asyncio.run(Driver(send).run())
    except RunnerError as error:
        send({"failed": str(error)})
    finally:
        ray.shutdown()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _nodes() -> list[dict[str, Any]]:
    """Return the resources of the nodes that can run items."""
    return [
        {"cpus": found["CPU"], "memory": int(found.get("memory", 0)), "gpus": found.get("GPU", 0.0)}
        for node in ray.nodes()
        if node["Alive"] and (found := node["Resources"]).get("CPU", 0) > 0
    ]


# Connection to a cluster that runs, or to one that this process starts.


def connect(address: str) -> bool:
    """Connect this process to a cluster; return False if the address is "auto", and this machine has none."""
    given = address if address != "auto" else os.environ.get("RAY_ADDRESS", "")
    if "://" in given:
        raise RunnerError(
            f"{given} is an address for Ray's client; give HOST:PORT of the cluster's head, on a machine of the cluster"
        )
    if given:
        host, colon, port = given.rpartition(":")
        if not colon or not port.isdecimal():
            raise RunnerError(f"{given} is no address of a Ray cluster; give HOST:PORT of its head, usually port 6379")
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise RunnerError(f"no Ray cluster answers at {given}: {reason}; is its head running there?") from error
    try:
        ray.init(address=given or "auto", log_to_driver=False, configure_logging=False)
    except Exception as error:  # among them RuntimeError for another version of Ray or Python
        if isinstance(error, ConnectionError) and not given:
            return False
        known = given or "of this machine"
        raise RunnerError(
            f"cannot join the Ray cluster {known}: {first_line(error)}; this machine must be one of its nodes "
            f"(ray start --address={known} --num-cpus=0), and have its token if it has one (RAY_AUTH_MODE=token)"
        ) from error
    return True


def start_here(folder: str) -> None:
    """Start a cluster on this machine, with its files in ``folder``, which ends with this process."""
    try:
        ray.init(
            address="local",
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            log_to_driver=False,
            configure_logging=False,
            _temp_dir=folder,
        )
    except Exception as error:
        raise RunnerError(f"Ray cannot be started on this machine: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, for the middle of a sentence."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")[:300]


# Items on the cluster.


class Driver:
    """All items of this process, each an asyncio task that follows its Ray task."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._generators: dict[str, Any] = {}
        self._cancelled = set[str]()
        self._sends_files = False  # until a node has not seen a folder
        self._function = ray.remote(ray_node.run_on_node)  # once, because each call stores one more in the cluster

    async def run(self) -> None:
        """Handle messages from standard input until that closes; then cancel all items."""
        watching = asyncio.create_task(self._watch_nodes())
        while line := await asyncio.to_thread(sys.stdin.readline):
            message = json.loads(line)
            if "submit" in message:
                item_id = message["submit"]
                self._tasks[item_id] = asyncio.create_task(self._run(item_id, WorkItem.from_dict(message["item"])))
            else:
                self._cancel(message["cancel"])
        for item_id in list(self._tasks):
            self._cancel(item_id)
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)
        watching.cancel()

    def _cancel(self, item_id: str) -> None:
        if item_id in self._tasks and item_id not in self._cancelled:  # once: a second interrupt would hit the clean-up
            self._cancelled.add(item_id)
            if item_id in self._generators:
                ray.cancel(self._generators[item_id])  # not by force, so that the task removes its temporary folder
                asyncio.get_running_loop().call_later(FORCE_SECONDS, self._end, item_id)

    def _end(self, item_id: str) -> None:
        """Kill the process of a cancelled item's task, if it has not ended."""
        if item_id in self._generators:
            ray.cancel(self._generators[item_id], force=True)

    async def _watch_nodes(self) -> None:
        last: list[dict[str, Any]] = []
        while True:
            nodes = await asyncio.to_thread(_nodes)
            if nodes != last:
                self._send({"nodes": nodes})
                last = nodes
            await asyncio.sleep(NODES_SECONDS)

    async def _run(self, item_id: str, item: WorkItem) -> None:
        outcome = Outcome("cancelled")
        try:
            for start in range(1, item.retries + 2):  # again as long as its node is lost
                outcome = await self._start(item_id, item, start)
                if outcome.kind != "lost":
                    break
                if item_id in self._cancelled:  # and its task killed, because it did not end
                    outcome = Outcome("cancelled")
                    break
                await asyncio.sleep(RETRY_SECONDS)
        except Exception as error:  # noqa: BLE001  a request that Ray refuses, for example; the item must end
            message = f"Ray cannot run the work: {first_line(error)}"
            outcome = Outcome("error", code=INTERNAL, message=message, log=traceback.format_exc()[-4000:])
        self._generators.pop(item_id, None)
        del self._tasks[item_id]
        self._cancelled.discard(item_id)
        self._send({"id": item_id, "outcome": asdict(outcome)})

    async def _start(self, item_id: str, item: WorkItem, start: int) -> Outcome:
        """Start an item, a second time with its files if the node does not see its folder; return the outcome."""
        folder = Path(item.folder or "")

        def stored() -> dict[str, list[Any]]:  # references to blocks in Ray's object store, by name
            return {name: [ray.put(block) for block in ray_node.blocks_of(folder / name)] for name in item.files}

        for with_files in (self._sends_files, True):
            try:
                files = await asyncio.to_thread(stored) if with_files and item.files else None
            except OSError as error:
                return _unusable_files(error)
            if item_id in self._cancelled:
                break
            self._generators[item_id] = self._task(item).remote(asdict(item), __version__, files)
            outcome = await self._follow(item_id, item, start)
            if outcome is not None:
                return outcome
            self._sends_files = True
        return Outcome("cancelled")

    def _task(self, item: WorkItem) -> Any:  # noqa: ANN401  Ray's decorated functions have no useful type
        """Return the Ray task that runs an item, with its requests."""
        wanted = item.resources
        return self._function.options(
            num_cpus=wanted.cpus if wanted.cpus <= 1 else math.ceil(wanted.cpus),
            num_gpus=wanted.gpus if wanted.gpus <= 1 else math.ceil(wanted.gpus),
            memory=wanted.memory or None,
            num_returns="streaming",
            _generator_backpressure_num_objects=EVENTS_AHEAD,
            max_retries=0,
            scheduling_strategy="SPREAD",
            name=item.function,
        )

    async def _follow(self, item_id: str, item: WorkItem, start: int) -> Outcome | None:
        """Forward the events of one start of an item; return its outcome, None if the node needs the item's files."""
        node = ""
        try:
            async for reference in self._generators[item_id]:
                event = await reference
                if "unseen" in event:
                    return None
                if "file" in event:
                    await asyncio.to_thread(ray_node.receive, Path(item.folder or ""), event)
                    continue
                if "outcome" in event:
                    return Outcome(**{**event["outcome"], "node": node})
                if "node" in event:
                    node = event["node"]
                else:
                    self._send({"id": item_id, "progress": event["progress"]})
        except TaskCancelledError:
            return Outcome("cancelled", node=node)
        except RayTaskError as error:  # raised by the task itself, outside the item's process
            reason = first_line(error.cause or error)
            message = f"a node of the cluster cannot run kissgs {__version__}: {reason}; install it there"
            return Outcome("error", code=NODE_UNUSABLE, message=message, log=str(error)[-4000:], node=node)
        except RayError as error:
            message = f"the node {node or 'of the work'} was lost {start} times: {first_line(error)}"
            return Outcome("lost", code=LOST, message=message, node=node)
        except OSError as error:  # of a file that has come back
            ray.cancel(self._generators[item_id])
            return _unusable_files(error)
        return Outcome("lost", code=LOST, message="the work ended without an outcome", node=node)


def _unusable_files(error: OSError) -> Outcome:
    reason = (error.strerror or str(error)).lower()
    message = f"the files of the work cannot be read or written: {reason}"
    return Outcome("error", code=OutputError.code, message=message)


if __name__ == "__main__":
    main()
