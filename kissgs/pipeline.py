"""``compress`` and ``decompress``: the stages put together, and the report of what each took and gave."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from kissgs._typing import Int
from kissgs.errors import InvalidContainerError, OutputError
from kissgs.importance import Importance
from kissgs.io.atomic import atomic_file, reason_of, refuse_existing
from kissgs.io.ply import read_ply, write_ply
from kissgs.progress import Progress, silent
from kissgs.report import Report
from kissgs.settings import Settings
from kissgs.sogxt.container import check_destination, write_container, zip_bytes
from kissgs.sogxt.decode import MAX_GAUSSIANS, decode
from kissgs.splats import Cleaned, Splats, clean

if TYPE_CHECKING:
    from kissgs.evaluation.likeness import Evaluation
    from kissgs.views.view import Views

AnyPath = str | PathLike[str]

ZIP_BEGINNINGS = (b"PK\x03\x04", b"PK\x05\x06")


@dataclass(frozen=True, slots=True)
class Compressed:
    """A container in memory.

    Attributes:
        files: name -> bytes.
        order: ``(M,)`` for every Gaussian of the container, in its order, the index it has in the cleaned scene.
        report: what it took and gave.
    """

    files: Mapping[str, bytes]
    order: Int[np.ndarray, " M"]
    report: Report

    def to_zip(self) -> bytes:
        """The container as one stored zip."""
        return zip_bytes(self.files)

    def save(self, path: AnyPath, *, overwrite: bool = False) -> None:
        """Write a zip (if the name ends in ``.zip``) or a folder, whole or not at all.

        Raises:
            OutputError: it exists and ``overwrite`` is false, or the file system refuses.
        """
        write_container(self.files, Path(path), overwrite=overwrite)


def load(path: AnyPath, *, max_gaussians: int = MAX_GAUSSIANS, threads: int = 0, progress: Progress = silent) -> Splats:
    """Read a scene: a ``.ply`` of any of the field's tools, or a SOG-XT container (zip or folder); cleaned.

    A container with more than ``max_gaussians`` is refused before memory is taken for them.

    Raises:
        InvalidSceneError: the ``.ply`` is not a usable scene.
        InvalidContainerError: the container is damaged.
        UnsupportedError: something valid that kissgs does not read.
    """
    return clean(_read(Path(path), threads, progress, max_gaussians))[0]


def save(splats: Splats, path: AnyPath, *, overwrite: bool = False, progress: Progress = silent) -> None:
    """Write a scene as ``.ply`` (binary, INRIA layout, at its own SH degree), whole or not at all.

    For containers there is :func:`compress`.

    Raises:
        OutputError: it exists and ``overwrite`` is false, its name does not end in ``.ply``, or the disk refuses.
    """
    path = Path(path)
    _check_ply(path, overwrite=overwrite)
    with atomic_file(path, overwrite=overwrite) as file:
        write_ply(file, splats, progress=progress)


def compress(
    source: Splats | AnyPath | bytes,
    destination: AnyPath | None = None,
    *,
    settings: Settings | None = None,
    importance: Importance | None = None,
    cache: AnyPath | None = None,
    evaluate: bool = False,
    views: Views | None = None,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> Compressed:
    """Compress a scene into a SOG-XT container.

    Args:
        source: a scene, or the path or the bytes of a ``.ply`` (a container is decoded and encoded anew).
        destination: ``.zip`` or folder to write; by default nothing is written.
        settings: by default those of the preset ``balanced``.
        importance: of a clean ``source``, measured before (:func:`kissgs.measure_importance`); by default it is
            measured if the settings ask for it.
        cache: ``.npz`` in which to keep the importance that was measured. Next time it is taken from there, if neither
            the scene nor the cameras have changed, and replaced otherwise.
        evaluate: decode the result and compare its pictures with those of the cleaned scene, and with the photographs
            of ``views`` if they have any; see :func:`kissgs.evaluate`. The report then has an ``evaluation``.
        views: a capture of the scene: its cameras for training weigh the bits, those held out are for evaluation; by
            default virtual cameras for both.
        overwrite: replace ``destination`` if it exists.
        threads: 0 means one per processor; the bytes do not depend on it.
        progress: receives events; raise :class:`kissgs.Cancelled` from it to stop. Nothing is written then.

    Returns:
        The container in memory, and the report.

    Raises:
        KissgsError: one of its children, with a sentence for the user.
    """
    from kissgs.encoding import encode_scene

    settings = settings or Settings()
    target = Path(destination) if destination is not None else None
    if target is not None:
        check_destination(target, overwrite=overwrite)
    kept = Path(cache) if cache is not None else None
    clock = _Clock(progress)
    splats, cleaned, source_bytes = _open(source, threads, clock)
    encoded, trials = encode_scene(splats, settings.encode, importance, kept, views, cleaned, threads, clock)
    archive_bytes = len(zip_bytes(encoded.files))
    evaluation = _evaluate(splats, encoded.files, views, threads, clock) if evaluate else None
    if target is not None:
        clock("write", 0.0)
        write_container(encoded.files, target, overwrite=overwrite)
    clock.stop()
    report = Report(
        source_count=len(splats) + cleaned.removed,
        count=len(encoded.order),
        sh_degree=splats.sh_degree,
        source_bytes=source_bytes,
        container_bytes=archive_bytes,
        file_bytes={name: len(data) for name, data in encoded.files.items()},
        cleaned=cleaned,
        invisible=encoded.invisible,
        negligible=encoded.negligible,
        tamed_colours=encoded.tamed,
        form_error=encoded.form_error,
        half_steps=encoded.errors,
        price=encoded.price,
        trials=trials,
        seconds=clock.seconds,
        cpu_seconds=clock.cpu_seconds,
        peak_memory=peak_memory(),
        settings=settings.model_dump(mode="json"),
        evaluation=evaluation,
    )
    return Compressed(encoded.files, encoded.order, report)


def decompress(
    source: AnyPath | bytes | Mapping[str, bytes],
    destination: AnyPath | None = None,
    *,
    max_gaussians: int = MAX_GAUSSIANS,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Decode a SOG-XT container.

    Args:
        source: path of a zip or a folder, the bytes of a zip, or the files in memory.
        destination: ``.ply`` to write; by default nothing is written.
        max_gaussians: refuse a container that holds more, before memory is taken for them.
        overwrite: replace ``destination`` if it exists.
        threads: 0 means one per processor.
        progress: receives events.

    Returns:
        The scene exactly as stored: quaternions as quantised, their length only about 1.

    Raises:
        InvalidContainerError: the container is damaged.
        UnsupportedError: it has a feature that kissgs does not read.
        OutputError: ``destination`` cannot be written.
    """
    if destination is not None:
        _check_ply(Path(destination), overwrite=overwrite)
    scene = source if isinstance(source, bytes | Mapping) else Path(source)
    splats = decode(scene, max_gaussians=max_gaussians, threads=threads, progress=progress)
    if destination is not None:
        save(splats, destination, overwrite=overwrite, progress=progress)
    return splats


def is_container(source: Path | bytes) -> bool:
    """Whether this looks like a container rather than a ``.ply``: a folder, or something that begins as a zip."""
    if isinstance(source, bytes):
        return source[:4] in ZIP_BEGINNINGS
    try:
        if source.is_dir():
            return True
        if not source.is_file():  # a pipe would keep us waiting
            return source.suffix.lower() == ".zip"
        with source.open("rb") as file:
            return file.read(4) in ZIP_BEGINNINGS
    except (OSError, ValueError):
        return source.suffix.lower() == ".zip"


def _check_ply(path: Path, *, overwrite: bool) -> None:
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: only .ply files are written here; use compress for containers")
    refuse_existing(path, overwrite=overwrite)


def peak_memory() -> int:
    """Bytes, the largest resident set this process has had; 0 where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _evaluate(
    splats: Splats, container: Mapping[str, bytes], views: Views | None, threads: int, clock: Progress
) -> Evaluation:
    """One stage of compression, whatever stages of its own it has: decoding, kernels, pictures."""
    from kissgs.evaluation.pictures import evaluate

    clock("evaluate", 0.0)
    decoded = decode(container, max_gaussians=max(len(splats), MAX_GAUSSIANS), threads=threads)

    def receive(stage: str, fraction: float) -> None:
        clock("evaluate", fraction if stage == "evaluate" else 0.0)

    return evaluate(splats, decoded, views, threads=threads, progress=receive)


def _open(source: Splats | AnyPath | bytes, threads: int, progress: Progress) -> tuple[Splats, Cleaned, int]:
    if isinstance(source, Splats):
        splats, cleaned = clean(source)
        return splats, cleaned, source.nbytes
    progress("read", 0.0)
    scene = source if isinstance(source, bytes) else Path(source)
    splats, cleaned = clean(_read(scene, threads, progress))
    return splats, cleaned, len(scene) if isinstance(scene, bytes) else stored_bytes(scene)


def _read(source: Path | bytes, threads: int, progress: Progress, max_gaussians: int = MAX_GAUSSIANS) -> Splats:
    """As it stands in the file; the limit is for containers, which can hold far more than they weigh."""
    if is_container(source):
        return decode(source, max_gaussians=max_gaussians, threads=threads, progress=progress)
    return read_ply(source, progress=progress)


def stored_bytes(path: Path) -> int:
    """Of a file, or of all files in a folder.

    Raises:
        InvalidContainerError: the file system refuses.
    """
    try:
        return sum(entry.stat().st_size for entry in path.iterdir()) if path.is_dir() else path.stat().st_size
    except OSError as error:
        raise InvalidContainerError(f"cannot read {path}: {reason_of(error)}") from error


@dataclass
class _Clock:
    """Passes progress on, and takes the time of each stage on the way."""

    receiver: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    cpu_seconds: float = 0.0
    _stage: str | None = None
    _since: float = 0.0
    _cpu_since: float = field(default_factory=time.process_time)

    def __call__(self, stage: str, fraction: float) -> None:
        if stage != self._stage:
            self.stop()
            self._stage, self._since = stage, time.perf_counter()
        self.receiver(stage, fraction)

    def stop(self) -> None:
        """End the current stage."""
        if self._stage is not None:
            spent = time.perf_counter() - self._since
            self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + spent
            self._stage = None
        self.cpu_seconds = time.process_time() - self._cpu_since
