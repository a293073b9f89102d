"""``RayCluster``: a head and nodes of a Ray cluster as processes on this machine, with all files in one folder."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
RAY = Path(sys.executable).with_name("ray")
NODE_MEMORY = 1_000_000_000
UNSEEN = """
import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import PathFinder
from pathlib import Path


class Patch(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name != "kissgs.runners.ray_node":
            return None
        spec = PathFinder.find_spec(name, path)
        run = spec.loader.exec_module

        def patched(module):
            run(module)
            seen = module.is_seen
            module.CHECKPOINT_SECONDS = 0.2
            module.is_seen = lambda folder: seen(folder) and any((p / "shared").exists() for p in Path(folder).parents)

        spec.loader.exec_module = patched
        return spec


sys.meta_path.insert(0, Patch())
"""
"""Start-up code of a node's processes."""

PATHS = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
"""``PYTHONPATH`` of nodes and of items."""


class RayCluster:
    """Cluster for use as ``with RayCluster() as cluster``; the head runs no items, each node one at a time.

    Whoever connects needs the variables ``environment``, a token. Nodes see no folder of an item, as if they were other
    machines, but those below a folder with a file ``shared``.
    """

    def __init__(self):
        self.folder = Path(tempfile.mkdtemp(prefix="kr-"))  # short: sockets below have paths of at most 107 bytes
        self.environment = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
        self.nodes: list[subprocess.Popen] = []
        self.logs: list[Path] = []
        self._temporary: dict[int, Path] = {}
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.address = f"127.0.0.1:{probe.getsockname()[1]}"

    def __enter__(self):
        quick = {"health_check_period_ms": 500, "health_check_failure_threshold": 4, "health_check_initial_delay_ms": 0}
        self.head = self._start(
            *("--head", f"--port={self.address.rpartition(':')[2]}", "--num-cpus=0", "--include-dashboard=false"),
            f"--system-config={json.dumps(quick)}",
        )
        return self

    def __exit__(self, *error):
        for node in [*self.nodes, self.head]:
            kill_tree(node)
        shutil.rmtree(self.folder, ignore_errors=True)

    def add_node(self):
        self.nodes.append(self._start(f"--address={self.address}", "--num-cpus=1", f"--memory={NODE_MEMORY}"))
        return self.nodes[-1]

    def items(self):
        """Return the ids of the processes of all items."""
        found = []
        for node in self.nodes:
            for pid in tree(node.pid):
                with contextlib.suppress(OSError):
                    if b"item_process" in Path(f"/proc/{pid}/cmdline").read_bytes():
                        found.append(pid)
        return found

    def kill_node_of(self, pid):
        """Kill the node that a process runs on."""
        kill_tree(next(node for node in self.nodes if pid in tree(node.pid)))

    def left_by_items(self):
        """Return the paths of temporary folders of items, on all running nodes, which may need a moment after a job."""
        running = [node for node in self.nodes if node.poll() is None]
        for _ in range(100):
            left = [str(path) for node in running for path in self._temporary[node.pid].glob("kissgs-*")]
            if not left:
                break
            time.sleep(0.1)
        return left

    def restore(self):
        """Start a node for each one that was killed."""
        for node in [node for node in self.nodes if node.poll() is not None]:
            self.nodes.remove(node)
            self.add_node()

    def _start(self, *options):
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("KISSGS_", "RAY_"))}
        environment = {**kept, **self.environment, "RAY_TMPDIR": str(self.folder), "RAY_USAGE_STATS_ENABLED": "0"}
        temporary = self.folder / f"temporary{len(self.logs)}"  # of its own, as on a machine of its own
        temporary.mkdir()
        environment["TMPDIR"] = str(temporary)
        (temporary / "sitecustomize.py").write_text(UNSEEN)
        log = self.folder / f"log{len(self.logs)}"
        self.logs.append(log)
        with log.open("wb") as file:
            process = subprocess.Popen(
                [RAY, "start", "--block", "--object-store-memory=80000000", *options],
                env={**environment, "PYTHONPATH": f"{temporary}{os.pathsep}{PATHS}"},
                stdout=file,
                stderr=file,
                cwd=self.folder,
            )
        self._temporary[process.pid] = temporary
        while b"Ray runtime started" not in log.read_bytes():  # two at a time would choose the same names of sockets
            assert process.poll() is None, log.read_text()
            time.sleep(0.05)
        return process


def tree(pid):
    """Return the ids of a process and of all processes below it."""
    found = [pid]
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                found += tree(int(child))
    return found


def kill_tree(process):
    """Kill a node as if its machine had lost its power: all of its processes at once."""
    pids = tree(process.pid)
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    process.wait()
