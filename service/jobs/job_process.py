"""Work of jobs: compression and decoding, run by :mod:`kissgs.runners` in a process of their own. Tasks name their
files relative to the folder of the job, the current one of the process, and results are written below its folder
``work``. This module reads and writes all files of jobs that the service's own process does not."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import kissgs

Task = dict[str, Any]

REPORTED = ("count", "finetuning", "note", "invisible", "cleaned", "seconds", "cpu_seconds")
"""Entries of the library's report that the summary repeats."""


def compress(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Compress the scene ``source`` into the folder ``result`` of ``work``, and return its summary."""
    import kissgs

    result = _run_compression(task, progress)
    folder = Path(task["work"]) / "result"
    folder.mkdir(parents=True)
    container = folder / task["container"]
    result.save(container)
    result.save(folder / "files")
    for path in (folder / "files", folder):
        sync_folder(path)
    report = result.report.as_dict()
    write_file(folder / "report.json", json.dumps(report, indent=2).encode())
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
        "compacted": result.report.compacted,
        **{name: report[name] for name in REPORTED},
    }
    if report["evaluation"] is not None:
        evaluation = report["evaluation"]
        mean = evaluation["mean"]
        of_photographs = {} if mean["reference"] is None else {name: mean[name] for name in ("reference", "candidate")}
        summary["evaluation"] = {
            **mean["candidate_vs_reference"],
            **of_photographs,
            **{name: evaluation[name] for name in ("worst", "fifth_percentile", "detail", "shown")},
        }
    write_file(folder / "summary.json", json.dumps(summary).encode())
    return summary


def _run_compression(task: Task, progress: kissgs.Progress) -> kissgs.Compressed:
    """Compress the scene, continuing from its checkpoint if there is one. Checkpoints are optional: an unusable one
    (damaged, or of another version of kissgs) is replaced, and if none can be written, because the disk is full, the
    job runs without."""
    import kissgs

    views = None if task.get("views") is None else kissgs.load_views(Path(task["views"]), unpacked=True)
    checkpoint = None if task["checkpoint"] is None else Path(task["checkpoint"])
    while True:
        kept = [] if checkpoint is None else sorted(checkpoint.parent.glob(f"{checkpoint.stem}*{checkpoint.suffix}"))
        try:
            return kissgs.compress(
                Path(task["source"]),
                settings=kissgs.Settings.model_validate(task["settings"]),
                reading=kissgs.ReadOptions(origin=task.get("origin")),
                container=task["format"],
                evaluate=task["evaluate"],
                views=views,
                force_views=task.get("force_views", False),
                checkpoint=checkpoint,
                threads=task["threads"],
                device=task["device"],
                progress=progress,
            )
        except kissgs.OutputError:  # of the checkpoint: nothing else has been written so far
            if checkpoint is None:
                raise
            if kept:  # the latest first: earlier ones may be usable
                kept[0].unlink(missing_ok=True)
            else:
                checkpoint = None


def decode(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Decode the container ``source`` to ``decoded.ply`` in ``work``, and return its size and SHA-256."""
    import kissgs

    target = Path(task["work"]) / "decoded.ply"
    kissgs.decompress(Path(task["source"]), target, threads=task["threads"], progress=progress)
    described = _size_and_hash(target)
    write_file(target.with_suffix(".json"), json.dumps(described).encode())
    return described


def without_paths(message: str, task: Task) -> str:
    """Return a message for clients, which does not say where the files of a task lie."""
    for path in (f"{task['work']}/", f"{task['folder']}/"):
        message = message.replace(path, "")
    return message.replace(task["source"], "the scene") if task["source"] else message


def _size_and_hash(path: Path) -> dict[str, Any]:
    with path.open("rb") as file:
        return {"bytes": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def write_file(path: Path, data: bytes) -> None:
    """Write a file, and flush it to the disk."""
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to the disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    os.fsync(descriptor)
    os.close(descriptor)
