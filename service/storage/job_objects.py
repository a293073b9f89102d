"""``JobObjects``: keys of the files of one job in a bucket.

    PREFIX/jobs/ID/scene.ENDING                 the complete upload
    PREFIX/jobs/ID/checkpoint*.npz              checkpoints of training that any start of the job may continue
    PREFIX/jobs/ID/result-REPLICA-TOKEN/        the result of one start; summary.json, the last, completes it
        scene.zip or scene.sog  report.json  files/NAME
    PREFIX/jobs/ID/decoded.ply                  the decoded scene; decoded.json, the last, completes it

A result's folder has the name of the replica that started the job and a token of that start, so that a replica or a
node that was given up, but still works, cannot change the result of another start.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

from ..core.formats import UPLOAD_FILES
from .job_storage import DECODED, RESULT, complete_summary
from .object_store import ObjectInfo, ObjectStore

JOB = re.compile("[0-9a-f]{32}")

SUMMARY, DECODED_SUMMARY = "summary.json", "decoded.json"

MAX_SUMMARY_BYTES = 1 << 20
"""Maximum bytes of a result's summary that are read."""


@dataclass(frozen=True, slots=True)
class JobObjects:
    """Files of a job by name, such as ``scene.ply``; methods block and raise ``OSError``.

    Attributes:
        objects: the bucket.
        job_id: id of the job, 32 hexadecimal digits.
    """

    objects: ObjectStore
    job_id: str

    def __post_init__(self) -> None:
        if not JOB.fullmatch(self.job_id):
            raise ValueError(f"{self.job_id!r} is not a job id")

    def key(self, *names: str) -> str:
        """Return the key of a file, or without names, the beginning of all keys."""
        return "/".join(("jobs", self.job_id, *names))

    def files(self) -> dict[str, ObjectInfo]:
        """Return all files by name."""
        folder = self.key()
        return {info.key.removeprefix(f"{folder}/"): info for info in self.objects.files(folder)}

    def remove(self, unwanted: Callable[[str], bool]) -> list[str]:
        """Remove all files whose name is unwanted; return the names of the others."""
        names = list(self.files())
        self.objects.delete(self.key(name) for name in names if unwanted(name))
        return [name for name in names if not unwanted(name)]

    def fetch_all(self, names: Iterable[str], folder: Path) -> None:
        """Copy those of these files that exist to a folder of this machine."""
        found = self.files()
        for name in names:
            if name in found:
                self.objects.fetch(self.key(name), folder / name)

    def upload(self) -> ObjectInfo | None:
        """Return the upload; None if there is none."""
        found = self.files()
        return next((found[name] for name in UPLOAD_FILES if name in found), None)

    def put_result(self, written: Path, folder: str) -> None:
        """Store the files of a result, which lie in a folder of this machine."""
        files = {str(path.relative_to(written)): path for path in written.rglob("*") if path.is_file()}
        last = files.pop(SUMMARY)
        self.objects.put_all((path, self.key(folder, name)) for name, path in sorted(files.items()))
        self.objects.put(last, self.key(folder, SUMMARY))

    def read_result(self, folder: str, container: str) -> dict[str, Any] | None:
        """Return the summary of a complete result with this container; None if there is none or it is damaged."""
        found = self.files()
        sizes = {
            name.removeprefix(f"{folder}/"): info.size for name, info in found.items() if name.startswith(f"{folder}/")
        }
        if not 0 < sizes.get(SUMMARY, 0) <= MAX_SUMMARY_BYTES:  # a node could have stored anything there
            return None
        return complete_summary(self.objects.get_bytes(self.key(folder, SUMMARY)), sizes, container)

    def result_folders(self) -> list[str]:
        """Return the names of the folders of results, complete or not."""
        return sorted({name.partition("/")[0] for name in self.files() if name.startswith(f"{RESULT}-")})

    def read_decoded(self) -> dict[str, Any] | None:
        """Return the description of the decoded scene; None if it is not there completely."""
        if not self.files().keys() >= {DECODED, DECODED_SUMMARY}:
            return None
        found: dict[str, Any] = json.loads(self.objects.get_bytes(self.key(DECODED_SUMMARY)))
        return found

    def sign(self, method: str, names: Iterable[str], seconds: float) -> dict[str, str]:
        """Return addresses by name with which anybody can read ("GET") or write ("PUT") these files for a time."""
        listed = list(names)
        addresses = self.objects.sign(method, [self.key(name) for name in listed], timedelta(seconds=seconds))
        return dict(zip(listed, addresses, strict=True))


def reclaimable(name: str) -> bool:
    """Return whether an ended job can do without this file."""
    return name in (*UPLOAD_FILES, DECODED, DECODED_SUMMARY)
