"""What was measured of encoders on a scene: runs, medians, and bytes of different tools at equal quality."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from statistics import median
from typing import Any, Literal

from kissgs.benchmark.bd_rate import RateCurve
from kissgs.benchmark.external_codecs import PeerResult
from kissgs.benchmark.roundtrip import RoundTrip
from kissgs.evaluation.attributes import AttributeErrors
from kissgs.evaluation.results import Evaluation

Figure = Literal["original", "photographs"]
"""What a PSNR is told against: pictures of the scene as it was, or those that a camera took."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """What one run took, or several by their medians.

    Attributes:
        bytes: of the container.
        encode_seconds: wall time from file to container; of a peer, of its process.
        encode_cpu_seconds: the same of all threads.
        decode_seconds: wall time back, to arrays; a peer writes a ``.ply``.
        decode_cpu_seconds: the same of all threads.
        stage_seconds: wall time of encoding, by stage; a peer has one.
        peak_memory: bytes, the largest resident set of encoding and decoding.
    """

    bytes: int
    encode_seconds: float
    encode_cpu_seconds: float
    decode_seconds: float
    decode_cpu_seconds: float
    stage_seconds: Mapping[str, float]
    peak_memory: int

    @classmethod
    def of(cls, result: RoundTrip | PeerResult) -> Run:
        """One measurement."""
        if isinstance(result, PeerResult):
            size, stages, cpu = result.bytes, {result.format: result.encode_seconds}, result.encode_cpu_seconds
        else:
            report = result.report
            size, stages, cpu = report.container_bytes, report.seconds, report.cpu_seconds
        return cls(
            bytes=size,
            encode_seconds=sum(stages.values()),
            encode_cpu_seconds=cpu,
            decode_seconds=result.decode_seconds,
            decode_cpu_seconds=result.decode_cpu_seconds,
            stage_seconds=stages,
            peak_memory=result.peak_memory,
        )

    @classmethod
    def typical(cls, runs: Sequence[Run]) -> Run:
        """Medians of times, each by itself; the most of memory; the bytes of the first."""
        times = ("encode_seconds", "encode_cpu_seconds", "decode_seconds", "decode_cpu_seconds")
        stages = dict.fromkeys(name for run in runs for name in run.stage_seconds)
        return cls(
            bytes=runs[0].bytes,
            stage_seconds={name: median(run.stage_seconds.get(name, 0.0) for run in runs) for name in stages},
            peak_memory=max(run.peak_memory for run in runs),
            **{name: median(getattr(run, name) for run in runs) for name in times},
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """One encoder on one scene.

    Attributes:
        scene: its file's name, or as much of the path as tells it from others.
        encoder: a preset, or a peer's format.
        quality_offset_db: of a point of a curve; None of a preset as it is, and of a peer.
        gaussians: of the scene, before anything is left out.
        file_bytes: per file of the container; of a peer, of the one that there is.
        runs: all repeats, in their order.
        errors: of the first.
        pictures: of the first, if they were compared.
        details: all that is known of the first, for machines.
    """

    scene: str
    encoder: str
    quality_offset_db: float | None = None
    gaussians: int
    file_bytes: Mapping[str, int]
    runs: tuple[Run, ...]
    errors: AttributeErrors
    pictures: Evaluation | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def took(self) -> Run:
        """The runs in one."""
        return Run.typical(self.runs)

    @property
    def bytes(self) -> int:
        """Of the first container."""
        return self.runs[0].bytes

    @property
    def steady(self) -> bool:
        """Whether all repeats have as many bytes."""
        return len({run.bytes for run in self.runs}) == 1

    @property
    def name(self) -> str:
        """For people: the preset, or ``.sog``; where it is on its curve."""
        name = f".{self.encoder}" if self.is_peer else self.encoder
        return name if self.quality_offset_db is None else f"{name} at {self.quality_offset_db:g}"

    @property
    def is_peer(self) -> bool:
        """Whether another tool did it."""
        return len(self.file_bytes) == 1

    def psnr(self, figure: Figure) -> float | None:
        """Decibels, mean over views; None where there are none to compare with."""
        if self.pictures is None or (figure == "photographs" and self.pictures.mean.reference is None):
            return None
        mean = self.pictures.mean
        return mean.candidate_vs_reference.psnr if figure == "original" else mean.candidate.psnr

    def as_dict(self) -> dict[str, Any]:
        """For machines: details of the first run, over which medians and the most of memory are laid; then all runs."""
        return {
            "scene": self.scene,
            "encoder": self.encoder,
            "quality_offset_db": self.quality_offset_db,
            **self.details,
            "gaussians": self.gaussians,
            "bytes_per_gaussian": self.bytes / max(self.gaussians, 1),
            **asdict(self.took),
            "file_bytes": dict(self.file_bytes),
            "steady": self.steady,
            "runs": [asdict(run) for run in self.runs],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Equal:
    """A peer's container beside one of ours of the same quality.

    Attributes:
        scene: its file's name.
        peer: the format.
        preset: whose curve.
        figure: which PSNR is the same.
        psnr: decibels, of the peer.
        peer_bytes: of the peer.
        bytes: of ours; None where the peer is beyond the curve.
    """

    scene: str
    peer: str
    preset: str
    figure: Figure
    psnr: float
    peer_bytes: int
    bytes: float | None

    @property
    def ratio(self) -> float | None:
        """Ours to the peer's."""
        return None if self.bytes is None else self.bytes / self.peer_bytes

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return {**asdict(self), "ratio": self.ratio}


def at_equal_psnr(rows: Sequence[Measured]) -> list[Equal]:
    """What a preset's curve takes at the PSNR of every peer; between the curve's points by :class:`RateCurve`."""
    found = []
    for scene in dict.fromkeys(row.scene for row in rows):
        here = [row for row in rows if row.scene == scene]
        figures: tuple[Figure, ...] = ("original", "photographs")
        for peer in (row for row in here if row.is_peer):
            for preset in dict.fromkeys(row.encoder for row in here if row.quality_offset_db is not None):
                for figure in figures:
                    psnr = peer.psnr(figure)
                    if psnr is not None and math.isfinite(psnr):
                        size = rate_curve(here, preset, figure).bytes_at(psnr)
                        told = {"scene": scene, "peer": peer.encoder, "preset": preset}
                        found.append(Equal(**told, figure=figure, psnr=psnr, peer_bytes=peer.bytes, bytes=size))
    return found


def rate_curve(rows: Sequence[Measured], preset: str, figure: Figure) -> RateCurve:
    """Of one scene and preset: through all its fidelities, its own included."""
    points = ((row.psnr(figure), row.bytes) for row in rows if row.encoder == preset)
    return RateCurve.of((psnr, size) for psnr, size in points if psnr is not None)
