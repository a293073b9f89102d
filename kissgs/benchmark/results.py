"""Measurements of codecs on scenes: runs, medians, and bytes of different codecs at equal quality."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from statistics import median
from typing import Any, Literal

from kissgs.benchmark.bd_rate import RateCurve
from kissgs.benchmark.external_codecs import ExternalResult
from kissgs.benchmark.roundtrip import RoundTrip
from kissgs.evaluation.attributes import AttributeErrors
from kissgs.evaluation.results import Evaluation
from kissgs.io.container_names import ContainerName, ending_of

PsnrTarget = Literal["original", "photographs"]
"""The images that a PSNR compares with: renderings of the original scene, or photographs."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """Resources of one run, or medians of several.

    Attributes:
        bytes: size of the container or file.
        encode_seconds: wall time from ``.ply`` to container; of an external codec, of its process.
        encode_cpu_seconds: CPU time of encoding, all threads.
        decode_seconds: wall time from container to arrays; of an external codec, to a ``.ply``.
        decode_cpu_seconds: CPU time of decoding, all threads.
        stage_seconds: wall time of encoding by stage; an external codec has one stage.
        stage_cpu_seconds: CPU time of encoding by stage, all threads.
        stage_peak_memory: largest resident set by stage, bytes; decoding is the stage "decode".
        peak_memory: largest resident set of encoding and decoding, bytes.
    """

    bytes: int
    encode_seconds: float
    encode_cpu_seconds: float
    decode_seconds: float
    decode_cpu_seconds: float
    stage_seconds: Mapping[str, float]
    stage_cpu_seconds: Mapping[str, float]
    stage_peak_memory: Mapping[str, int]
    peak_memory: int

    @classmethod
    def of(cls, result: RoundTrip | ExternalResult) -> Run:
        """Return the resources of one measurement."""
        if isinstance(result, ExternalResult):
            size, stages, cpu = result.bytes, {result.format: result.encode_seconds}, result.encode_cpu_seconds
            stage_cpu, stage_memory = {result.format: cpu}, {result.format: result.peak_memory}
        else:
            report = result.report
            size, stages, cpu = report.container_bytes, report.seconds, report.cpu_seconds
            stage_cpu, stage_memory = result.stage_cpu_seconds, result.stage_peak_memory
        return cls(
            bytes=size,
            encode_seconds=sum(stages.values()),
            encode_cpu_seconds=cpu,
            decode_seconds=result.decode_seconds,
            decode_cpu_seconds=result.decode_cpu_seconds,
            stage_seconds=stages,
            stage_cpu_seconds=stage_cpu,
            stage_peak_memory=stage_memory,
            peak_memory=result.peak_memory,
        )

    @classmethod
    def median_of(cls, runs: Sequence[Run]) -> Run:
        """Return the median of each time, the largest peak of memory and the bytes of the first run."""
        times = ("encode_seconds", "encode_cpu_seconds", "decode_seconds", "decode_cpu_seconds")
        stages = dict.fromkeys(name for run in runs for name in run.stage_seconds)
        measured = dict.fromkeys(name for run in runs for name in run.stage_peak_memory)
        return cls(
            bytes=runs[0].bytes,
            stage_seconds={name: median(run.stage_seconds.get(name, 0.0) for run in runs) for name in stages},
            stage_cpu_seconds={name: median(run.stage_cpu_seconds.get(name, 0.0) for run in runs) for name in stages},
            stage_peak_memory={name: max(run.stage_peak_memory.get(name, 0) for run in runs) for name in measured},
            peak_memory=max(run.peak_memory for run in runs),
            **{name: median(getattr(run, name) for run in runs) for name in times},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """Measurements of one codec on one scene.

    Attributes:
        scene: file name of the scene, with as much of its path as distinguishes it from others.
        codec: name of a preset, or format of an external codec.
        container: container that the preset was written to; None for external codecs.
        quality_offset_db: quality offset of a point of a preset's curve, decibels; None for a preset as it is and for
            external codecs.
        gaussians: number of Gaussians in the scene, before any is left out.
        float32_bytes: size of the scene's arrays, in float32.
        file_bytes: bytes by file of the container; of an external codec, of its only file.
        runs: all repeats, in order.
        errors: attribute errors of the first run; None if not requested.
        evaluation: comparison of rendered images of the first run; None if not requested.
        details: complete measurement of the first run, for JSON.
    """

    scene: str
    codec: str
    container: ContainerName | None = "sogxt"
    quality_offset_db: float | None = None
    gaussians: int
    float32_bytes: int
    file_bytes: Mapping[str, int]
    runs: tuple[Run, ...]
    errors: AttributeErrors | None
    evaluation: Evaluation | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def median_run(self) -> Run:
        """The median of the runs."""
        return Run.median_of(self.runs)

    @property
    def bytes(self) -> int:
        """Size of the container or file of the first run."""
        return self.runs[0].bytes

    @property
    def peak_memory_per_gaussian(self) -> float:
        """Largest resident set of all runs, bytes per Gaussian of the scene; that of the process if it has none."""
        return self.median_run.peak_memory / max(self.gaussians, 1)

    @property
    def peak_memory_ratio(self) -> float:
        """Largest resident set of all runs, as a multiple of ``float32_bytes``; infinite for an empty scene."""
        return self.median_run.peak_memory / self.float32_bytes if self.float32_bytes else math.inf

    @property
    def reproducible(self) -> bool:
        """Whether all runs have the same number of bytes."""
        return len({run.bytes for run in self.runs}) == 1

    @property
    def name(self) -> str:
        """Name in tables, such as "balanced", "balanced .sog", "balanced at -6" for a point of a curve, or ".spz"."""
        name = f".{self.codec}" if self.container is None else curve_name(self.codec, self.container)
        return name if self.quality_offset_db is None else f"{name} at {self.quality_offset_db:g}"

    @property
    def is_external(self) -> bool:
        """Whether the codec is an external one."""
        return self.container is None

    def psnr(self, target: PsnrTarget) -> float | None:
        """Return the PSNR to these images, decibels, mean over views; None if they were not compared with."""
        if self.evaluation is None or (target == "photographs" and self.evaluation.mean.reference is None):
            return None
        mean = self.evaluation.mean
        return mean.candidate_vs_reference.psnr if target == "original" else mean.candidate.psnr

    def as_dict(self) -> dict[str, Any]:
        """Return the details of the first run, with times and memory replaced by their medians, and all runs."""
        return {
            "scene": self.scene,
            "codec": self.codec,
            "container": self.container,
            "quality_offset_db": self.quality_offset_db,
            **self.details,
            "gaussians": self.gaussians,
            "bytes_per_gaussian": self.bytes / max(self.gaussians, 1),
            "float32_bytes": self.float32_bytes,
            "peak_memory_per_gaussian": self.peak_memory_per_gaussian,
            "peak_memory_ratio": self.peak_memory_ratio if self.float32_bytes else None,
            **asdict(self.median_run),
            "file_bytes": dict(self.file_bytes),
            "reproducible": self.reproducible,
            "runs": [asdict(run) for run in self.runs],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class EqualPsnr:
    """Bytes of a preset at the PSNR of an external codec, or of a preset in another container.

    Attributes:
        scene: file name of the scene.
        reference: name of the external codec, or of the preset in another container.
        preset: preset whose rate curve is used.
        container: container of that curve.
        target: images that the PSNR compares with.
        psnr: PSNR of the reference, decibels.
        reference_bytes: bytes of the reference.
        bytes: bytes of the preset at this PSNR, interpolated; None if the PSNR is beyond the ends of the curve.
    """

    scene: str
    reference: str
    preset: str
    container: ContainerName
    target: PsnrTarget
    psnr: float
    reference_bytes: int
    bytes: float | None

    @property
    def ratio(self) -> float | None:
        """Bytes of the preset divided by those of the reference; None as for ``bytes``."""
        return None if self.bytes is None else self.bytes / self.reference_bytes

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes and the ratio by name, for JSON."""
        return {**asdict(self), "ratio": self.ratio}


def at_equal_psnr(rows: Sequence[Measurement]) -> list[EqualPsnr]:
    """Return the bytes of each curve at the PSNR of each external codec, and of its preset in other containers."""
    found = []
    targets: tuple[PsnrTarget, ...] = ("original", "photographs")
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        whole = [row for row in here if row.quality_offset_db is None]
        for reference, (preset, container), target in product(whole, curves(here), targets):
            psnr = reference.psnr(target)
            other = reference.is_external or (reference.codec == preset and reference.container != container)
            if other and psnr is not None and math.isfinite(psnr):
                found.append(
                    EqualPsnr(
                        scene=scene,
                        reference=reference.name,
                        preset=preset,
                        container=container,
                        target=target,
                        psnr=psnr,
                        reference_bytes=reference.bytes,
                        bytes=rate_curve(here, preset, container, target).bytes_at(psnr),
                    )
                )
    return found


def curves(rows: Iterable[Measurement]) -> list[tuple[str, ContainerName]]:
    """Return the preset and container of each curve, in order."""
    points = (row for row in rows if row.quality_offset_db is not None)
    return list(dict.fromkeys((row.codec, row.container) for row in points if row.container is not None))


def curve_name(preset: str, container: ContainerName) -> str:
    """Return the name of a preset in a container: only containers other than SOG-XT are named."""
    return preset if container == "sogxt" else f"{preset} {ending_of(container)}"


def rate_curve(rows: Sequence[Measurement], preset: str, container: ContainerName, target: PsnrTarget) -> RateCurve:
    """Return the rate curve of a preset on one scene, through all its quality offsets and the preset as it is."""
    points = ((row.psnr(target), row.bytes) for row in rows if (row.codec, row.container) == (preset, container))
    return RateCurve.of((psnr, size) for psnr, size in points if psnr is not None)
