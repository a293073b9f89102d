"""File size, time, memory and errors of external codecs, the formats that splat-transform writes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from kissgs.cameras.views import Views
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import Splats, clean
from kissgs.evaluation.attributes import AttributeErrors, attribute_errors, sigmoid
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.capture_fit import in_scene_frame
from kissgs.evaluation.evaluate import compare_images
from kissgs.evaluation.matching import match_gaussians
from kissgs.evaluation.results import Evaluation
from kissgs.io.atomic import reason_of
from kissgs.io.ply import read_ply

EXTERNAL_FORMATS = ("sog", "spz")
"""Formats that can be measured, by file extension."""

SPLAT_TRANSFORM = ("splat-transform",)
"""Command of PlayCanvas' converter, as ``npm install -g @playcanvas/splat-transform`` installs it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExternalResult:
    """Measurements of a scene that an external codec encoded and decoded.

    Attributes:
        format: one of :data:`EXTERNAL_FORMATS`.
        gaussians: number of Gaussians in the scene, after cleaning.
        sh_degree: SH degree of the scene, 0 to 3.
        kept: number of Gaussians in the decoded file.
        bytes: size of the encoded file.
        encode_seconds: wall time of the encoding process, with start-up and reading the ``.ply``.
        decode_seconds: wall time of the decoding process, with start-up and writing the ``.ply``.
        encode_cpu_seconds: CPU time of the encoding process, user and system, all threads.
        decode_cpu_seconds: CPU time of the decoding process, user and system, all threads.
        peak_memory: largest resident set of both processes, bytes.
        errors: errors of the visible Gaussians: no renderer draws an opacity of 1/255 or less, and codecs change what
            such an opacity hides; None if not requested.
        evaluation: comparison of rendered images; None if not requested.
    """

    format: str
    gaussians: int
    sh_degree: int
    kept: int
    bytes: int
    encode_seconds: float
    decode_seconds: float
    encode_cpu_seconds: float
    decode_cpu_seconds: float
    peak_memory: int
    errors: AttributeErrors | None
    evaluation: Evaluation | None = None

    @property
    def bytes_per_gaussian(self) -> float:
        """Encoded bytes per Gaussian of the scene, whether kept or not."""
        return self.bytes / self.gaussians

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, nested, for JSON."""
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        numbers = asdict(replace(self, evaluation=None))
        return {**numbers, "bytes_per_gaussian": self.bytes_per_gaussian, "evaluation": evaluation}


def measure_external(
    scene: Path,
    format: str,
    *,
    command: Sequence[str] = SPLAT_TRANSFORM,
    sh_iterations: int | None = None,
    errors: bool = True,
    evaluate: bool = False,
    views: Views | None = None,
) -> ExternalResult:
    """Encode ``scene`` in an external format, decode it with the same tool, and compare the two.

    Without a GPU, ``.sog`` of a scene of SH degree 3 takes 10 minutes and more per SH iteration.

    Args:
        scene: a ``.ply`` file.
        format: one of :data:`EXTERNAL_FORMATS`.
        command: command that starts splat-transform.
        sh_iterations: k-means iterations over the SH of ``.sog``; None for the tool's default.
        errors: whether to pair the Gaussians of both scenes and to compute their errors.
        evaluate: whether to compare rendered images too (:func:`kissgs.evaluation.evaluate.compare_images`).
        views: views of that comparison; None for cameras drawn over the whole scene.

    Raises:
        InvalidSceneError: ``scene`` or the tool's output cannot be read, or has no usable Gaussian.
        UnsupportedError: unknown format; the tool is missing or fails; SciPy is not installed; the system is Windows,
            which does not report the resources that a process used.
    """
    check_external(format, command)
    reference, _ = clean(read_ply(scene))
    if not len(reference):
        raise InvalidSceneError(f"{scene} has no usable Gaussian")
    iterations = [] if sh_iterations is None else ["-i", str(sh_iterations)]
    with tempfile.TemporaryDirectory(prefix="kissgs-external-") as folder:
        encoded, decoded = Path(folder, f"scene.{format}"), Path(folder, "unpacked.ply")
        encoding = _convert(command, scene.resolve(), encoded, iterations)
        decoding = _convert(command, encoded, decoded, [])
        size = encoded.stat().st_size
        candidate, _ = clean(read_ply(decoded))
    evaluation = None
    if evaluate:
        views = in_scene_frame(reference, views or evaluation_views(reference))
        evaluation = compare_images(reference, candidate, views)
    return ExternalResult(
        format=format,
        gaussians=len(reference),
        sh_degree=reference.sh_degree,
        kept=len(candidate),
        bytes=size,
        encode_seconds=encoding.wall,
        decode_seconds=decoding.wall,
        encode_cpu_seconds=encoding.cpu,
        decode_cpu_seconds=decoding.cpu,
        peak_memory=max(encoding.memory, decoding.memory),
        errors=_errors_of_visible(reference, candidate) if errors else None,
        evaluation=evaluation,
    )


def check_external(format: str, command: Sequence[str]) -> None:
    """Check that an external codec can be started, before a long measurement.

    Raises:
        UnsupportedError: unknown format, or the tool is missing.
    """
    if format not in EXTERNAL_FORMATS:
        raise UnsupportedError(f"unknown external codec {format!r}; choose {' or '.join(EXTERNAL_FORMATS)}")
    if not command or shutil.which(command[0]) is None:
        raise UnsupportedError(
            f"cannot start {' '.join(command[:1]) or 'an empty command'}: install it with "
            "npm install -g @playcanvas/splat-transform, or give its command with --splat-transform"
        )


def _errors_of_visible(reference: Splats, candidate: Splats) -> AttributeErrors:
    paired = reference.select(match_gaussians(reference, candidate))
    visible = sigmoid(paired.opacities) * 255 > 1.001
    return attribute_errors(paired.select(visible), candidate.select(visible))


@dataclass(frozen=True, slots=True)
class _Resources:
    """Resources that a process used: wall time and CPU time in seconds, largest resident set in bytes."""

    wall: float
    cpu: float
    memory: int


def _convert(command: Sequence[str], source: Path, target: Path, options: list[str]) -> _Resources:
    """Run the tool, and return the resources that it used."""
    call = [*command, "-g", "cpu", "-w", *options, str(source), str(target)]
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            status, resources = _run(call, output, errors)
        except OSError as error:
            raise UnsupportedError(f"cannot start {command[0]}: {reason_of(error)}") from error
        if status != 0 or not target.is_file():
            last = (_text(errors) or _text(output) or "no message").splitlines()[-1]
            raise UnsupportedError(
                f"{command[0]} could not convert {source.name} to {target.suffix} (status {status}): {last}"
            )
    return resources


def _text(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace").strip()


_WATCHER = """
import json, os, subprocess, sys, time
begin = time.perf_counter()
try:
    process = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL)
except OSError as error:
    result = [error.errno, error.strerror]
else:
    _, status, usage = os.wait4(process.pid, 0)
    wall, cpu = time.perf_counter() - begin, usage.ru_utime + usage.ru_stime
    resident = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
    result = [os.waitstatus_to_exitcode(status), wall, cpu, resident]
with open(sys.argv[1], "w") as file:
    json.dump(result, file)
"""
"""A small process that starts the tool: Linux counts the memory of the process that starts another as the other's."""


def _run(call: Sequence[str], output: IO[bytes], errors: IO[bytes]) -> tuple[int, _Resources]:
    """Run a process; return its exit status and the resources that it and the children it waited for used."""
    if sys.platform == "win32":
        raise UnsupportedError(
            "external codecs cannot be measured on Windows, which does not report the resources of a process; use "
            "another system"
        )
    with tempfile.NamedTemporaryFile(prefix="kissgs-external-") as found:
        watcher = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _WATCHER, found.name, *call],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=errors,
            start_new_session=True,
        )
        try:
            watcher.wait()
        except BaseException:  # an interrupt, too, must not leave the tool running
            os.killpg(watcher.pid, signal.SIGKILL)
            watcher.wait()
            raise
        result = json.load(found)
    if len(result) == 2:
        raise OSError(*result)
    status, *resources = result
    return status, _Resources(*resources)
