"""File size, times and memory of ``.sog`` and ``.spz`` by splat-transform, PlayCanvas' converter."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from kissgs import Evaluation, KissgsError, UnsupportedError, Views, evaluate, load

FORMATS = ("sog", "spz")


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """A scene that a codec encoded and decoded, in processes of their own; memory is in bytes."""

    bytes: int
    encode_seconds: float
    encode_cpu_seconds: float
    decode_cpu_seconds: float
    peak_memory: int
    evaluation: Evaluation


def measure_external(
    scene: Path, *, ending: str, command: Sequence[str], sh_iterations: int | None = None, views: Views | None = None
) -> Measured:
    """Encode a ``.ply`` in one of :data:`FORMATS`, decode it with the same tool, and compare the two. Seconds have the
    start-up of the tool. Without a GPU, ``.sog`` of a scene of degree 3 takes minutes for each of ``sh_iterations``."""
    iterations = [] if sh_iterations is None or ending != "sog" else ["-i", str(sh_iterations)]
    with tempfile.TemporaryDirectory() as folder:
        encoded, decoded = Path(folder, f"scene.{ending}"), Path(folder, "decoded.ply")
        wall, encode_cpu, memory = convert(command, scene.resolve(), encoded, iterations)
        _, decode_cpu, other_memory = convert(command, encoded, decoded, [])
        return Measured(
            bytes=encoded.stat().st_size,
            encode_seconds=wall,
            encode_cpu_seconds=encode_cpu,
            decode_cpu_seconds=decode_cpu,
            peak_memory=max(memory, other_memory),
            evaluation=evaluate(load(scene), load(decoded), views),
        )


WATCHER = """
import json, os, subprocess, sys, time
begin = time.perf_counter()
process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL, stdout=2)
_, status, usage = os.wait4(process.pid, 0)
resident = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
print(json.dumps([time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, resident]))
sys.exit(os.waitstatus_to_exitcode(status))
"""
"""A small process that starts the tool: Linux counts the memory of the process that starts another as the other's."""


def convert(command: Sequence[str], source: Path, target: Path, options: list[str]) -> tuple[float, float, int]:
    """Run the tool; return its wall time, its CPU time and its largest resident set."""
    if sys.platform == "win32":
        raise UnsupportedError("Windows does not report the resources of a process; use another system")
    call = [*command, "-g", "cpu", "-w", *options, str(source), str(target)]
    done = subprocess.run(
        [sys.executable, "-ISc", WATCHER, *call], check=False, capture_output=True, text=True, errors="replace"
    )
    if done.returncode or not target.is_file():
        last = (done.stderr.strip() or "no message").splitlines()[-1]
        raise KissgsError(f"{' '.join(command)} could not convert {source.name} to {target.suffix}: {last}")
    wall, cpu, memory = json.loads(done.stdout)
    return wall, cpu, memory


@cache
def version_of(tool: str) -> str:
    """Return what a command says about its version."""
    done = subprocess.run([*shlex.split(tool), "--version"], check=False, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise KissgsError(f"{tool} --version fails; give a command that starts splat-transform")
    return done.stdout.decode(errors="replace").strip()
