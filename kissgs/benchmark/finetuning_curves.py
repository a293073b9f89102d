"""Bytes and quality of a scene at several quality offsets, with and without fine-tuning."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from kissgs.benchmark.bd_rate import RateCurve, at_quality_offset
from kissgs.cameras.views import TargetSource, Views
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, as_stage, silent
from kissgs.core.splats import Splats
from kissgs.evaluation.cameras import evaluation_views
from kissgs.evaluation.capture_fit import in_scene_frame
from kissgs.evaluation.evaluate import compare_images
from kissgs.pipeline.decompress import decompress
from kissgs.pipeline.pipeline import compact, compress
from kissgs.settings import Settings

QUALITY_OFFSETS = (-8.0, -5.0, -2.0, 1.0)
"""Default quality offsets, decibels."""

NOT_TUNED, TUNED = "not fine-tuned", "fine-tuned"


@dataclass(frozen=True, slots=True, kw_only=True)
class RatePoint:
    """Measurements of one container.

    Attributes:
        variant: :data:`NOT_TUNED` or :data:`TUNED`.
        count: number of Gaussians of the encoded scene.
        quality_offset_db: the setting, decibels.
        bytes: size of the zip.
        psnr: decibels, mean over held-out views, to photographs or, without those, to renderings of the scene.
        ssim: SSIM of the same images, mean over views.
        ms_ssim: MS-SSIM of the same images, mean over views.
        psnr_to_scene: decibels, mean over the same views, to renderings of the scene before compaction.
        seconds: wall time of compression.
        cpu_seconds: CPU time of compression, all threads.
        peak_memory: largest resident set of the process so far, bytes.
    """

    variant: str
    count: int
    quality_offset_db: float
    bytes: int
    psnr: float
    ssim: float
    ms_ssim: float
    psnr_to_scene: float
    seconds: float
    cpu_seconds: float
    peak_memory: int

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def rate_curves(
    splats: Splats,
    settings: Settings,
    views: Views | None = None,
    *,
    quality_offsets: Sequence[float] | None = None,
    ratios: Sequence[float] = (),
    supervision: TargetSource = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[RatePoint]:
    """Compress a scene at each quality offset, with and without fine-tuning.

    Args:
        splats: a clean scene.
        settings: all other settings.
        views: a capture; None to fine-tune by renderings of the scene and to evaluate with cameras drawn over it.
        quality_offsets: values of ``quality_offset_db``; None for :data:`QUALITY_OFFSETS` or, with ``ratios``, the
            value of the settings.
        ratios: shares of the Gaussians to keep; the scene is compacted to each of them first, and each result is
            compressed as a scene of its own.
        supervision: the part of the capture that training uses; its held-out views evaluate in any case.
        threads: number of threads; 0 means one per processor.
        progress: receives the stages of compaction and compression, and "evaluate".

    Raises:
        UnsupportedError: the settings have no rate-distortion planning, or enable compaction.
    """
    offsets = quality_offsets or ([settings.encode.quality_offset_db] if ratios else QUALITY_OFFSETS)
    variants = _variants([at_quality_offset(settings, offset) for offset in offsets])
    if settings.compact.enabled:
        raise UnsupportedError(
            "fine-tuning is measured without compaction settings; compact the scene first with kissgs compact, or give "
            "--ratio"
        )
    evaluated = views or evaluation_views(splats, threads=threads, progress=progress)
    evaluated = in_scene_frame(splats, evaluated, threads=threads)
    training = None if views is None or supervision == "scene" else views.for_training(supervision)
    points = []
    shares: list[float | None] = [*ratios] or [None]
    for ratio in shares:
        scene = splats
        if ratio is not None:
            budget = settings.compact.model_copy(update={"ratio": ratio})
            compacting = settings.model_copy(update={"compact": budget})
            scene = compact(splats, settings=compacting, views=training, threads=threads, progress=progress).splats
        for name, variant in variants:
            points.append(_point(name, splats, scene, variant, training, evaluated, threads, progress))
    return points


def _point(
    variant: str,
    original: Splats,
    scene: Splats,
    settings: Settings,
    training: Views | None,
    evaluated: Views,
    threads: int,
    progress: Progress,
) -> RatePoint:
    """Compress ``scene`` with the views ``training``, and compare with ``original`` in the views ``evaluated``."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = compress(scene, settings=settings, views=training, threads=threads, progress=progress)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    decoded = decompress(result.files, threads=threads)
    mean = compare_images(original, decoded, evaluated, threads=threads, progress=as_stage("evaluate", progress)).mean
    return RatePoint(
        variant=variant,
        count=len(scene),
        quality_offset_db=settings.encode.quality_offset_db,
        bytes=result.report.container_bytes,
        psnr=mean.candidate.psnr,
        ssim=mean.candidate.ssim,
        ms_ssim=mean.candidate.ms_ssim,
        psnr_to_scene=mean.candidate_vs_reference.psnr,
        seconds=wall,
        cpu_seconds=cpu,
        peak_memory=result.report.peak_memory,
    )


def _variants(curve: Sequence[Settings]) -> list[tuple[str, Settings]]:
    """Return each of the settings without and with fine-tuning, and the name of that variant."""
    return [
        (
            name,
            settings.model_copy(update={"finetune": settings.finetune.model_copy(update={"enabled": name == TUNED})}),
        )
        for settings in curve
        for name in (NOT_TUNED, TUNED)
    ]


def bytes_saved(points: Sequence[RatePoint], metric: str = "psnr") -> float | None:
    """Return the share of bytes that fine-tuning saves at equal quality, on average; negative if it needs more.

    Args:
        points: points of both variants.
        metric: "psnr", "ssim", "ms_ssim" or "psnr_to_scene".

    Returns:
        See :meth:`kissgs.benchmark.bd_rate.RateCurve.saving`.
    """
    not_tuned, tuned = (
        RateCurve.of((getattr(point, metric), point.bytes) for point in points if point.variant == variant)
        for variant in (NOT_TUNED, TUNED)
    )
    return not_tuned.saving(tuned)
