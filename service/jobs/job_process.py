"""Job process, ``python -m service.jobs.job_process``: compression or decoding outside the service's process.

It reads its task, a JSON object, from the first line of standard input, and writes one line of JSON to standard output
per event. When standard input closes, because the service has ended, the process exits.
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
"""Minimum seconds between progress events of a stage."""

MEMORY_DETAIL = "the job exceeded its memory limit; submit a scene with fewer Gaussians"

Send = Callable[[dict[str, Any]], None]


def main() -> None:
    """Read the task, run it, and send its result or its error."""
    task = json.loads(_first_line())
    for number in (signal.SIGINT, signal.SIGTERM):  # sent to the service, which ends this process if needed
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
    except Exception:  # noqa: BLE001  a bug, reported by standard error and the exit status
        traceback.print_exc()
        os._exit(1)
    os._exit(0)  # without waiting for threads of libraries


def _compress(task: dict[str, Any], send: Send) -> dict[str, Any]:
    import kissgs

    result = _run_compression(task, send)
    folder = Path(task["work"]) / "result"
    folder.mkdir()
    container = folder / task["container"]
    result.save(container)
    result.save(folder / "files")
    for path in (folder / "files", folder):
        _sync(path)
    report = result.report.as_dict()
    _write(folder / "report.json", json.dumps(report, indent=2).encode())
    stored = result.report.file_bytes
    files = {
        path.name: {**_size_and_hash(path), "stored": stored[path.name]}
        for path in sorted((folder / "files").iterdir())
    }
    summary = {
        "container": _size_and_hash(container),
        "report": _size_and_hash(folder / "report.json"),
        "files": files,
        "source_format": kissgs.recognise(Path(task["source"])),
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
        evaluation = report["evaluation"]
        summary["evaluation"] = {
            **evaluation["mean"]["candidate_vs_reference"],
            **{name: evaluation[name] for name in ("worst", "fifth_percentile", "shown")},
        }
    _write(folder / "summary.json", json.dumps(summary).encode())
    return summary


def _run_compression(task: dict[str, Any], send: Send) -> kissgs.Compressed:
    """Compress the scene, continuing from its checkpoint if there is one.

    Checkpoints are optional: an unusable one (damaged, or of another version of kissgs) is replaced, and if none can be
    written, because the disk is full, the job runs without.
    """
    import kissgs

    checkpoint = None
    if task["checkpoint"] is not None:  # relative, because the report may name it to the client
        checkpoint = Path(os.path.relpath(task["checkpoint"], task["work"]))
    while True:
        kept = [] if checkpoint is None else sorted(checkpoint.parent.glob(f"{checkpoint.stem}*{checkpoint.suffix}"))
        try:
            return kissgs.compress(
                Path(task["source"]),
                settings=kissgs.Settings.model_validate(task["settings"]),
                container=task["format"],
                evaluate=task["evaluate"],
                checkpoint=checkpoint,
                threads=task["threads"],
                progress=_Throttle(send),
            )
        except kissgs.OutputError:  # of the checkpoint: nothing else has been written so far
            if checkpoint is None:
                raise
            if kept:  # the latest first: earlier ones may be usable
                kept[0].unlink(missing_ok=True)
            else:
                checkpoint = None


def _decode(task: dict[str, Any], send: Send) -> dict[str, Any]:
    import kissgs

    target = Path(task["work"]) / "decoded.ply"
    kissgs.decompress(Path(task["source"]), target, threads=task["threads"], progress=_Throttle(send))
    described = _size_and_hash(target)
    _write(target.with_suffix(".json"), json.dumps(described).encode())
    return described


def _size_and_hash(path: Path) -> dict[str, Any]:
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
    """Progress callback that sends the start and end of each stage, and between them one event per interval."""

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
    """Return a function that sends events on standard output, and redirect output of libraries to standard error."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lock = threading.Lock()

    def send(event: dict[str, Any]) -> None:
        with lock:
            out.write(json.dumps(event) + "\n")
            out.flush()

    return send


def _limit_resources(memory: int) -> None:
    """Lower the priority, limit memory to ``memory`` bytes, and become the first victim of the out-of-memory killer."""
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
        block = os.read(0, 65536)  # nothing follows the line, so no data is lost
        if not block:
            os._exit(1)
        line += block
    return line


def _exit_with_service() -> None:
    while os.read(0, 4096):  # sys.stdin has a lock that the interpreter needs at exit
        pass
    os._exit(1)


if __name__ == "__main__":
    main()
