"""Work of jobs: compression and decoding, run by :mod:`kissgs.runners` in a process of their own. Tasks name their
files relative to the folder of the job, the current one of the process, and results are written below its folder
``work``. This module reads and writes all files of jobs that the service's own process does not."""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import kissgs
from kissgs.formats import CONTAINERS

from ..core.files import THUMBNAIL, THUMBNAIL_SIZE

if TYPE_CHECKING:
    import numpy as np

Task = dict[str, Any]
Made = TypeVar("Made")

REPORTED = ("count", "finetuning", "note", "invisible", "cleaned", "seconds", "cpu_seconds")
"""Entries of the library's report that the summary repeats."""


def compress(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Compress the scene ``source``, or convert it, into the folder ``result`` of ``work``, and return its summary."""
    folder = Path(task["work"]) / "result"
    folder.mkdir(parents=True)
    container = folder / task["container"]
    views = None if task.get("views") is None else kissgs.load_views(Path(task["views"]), unpacked=True)
    if task["format"] in CONTAINERS:
        report, stored = _compress(task, container, views, progress)
    else:
        report, stored = _convert(task, container, views, progress), {}
    write_file(folder / "report.json", json.dumps(report, indent=2).encode())
    compaction = report["compaction"]
    summary = {
        "container": _size_and_hash(container),
        "report": _size_and_hash(folder / "report.json"),
        "files": {name: {**_size_and_hash(folder / "files" / name), "stored": stored[name]} for name in sorted(stored)},
        "source_format": kissgs.recognise(Path(task["source"])),
        "compacted": 0 if compaction is None else compaction["source_count"] - compaction["count"],
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
    if (image := _thumbnail(container, task["threads"])) is not None:
        write_file(folder / THUMBNAIL, image)
        summary["thumbnail"] = _size_and_hash(folder / THUMBNAIL)
    sync_folder(folder)
    write_file(folder / "summary.json", json.dumps(summary).encode())
    return summary


def _compress(
    task: Task, container: Path, views: kissgs.Views | None, progress: kissgs.Progress
) -> tuple[dict[str, Any], dict[str, int]]:
    """Write the container, and its files beside it; return the report, and the bytes of each file in the container."""
    result = _resumed(
        task,
        lambda checkpoint: kissgs.compress(
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
        ),
    )
    result.save(container)
    result.save(container.parent / "files")
    sync_folder(container.parent / "files")
    return result.report.as_dict(), result.report.file_bytes


def _convert(task: Task, target: Path, views: kissgs.Views | None, progress: kissgs.Progress) -> dict[str, Any]:
    """Write the scene in a format that is no container, with fewer Gaussians if the settings say so; return a report
    whose entries have the names of those of a compression."""
    began = time.perf_counter(), time.process_time()
    source, origin, threads = Path(task["source"]), task.get("origin"), task["threads"]
    settings = kissgs.Settings.model_validate(task["settings"])
    splats = original = kissgs.load(source, origin=origin, threads=threads, progress=_Part(progress, 0.0, 0.1))
    notes, compaction = list(splats.notes), None
    if settings.compact.enabled:
        compacted = _resumed(
            task,
            lambda checkpoint: kissgs.compact(
                splats,
                settings=settings,
                views=views,
                force_views=task.get("force_views", False),
                checkpoint=checkpoint,
                threads=threads,
                device=task["device"],
                progress=_Part(progress, 0.1, 0.8),
            ),
        )
        splats, compaction = compacted.splats, compacted.report.as_dict()
        notes.append(compacted.report.note)
    notes += kissgs.save(splats, target, progress=_Part(progress, 0.8, 0.9))
    evaluation = None
    if task["evaluate"]:
        written = kissgs.load(target, origin=origin, threads=threads)
        found = kissgs.evaluate(original, written, views, threads=threads, progress=_Part(progress, 0.9, 1.0))
        evaluation = found.as_dict()
    return {
        "format": task["format"],
        "source_count": len(original),
        "count": len(splats),
        "source_bytes": source.stat().st_size,
        "container_bytes": target.stat().st_size,
        "compaction": compaction,
        "finetuning": None,
        "invisible": 0,
        "cleaned": None,
        "note": "; ".join(filter(None, notes)),
        "seconds": {"convert": time.perf_counter() - began[0]},
        "cpu_seconds": time.process_time() - began[1],
        "settings": task["settings"],
        "evaluation": evaluation,
    }


@dataclass(frozen=True, slots=True)
class _Part:
    """Receiver of a part of a job, from one fraction of the whole to another."""

    progress: kissgs.Progress
    first: float
    last: float

    def __call__(self, stage: str, fraction: float, note: str = "") -> None:
        self.progress(stage, self.first + fraction * (self.last - self.first), note)


def _resumed(task: Task, run: Callable[[Path | None], Made]) -> Made:
    """Run a training, continuing from its checkpoint if there is one. Checkpoints are optional: an unusable one
    (damaged, or of another version of kissgs) is replaced, and if none can be written, because the disk is full, the
    job runs without."""
    checkpoint = None if task["checkpoint"] is None else Path(task["checkpoint"])
    while True:
        kept = [] if checkpoint is None else sorted(checkpoint.parent.glob(f"{checkpoint.stem}*{checkpoint.suffix}"))
        try:
            return run(checkpoint)
        except kissgs.OutputError:  # of the checkpoint: nothing else has been written so far
            if checkpoint is None:
                raise
            if kept:  # the latest first: earlier ones may be usable
                kept[0].unlink(missing_ok=True)
            else:
                checkpoint = None


def _thumbnail(result: Path, threads: int) -> bytes | None:
    """Draw a result from the camera that its container records, else from one that kissgs finds; return the image, or
    None of a scene without Gaussians."""
    import numpy as np
    from PIL import Image

    splats = kissgs.load(result, threads=threads)
    if len(splats) == 0:
        return None
    metadata = result.parent / "files" / "meta.json"
    recorded = json.loads(metadata.read_bytes()).get("kissgs", {}) if metadata.exists() else {}
    if "view" in recorded:
        camera = _recorded_camera(recorded["view"], np.subtract(recorded.get("origin", (0, 0, 0)), splats.origin))
    else:
        width, height = THUMBNAIL_SIZE
        camera = kissgs.virtual_views(splats, width=width, height=height, count=1, threads=threads).all[0].camera
    image, _ = kissgs.render(splats, camera, threads=threads)
    file = io.BytesIO()
    Image.fromarray(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)).save(file, "WEBP", quality=80)
    return file.getvalue()


def _recorded_camera(view: dict[str, Any], shift: np.ndarray) -> kissgs.Camera:
    """Return the camera of a recorded view, see docs/reference/format.md, moved by ``shift``."""
    import numpy as np

    width, height = THUMBNAIL_SIZE
    eye, target, up = (np.array(view[name]) for name in ("eye", "target", "up"))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    viewmat = np.eye(4)
    viewmat[:3, :3] = right, np.cross(forward, right), forward
    viewmat[:3, 3] = -viewmat[:3, :3] @ (eye + shift)
    focal = height / 2 / np.tan(np.radians(view["fov"]) / 2)
    return kissgs.Camera(viewmat, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), width, height)


def decode(task: Task, progress: kissgs.Progress) -> dict[str, Any]:
    """Decode the result ``source`` to ``decoded.ply`` in ``work``, and return its size and SHA-256."""
    source, target = Path(task["source"]), Path(task["work"]) / "decoded.ply"
    if source.suffix == ".ply":
        kissgs.save(kissgs.load(source, threads=task["threads"], progress=progress), target)
    else:
        kissgs.decompress(source, target, threads=task["threads"], progress=progress)
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
