"""The data folder: uploads on their way in, a folder for each job, and nothing whose name a client chose.

    incoming/TOKEN.part          an upload as it arrives
    jobs/ID/scene.ply            the upload, whole
    jobs/ID/work-TOKEN/          what a running job has written so far
    jobs/ID/checkpoint*.npz      where its training stands: all that outlives its process, until the job has ended
    jobs/ID/result/              the result, renamed into place once it is whole and on the disk
        scene.zip  report.json  files/NAME
    jobs/ID/decoded.ply          made when first asked for; decoded.json has its size and checksum

What a killed service leaves half-written stands under a name that nothing reads, and is swept at the next start.
"""

from __future__ import annotations

import fcntl
import os
import secrets
import shutil
from pathlib import Path
from typing import IO

from service.settings import SettingsError

BYTES_PER_GAUSSIAN = (68, 104, 164, 248)
"""Of a ``.ply``, by SH degree."""

STEPS_BYTES = 300_000
"""What a checkpoint tells of the steps done, if there are as many as settings allow."""

TUNED_BYTES, ENTRY_BYTES, MOST_ENTRIES = 12 * 14, 12 * 45, 1 << 16
"""What fine-tuning keeps of a Gaussian and of an entry, and how many entries there are at most, or nearly."""

UNFINISHED = ("work-*", ".*.part")
"""What a process that was ended leaves in its job's folder: a folder of its own, and the file that was to become the
next checkpoint."""


def checkpoint_bytes(gaussians: int, sh_degree: int, *, compact: bool = True, finetune: bool = False) -> int:
    """What the checkpoints of a scene's trainings take at most.

    That of compaction holds each parameter and the two moments of Adam, of no more Gaussians than the scene has; that
    of fine-tuning, beside it, the same of levels and of the codebook's entries. While one is written anew, the former
    one is still there.
    """
    first = compact * (STEPS_BYTES + 3 * BYTES_PER_GAUSSIAN[sh_degree] * gaussians)
    second = finetune * (STEPS_BYTES + TUNED_BYTES * gaussians + ENTRY_BYTES * min(max(gaussians, 64), MOST_ENTRIES))
    return first + second + max(first, second)


class Folders:
    """The data folder, which belongs to one service at a time.

    Raises:
        SettingsError: it cannot be made or written to, or another service uses it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.absolute()
        self.incoming, self.jobs = self.root / "incoming", self.root / "jobs"
        try:
            self.root.mkdir(mode=0o700, parents=True, exist_ok=True)
            for folder in (self.incoming, self.jobs):
                folder.mkdir(exist_ok=True)
            self._lock: IO[str] = (self.root / "lock").open("w")
        except OSError as error:
            raise SettingsError(
                f"KISSGS_DATA_DIR: cannot use {root}: {(error.strerror or str(error)).lower()}"
            ) from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise SettingsError(f"KISSGS_DATA_DIR: another service is using {root}; give this one its own") from error

    def close(self) -> None:
        """Let another service have the folder."""
        self._lock.close()

    def new_upload(self) -> Path:
        """Where an upload may arrive."""
        return self.incoming / f"{secrets.token_hex(8)}.part"

    def adopt(self, upload: Path, job_id: str) -> None:
        """Make a whole upload that of a job."""
        folder = self.jobs / job_id
        folder.mkdir()
        upload.rename(folder / "scene.ply")
        _sync(folder)
        _sync(self.jobs)

    def upload(self, job_id: str) -> Path:
        """The job's ``.ply``."""
        return self.jobs / job_id / "scene.ply"

    def result(self, job_id: str) -> Path:
        """The folder of the job's result; there if and only if the result is whole."""
        return self.jobs / job_id / "result"

    def decoded(self, job_id: str) -> Path:
        """The decoded scene, if it has been asked for."""
        return self.jobs / job_id / "decoded.ply"

    def checkpoint(self, job_id: str) -> Path:
        """Where the job's training keeps its state."""
        return self.jobs / job_id / "checkpoint.npz"

    def discard_checkpoints(self, job_id: str) -> None:
        """They are of no more use."""
        for path in (self.jobs / job_id).glob("checkpoint*.npz"):
            self.discard(path)

    def spare(self, job_id: str) -> list[Path]:
        """What an ended job can do without: its upload and its decoded scene, as far as they are there."""
        return [path for path in (self.upload(job_id), self.decoded(job_id)) if path.exists()]

    def new_work(self, job_id: str) -> Path:
        """A fresh folder for a job's process to write into."""
        folder = self.jobs / job_id / f"work-{secrets.token_hex(8)}"
        folder.mkdir()
        return folder

    def keep_result(self, job_id: str) -> None:
        """Make what a job's process has written its result, all at once; nothing to do if that is done already."""
        for work in (self.jobs / job_id).glob("work-*/result"):
            work.rename(self.result(job_id))
            _sync(self.jobs / job_id)

    def keep_decoded(self, work: Path, job_id: str) -> None:
        """Make a decoded scene the job's, all at once."""
        (work / "decoded.json").rename(self.decoded(job_id).with_suffix(".json"))
        (work / "decoded.ply").rename(self.decoded(job_id))
        _sync(self.jobs / job_id)

    def remove_work(self, job_id: str) -> None:
        """Remove what a process of the job has left, but for its checkpoint."""
        for pattern in UNFINISHED:
            for path in (self.jobs / job_id).glob(pattern):
                self.discard(path)

    def discard(self, path: Path) -> None:
        """Remove a file or folder, if it is there."""
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)

    def remove_job(self, job_id: str) -> None:
        """Remove all files of a job."""
        self.discard(self.jobs / job_id)

    def remove_unfinished(self) -> None:
        """Remove what was being written when a former service ended."""
        for path in self.incoming.iterdir():
            self.discard(path)
        for folder in self.jobs.iterdir():
            self.remove_work(folder.name)

    def remove_strangers(self, known: set[str]) -> None:
        """Remove what no known job owns: only while nothing arrives."""
        for path in self.jobs.iterdir():
            if path.name not in known:
                self.discard(path)

    def identity(self) -> int:
        """A number that this folder alone has."""
        path = self.root / "identity"
        if not path.exists():
            path.write_text(str(secrets.randbits(48)), encoding="ascii")
        return int(path.read_text(encoding="ascii"))

    def free_bytes(self) -> int:
        """What the disk has left."""
        return shutil.disk_usage(self.root).free

    def job_bytes(self, job_id: str) -> int:
        """What the files of a job take."""
        return sum(path.stat().st_size for path in (self.jobs / job_id).rglob("*") if path.is_file())


def _sync(folder: Path) -> None:
    """Have the names in a folder on the disk, so that a power cut cannot undo a rename."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
