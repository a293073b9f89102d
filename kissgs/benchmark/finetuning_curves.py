"""Bytes and PSNR of a scene at several fidelities: as they are chosen, and fine-tuned."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from kissgs.benchmark.bd_rate import RateCurve, at_fidelity
from kissgs.cameras.views import TargetSource, Views
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.evaluate import compare_pictures
from kissgs.pipeline.pipeline import compact, compress, decompress
from kissgs.settings import Settings

FIDELITIES = (-8.0, -5.0, -2.0, 1.0)
CHOSEN, TUNED = "as chosen", "fine-tuned"


@dataclass(frozen=True, slots=True, kw_only=True)
class RatePoint:
    """One container.

    Attributes:
        way: :data:`CHOSEN` or :data:`TUNED`.
        count: Gaussians of the scene that was encoded.
        quality_offset_db: the setting.
        bytes: of the zip.
        psnr: decibels, mean over held-out views: to photographs, or to the scene's own renderings.
        ssim: the same.
        psnr_to_scene: decibels to renderings of the scene as it was before compaction.
        seconds: wall time of compression.
        cpu_seconds: the same of all threads.
        peak_memory: bytes, the largest the process has had resident so far.
    """

    way: str
    count: int
    quality_offset_db: float
    bytes: int
    psnr: float
    ssim: float
    psnr_to_scene: float
    seconds: float
    cpu_seconds: float
    peak_memory: int

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        return asdict(self)


def rate_curves(
    splats: Splats,
    settings: Settings,
    views: Views | None = None,
    *,
    fidelities: Sequence[float] | None = None,
    ratios: Sequence[float] = (),
    learn_from: TargetSource = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[RatePoint]:
    """Compress a scene at every quality_offset_db, with fine-tuning and without it.

    Args:
        splats: clean.
        settings: of all else.
        views: a capture; by default cameras drawn over the whole scene judge, and the scene itself is the teacher.
        fidelities: settings of that name; by default :data:`FIDELITIES`, or that of the settings if there are ratios.
        ratios: compact the scene to these shares first, and compress each of what is left as a scene of its own.
        learn_from: how much of the capture is learned from; its held-out views judge in any case.
        threads: 0 means one per processor.
        progress: receives the stages of compaction and compression.

    Raises:
        UnsupportedError: the settings weigh no bits, and so know no quality_offset_db; or ask for fewer Gaussians.
    """
    at = [
        at_fidelity(settings, f) for f in fidelities or ([settings.encode.quality_offset_db] if ratios else FIDELITIES)
    ]
    if settings.compact.enabled:
        raise UnsupportedError(
            "fine-tuning is measured on a scene as it is; compact it first: kissgs compact, or ratios"
        )
    judges = views or evaluation_views(splats, threads=threads, progress=progress)
    taught = None if views is None or learn_from == "scene" else views.for_training(learn_from)
    points = []
    shares: list[float | None] = [*ratios] or [None]
    for ratio in shares:
        scene = splats
        if ratio is not None:
            budget = settings.compact.model_copy(update={"ratio": ratio})
            kept = settings.model_copy(update={"compact": budget})
            scene = compact(splats, settings=kept, views=taught, threads=threads, progress=progress).splats
        for encoded in at:
            for way in (CHOSEN, TUNED):
                tuning = settings.finetune.model_copy(update={"enabled": way == TUNED})
                chosen = encoded.model_copy(update={"finetune": tuning})
                points.append(_point(way, splats, scene, chosen, taught, judges, threads, progress))
    return points


def _point(
    way: str,
    original: Splats,
    scene: Splats,
    settings: Settings,
    taught: Views | None,
    judges: Views,
    threads: int,
    progress: Progress,
) -> RatePoint:
    wall, cpu = time.perf_counter(), time.process_time()
    result = compress(scene, settings=settings, views=taught, threads=threads, progress=progress)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    decoded = decompress(result.files, threads=threads)
    mean = compare_pictures(original, decoded, judges, threads=threads, progress=as_stage("judge", progress)).mean
    return RatePoint(
        way=way,
        count=len(scene),
        quality_offset_db=settings.encode.quality_offset_db,
        bytes=result.report.container_bytes,
        psnr=mean.candidate.psnr,
        ssim=mean.candidate.ssim,
        psnr_to_scene=mean.candidate_vs_reference.psnr,
        seconds=wall,
        cpu_seconds=cpu,
        peak_memory=result.report.peak_memory,
    )


def saved(points: Sequence[RatePoint], figure: str = "psnr") -> float | None:
    """By what share fine-tuned containers are smaller than others of the same quality, on average; negative if larger.

    See :meth:`kissgs.benchmark.bd_rate.RateCurve.saving`.
    """
    chosen, tuned = (
        RateCurve.of((getattr(point, figure), point.bytes) for point in points if point.way == way)
        for way in (CHOSEN, TUNED)
    )
    return chosen.saving(tuned)
