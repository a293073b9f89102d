"""Work of jobs: compression and decoding, run by :mod:`kissgs.runners` in a process of their own. Tasks name their
files relative to the folder of the job, the current one of the process, and results are written below its folder
``work``. This module reads and writes all files of jobs that the service's own process does not."""

from __future__ import annotations

import hashlib
import io
import json
import logging
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import kissgs
from kissgs.formats import CONTAINERS

from ..core.files import THUMBNAIL, THUMBNAIL_SIZE, sync_folder

log = logging.getLogger("kissgs.service")

Task = dict[str, Any]

REPORTED = ("count", "finetuning", "note", "invisible", "cleaned", "seconds", "cpu_seconds")
"""Entries of the library's report that the summary repeats."""


def compress(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Compress the scene ``source``, or convert it, into the folder ``result`` of ``work``, and return its summary."""
    folder = Path(task["work"]) / "result"
    folder.mkdir(parents=True)
    container = folder / task["container"]
    if task["format"] in CONTAINERS:
        result = _run_compression(task, progress)
        result.save(container)
        result.save(folder / "files")
        report, compacted, stored = result.report.as_dict(), result.report.compacted, result.report.file_bytes
        sync_folder(folder / "files")
    else:
        report, compacted, stored = _convert(task, container, progress), 0, {}
    write_file(folder / "report.json", json.dumps(report, indent=2).encode())
    summary = {
        "container": _size_and_hash(container),
        "report": _size_and_hash(folder / "report.json"),
        "files": {name: {**_size_and_hash(folder / "files" / name), "stored": stored[name]} for name in sorted(stored)},
        "source_format": kissgs.recognise(Path(task["source"])),
        "compacted": compacted,
        **{name: report.get(name) for name in REPORTED},
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
    try:
        image = _thumbnail(container, task["threads"])
    except Exception:  # whatever it is, the result is complete without
        log.exception("a result has no thumbnail")
        image = None
    if image is not None:
        write_file(folder / THUMBNAIL, image)
        summary["thumbnail"] = _size_and_hash(folder / THUMBNAIL)
    sync_folder(folder)
    write_file(folder / "summary.json", json.dumps(summary).encode())
    return summary


def _run_compression(task: Task, progress: kissgs.Progress) -> kissgs.Compressed:
    """Compress the scene, continuing from its checkpoint if there is one. Checkpoints are optional: an unusable one
    (damaged, or of another version of kissgs) is replaced, and if none can be written, because the disk is full, the
    job runs without."""
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


def _convert(task: Task, target: Path, progress: kissgs.Progress) -> dict[str, Any]:
    """Write the scene in a format that is no container; return a report."""
    began, cpu_began, threads = time.perf_counter(), time.process_time(), task["threads"]
    progress("read", 0.0)
    original = kissgs.load(Path(task["source"]), origin=task["origin"], threads=threads)
    progress("write", 0.4)
    notes = [*original.notes, *kissgs.save(original, target)]
    evaluation = None
    if task["evaluate"]:
        progress("evaluate", 0.6)
        views = None if task["views"] is None else kissgs.load_views(Path(task["views"]), unpacked=True)
        written = replace(kissgs.load(target, threads=threads), origin=original.origin)  # which the file cannot hold
        evaluation = kissgs.evaluate(original, written, views, threads=threads).as_dict()
    return {
        "count": len(original),
        "note": "; ".join(notes),
        "evaluation": evaluation,
        "seconds": {"convert": time.perf_counter() - began},
        "cpu_seconds": time.process_time() - cpu_began,
    }


def _thumbnail(result: Path, threads: int) -> bytes | None:
    """Draw a result from the view that its container records (docs/reference/format.md), else from one that kissgs
    finds. Return the image, or None of a scene without Gaussians."""
    import numpy as np
    from PIL import Image

    splats, (width, height) = kissgs.load(result, threads=threads), THUMBNAIL_SIZE
    if len(splats) == 0:
        return None
    metadata = result.parent / "files" / "meta.json"
    recorded = json.loads(metadata.read_bytes()).get("kissgs", {}) if metadata.exists() else {}
    if "view" not in recorded:
        views = kissgs.virtual_views(splats, width=width, height=height, count=1, threads=threads)
        camera = views.all[0].camera
    else:
        view = {name: np.array(value) for name, value in recorded["view"].items()}
        forward = view["target"] - view["eye"]
        right = np.cross(forward, view["up"])
        axes = [axis / np.linalg.norm(axis) for axis in (right, np.cross(forward, right), forward)]
        eye = view["eye"] + recorded.get("origin", (0, 0, 0)) - np.array(splats.origin)
        viewmat = np.vstack([np.column_stack([axes, -np.array(axes) @ eye]), [0, 0, 0, 1]])
        focal = height / 2 / np.tan(np.radians(view["fov"]) / 2)
        intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        camera = kissgs.Camera(viewmat, intrinsics, width, height)
    image, _ = kissgs.render(splats, camera, threads=threads)
    file = io.BytesIO()
    Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(file, "WEBP", quality=80)
    return file.getvalue()


def decode(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Decode the result ``source`` to ``decoded-SHA256.ply`` in ``work``; return its size and SHA-256."""
    source, target = Path(task["source"]), Path(task["work"]) / "decoded.ply"
    if source.suffix == ".ply":
        kissgs.save(kissgs.load(source, threads=task["threads"], progress=progress), target)
    else:
        kissgs.decompress(source, target, threads=task["threads"], progress=progress)
    described = _size_and_hash(target)
    target.rename(target.with_stem(f"decoded-{described['sha256']}"))
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
