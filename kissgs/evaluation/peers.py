"""Other tools on the same scene: what their files weigh, what they cost in time, and what they lose."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from kissgs.errors import InvalidSceneError, UnsupportedError
from kissgs.evaluation.attributes import AttributeErrors, attribute_errors, sigmoid
from kissgs.evaluation.likeness import Evaluation
from kissgs.evaluation.pairing import pair
from kissgs.evaluation.pictures import evaluate
from kissgs.io.ply import read_ply
from kissgs.splats import Splats, clean
from kissgs.views.view import Views

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
    encode_cpu_seconds: float
    decode_cpu_seconds: float
    """both: user and system time of the tool's processes, all threads together, start-up and .ply included"""
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

    Without a GPU, ``.sog`` of a scene of SH degree 3 takes 20 minutes and more per SH iteration. Other processes that
    this one starts meanwhile are added to the times.

    Args:
        scene: A ``.ply`` file.
        format: ``"sog"`` or ``"spz"``.
        command: How to start splat-transform.
        sh_iterations: k-means iterations over the SH of ``.sog``; None leaves the tool's default.
        pictures: compare pictures too (:func:`kissgs.evaluate`).
        views: from where; by default virtual cameras.

    Raises:
        InvalidSceneError: ``scene``, or what the tool made of it, cannot be read or has no usable Gaussian.
        UnsupportedError: unknown format; the tool is missing or failed; SciPy is not installed.
    """
    if format not in PEER_FORMATS:
        raise UnsupportedError(f"unknown peer format {format!r}; there are {', '.join(PEER_FORMATS)}")
    reference, _ = clean(read_ply(scene))
    if not len(reference):
        raise InvalidSceneError(f"{scene} has no usable Gaussian")
    iterations = [] if sh_iterations is None else ["-i", str(sh_iterations)]
    with tempfile.TemporaryDirectory(prefix="kissgs-peer-") as folder:
        packed, unpacked = Path(folder, f"scene.{format}"), Path(folder, "unpacked.ply")
        encode_seconds = _convert(command, scene.resolve(), packed, iterations)
        decode_seconds = _convert(command, packed, unpacked, [])
        size = packed.stat().st_size
        candidate, _ = clean(read_ply(unpacked))
    return PeerResult(
        format=format,
        gaussians=len(reference),
        kept=len(candidate),
        bytes=size,
        encode_cpu_seconds=encode_seconds,
        decode_cpu_seconds=decode_seconds,
        errors=_errors_of_visible(reference, candidate),
        pictures=evaluate(reference, candidate, views) if pictures else None,
    )


def _errors_of_visible(reference: Splats, candidate: Splats) -> AttributeErrors:
    paired = reference.select(pair(reference, candidate))
    visible = sigmoid(paired.opacities) * 255 > 1.001
    return attribute_errors(paired.select(visible), candidate.select(visible))


def _convert(command: Sequence[str], source: Path, target: Path, options: list[str]) -> float:
    """Run the tool; returns the CPU seconds that it took."""
    call = [*command, "-g", "cpu", "-w", *options, str(source), str(target)]
    before = os.times()
    try:
        done = subprocess.run(
            call, check=False, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace"
        )
    except OSError as error:
        raise UnsupportedError(
            f"cannot start {command[0]} ({error.strerror}): install it with "
            "npm install -g @playcanvas/splat-transform, or say how to start it"
        ) from error
    after = os.times()
    if done.returncode != 0 or not target.is_file():
        last = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()[-1]
        raise UnsupportedError(
            f"{command[0]} could not turn {source.name} into {target.suffix} (status {done.returncode}): {last}"
        )
    return after.children_user + after.children_system - before.children_user - before.children_system
