"""The heavy part of a job, in a process of its own: ``python -m service.jobs.job_process``.

One JSON object comes in on standard input, a line of JSON goes out on standard output for every event. The process
ends itself when its standard input closes, that is, when the service dies: no orphan outlives it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import kissgs

EVENT_SECONDS = 0.25
"""Between progress events of one stage."""

MEMORY_DETAIL = "the scene needs more memory than a job may have; choose one with fewer Gaussians"

Send = Callable[[dict[str, Any]], None]


def main() -> None:
    """Read what to do, do it, and say what came of it."""
    task = json.loads(_first_line())
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the service, which decides what becomes of us
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_exit_with_service, daemon=True).start()
    send = _sender()
    _limit_resources(task["memory"])
    import kissgs

    try:
        tasks: dict[str, Callable[[dict[str, Any], Send], dict[str, Any]]] = {"compress": _compress, "decode": _decode}
        send({"done": tasks[task["kind"]](task, send)})
    except kissgs.KissgsError as error:
        detail = str(error).replace(str(task["source"]), "the scene").replace(str(task["work"]), "")
        send({"error": {"code": error.code, "detail": detail.replace(" /", " ")}})
    except MemoryError:
        send({"error": {"code": "memory-limit", "detail": MEMORY_DETAIL}})
    except Exception:  # noqa: BLE001  a fault of ours, said on standard error and by the exit status
        traceback.print_exc()
        os._exit(1)
    os._exit(0)  # nothing is left to do, and no thread of a library needs waiting for


def _compress(task: dict[str, Any], send: Send) -> dict[str, Any]:
    result = _compressed(task, send)
    folder = Path(task["work"]) / "result"
    folder.mkdir()
    result.save(folder / "scene.zip")
    result.save(folder / "files")
    for made in (folder / "files", folder):
        _sync(made)
    report = result.report.as_dict()
    _write(folder / "report.json", json.dumps(report, indent=2).encode())
    stored = result.report.file_bytes
    files = {
        path.name: {**_described(path), "stored": stored[path.name]} for path in sorted((folder / "files").iterdir())
    }
    summary = {
        "container": _described(folder / "scene.zip"),
        "report": _described(folder / "report.json"),
        "files": files,
        "count": report["count"],
        "compacted": result.report.compacted,
        "finetuning": report["finetuning"],
        "invisible": report["invisible"],
        "cleaned": report["cleaned"],
        "seconds": report["seconds"],
        "cpu_seconds": report["cpu_seconds"],
        "peak_memory": report["peak_memory"],
    }
    if report["evaluation"] is not None:
        told = report["evaluation"]
        summary["evaluation"] = {
            **told["mean"]["candidate_vs_reference"],
            **{name: told[name] for name in ("worst", "fifth_percentile", "shown")},
        }
    _write(folder / "summary.json", json.dumps(summary).encode())
    return summary


def _compressed(task: dict[str, Any], send: Send) -> kissgs.Compressed:
    """The work itself, from its checkpoint on if there is one.

    A checkpoint is a help, no condition: one of no use (damaged, or of another version of kissgs) is replaced, and
    where none can be written (a full disk), the work is done without.
    """
    import kissgs

    checkpoint = None
    if task["checkpoint"] is not None:  # as seen from here: the report may name it, and is the client's to read
        checkpoint = Path(os.path.relpath(task["checkpoint"], task["work"]))
    while True:
        kept = [] if checkpoint is None else sorted(checkpoint.parent.glob(f"{checkpoint.stem}*{checkpoint.suffix}"))
        try:
            return kissgs.compress(
                Path(task["source"]),
                settings=kissgs.Settings.model_validate(task["settings"]),
                evaluate=task["evaluate"],
                checkpoint=checkpoint,
                threads=task["threads"],
                progress=_Throttle(send),
            )
        except kissgs.OutputError:  # the checkpoint's: nothing else is written yet
            if checkpoint is None:
                raise
            if kept:  # the latest work's first: what led to it may be sound
                kept[0].unlink(missing_ok=True)
            else:
                checkpoint = None


def _decode(task: dict[str, Any], send: Send) -> dict[str, Any]:
    import kissgs

    target = Path(task["work"]) / "decoded.ply"
    kissgs.decompress(Path(task["source"]), target, threads=task["threads"], progress=_Throttle(send))
    described = _described(target)
    _write(target.with_suffix(".json"), json.dumps(described).encode())
    return described


def _described(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def _write(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)


class _Throttle:
    """Passes on the beginning and the end of every stage, and in between what a person can follow."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._last, self._next = ("", -1.0, ""), 0.0

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        now = time.monotonic()
        event = stage, round(min(1.0, max(0.0, fraction)), 4), note
        if event == self._last or (stage == self._last[0] and now < self._next):
            return
        self._last, self._next = event, now + EVENT_SECONDS
        self._send({"stage": stage, "fraction": event[1], "note": note})


def _sender() -> Send:
    """Events leave by a descriptor of their own: what a library prints goes to the log instead."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lock = threading.Lock()

    def send(event: dict[str, Any]) -> None:
        with lock:
            out.write(json.dumps(event) + "\n")
            out.flush()

    return send


def _limit_resources(memory: int) -> None:
    """Take what the service leaves of the processor, no more memory than agreed, and be the first to be ended."""
    os.nice(10)
    if sys.platform == "linux":
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _first_line() -> bytes:
    line = b""
    while not line.endswith(b"\n"):
        block = os.read(0, 65536)  # nothing is sent after the line, so none of it is lost
        if not block:
            os._exit(1)
        line += block
    return line


def _exit_with_service() -> None:
    while os.read(0, 4096):  # not by sys.stdin, whose lock the interpreter wants when it ends
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
