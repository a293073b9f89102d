"""Other tools on the same scene: what their files weigh, what they cost in time, and what they lose."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from kissgs.cameras.views import Views
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.attributes import AttributeErrors, attribute_errors, sigmoid
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.matching import match_gaussians
from kissgs.evaluation.results import Evaluation
from kissgs.io.atomic import reason_of
from kissgs.io.ply import read_ply

PEER_FORMATS = ("sog", "spz")

SPLAT_TRANSFORM = ("splat-transform",)
"""PlayCanvas' converter, as ``npm install -g @playcanvas/splat-transform`` puts it on the PATH."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerResult:
    """One scene through one format of another tool, and back."""

    format: str
    gaussians: int
    """in the scene, once cleaned"""
    kept: int
    """in the peer's file"""
    bytes: int
    encode_seconds: float
    decode_seconds: float
    """both: wall time of the tool's process, start-up and .ply included"""
    encode_cpu_seconds: float
    decode_cpu_seconds: float
    """the same of all threads, user and system time"""
    peak_memory: int
    """bytes, the largest resident set of the tool's processes"""
    errors: AttributeErrors
    """of the Gaussians that show: an opacity of at most 1/255 no renderer draws, and tools scramble what it hides"""
    pictures: Evaluation | None = None

    @property
    def bytes_per_gaussian(self) -> float:
        """Of the scene's Gaussians, kept or not."""
        return self.bytes / self.gaussians

    def as_dict(self) -> dict[str, Any]:
        """All numbers by name, nested as the fields are."""
        pictures = None if self.pictures is None else self.pictures.as_dict()
        numbers = asdict(replace(self, pictures=None))
        return {**numbers, "bytes_per_gaussian": self.bytes_per_gaussian, "pictures": pictures}


def measure_peer(
    scene: Path,
    format: str,
    *,
    command: Sequence[str] = SPLAT_TRANSFORM,
    sh_iterations: int | None = None,
    pictures: bool = False,
    views: Views | None = None,
) -> PeerResult:
    """Write ``scene`` in a peer's format, read it back by the same tool, and compare.

    Without a GPU, ``.sog`` of a scene of SH degree 3 takes 10 minutes and more per SH iteration.

    Args:
        scene: A ``.ply`` file.
        format: ``"sog"`` or ``"spz"``.
        command: How to start splat-transform.
        sh_iterations: k-means iterations over the SH of ``.sog``; None leaves the tool's default.
        pictures: compare pictures too (:func:`kissgs.evaluation.evaluate.compare_images`).
        views: from where; by default cameras drawn over the whole scene.

    Raises:
        InvalidSceneError: ``scene``, or what the tool made of it, cannot be read or has no usable Gaussian.
        UnsupportedError: unknown format; the tool is missing or failed; SciPy is not installed; this is Windows,
            which does not say what a process took.
    """
    check_peer(format, command)
    reference, _ = clean(read_ply(scene))
    if not len(reference):
        raise InvalidSceneError(f"{scene} has no usable Gaussian")
    iterations = [] if sh_iterations is None else ["-i", str(sh_iterations)]
    with tempfile.TemporaryDirectory(prefix="kissgs-peer-") as folder:
        packed, unpacked = Path(folder, f"scene.{format}"), Path(folder, "unpacked.ply")
        encoding = _convert(command, scene.resolve(), packed, iterations)
        decoding = _convert(command, packed, unpacked, [])
        size = packed.stat().st_size
        candidate, _ = clean(read_ply(unpacked))
    return PeerResult(
        format=format,
        gaussians=len(reference),
        kept=len(candidate),
        bytes=size,
        encode_seconds=encoding.wall,
        decode_seconds=decoding.wall,
        encode_cpu_seconds=encoding.cpu,
        decode_cpu_seconds=decoding.cpu,
        peak_memory=max(encoding.memory, decoding.memory),
        errors=_errors_of_visible(reference, candidate),
        pictures=compare_images(reference, candidate, views or evaluation_views(reference)) if pictures else None,
    )


def check_peer(format: str, command: Sequence[str]) -> None:
    """See that a peer can be measured, before work that comes before.

    Raises:
        UnsupportedError: unknown format, or the tool is missing.
    """
    if format not in PEER_FORMATS:
        raise UnsupportedError(f"unknown peer format {format!r}; there are {', '.join(PEER_FORMATS)}")
    if not command or shutil.which(command[0]) is None:
        raise UnsupportedError(
            f"cannot start {' '.join(command[:1]) or 'nothing'}: install it with "
            "npm install -g @playcanvas/splat-transform, or say how to start it (--splat-transform)"
        )


def _errors_of_visible(reference: Splats, candidate: Splats) -> AttributeErrors:
    paired = reference.select(match_gaussians(reference, candidate))
    visible = sigmoid(paired.opacities) * 255 > 1.001
    return attribute_errors(paired.select(visible), candidate.select(visible))


@dataclass(frozen=True, slots=True)
class _Cost:
    """Of one process: seconds, seconds of all threads, bytes."""

    wall: float
    cpu: float
    memory: int


def _convert(command: Sequence[str], source: Path, target: Path, options: list[str]) -> _Cost:
    """Run the tool; returns what it took."""
    call = [*command, "-g", "cpu", "-w", *options, str(source), str(target)]
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            status, cost = _run(call, output, errors)
        except OSError as error:
            raise UnsupportedError(f"cannot start {command[0]}: {reason_of(error)}") from error
        if status != 0 or not target.is_file():
            last = (_told(errors) or _told(output) or "no message").splitlines()[-1]
            raise UnsupportedError(
                f"{command[0]} could not turn {source.name} into {target.suffix} (status {status}): {last}"
            )
    return cost


def _told(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace").strip()


def _run(call: Sequence[str], output: IO[bytes], errors: IO[bytes]) -> tuple[int, _Cost]:
    """The exit status of a process, and what it and those it has waited for took."""
    if sys.platform == "win32":
        raise UnsupportedError("Windows does not say what a process took: measure other tools elsewhere")
    begin = time.perf_counter()
    process = subprocess.Popen(call, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
    try:
        _, status, usage = os.wait4(process.pid, 0)
    except BaseException:  # an interrupt, too, must not leave it running
        process.kill()
        process.wait()
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    resident = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
    return process.returncode, _Cost(time.perf_counter() - begin, usage.ru_utime + usage.ru_stime, resident)
