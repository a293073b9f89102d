"""Bytes and PSNR of a scene at several fidelities: as they are chosen, and fine-tuned."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from kissgs.errors import UnsupportedError
from kissgs.evaluation.pictures import evaluate
from kissgs.pipeline import compress, decompress
from kissgs.progress import Progress, as_stage, silent
from kissgs.settings import EncodeSettings, Settings
from kissgs.splats import Splats
from kissgs.views.view import Source, Views
from kissgs.views.virtual import virtual_views

FIDELITIES = (-8.0, -5.0, -2.0, 1.0)
CHOSEN, TUNED = "as chosen", "fine-tuned"


@dataclass(frozen=True, slots=True, kw_only=True)
class RatePoint:
    """One container.

    Attributes:
        way: :data:`CHOSEN` or :data:`TUNED`.
        fidelity: the setting.
        bytes: of the zip.
        psnr: decibels, mean over held-out views: to photographs, or to the scene's own renderings.
        ssim: the same.
        between: decibels to the scene's own renderings.
        seconds: wall time of compression.
        cpu_seconds: the same of all threads.
        peak_memory: bytes, the largest the process has had resident so far.
    """

    way: str
    fidelity: float
    bytes: int
    psnr: float
    ssim: float
    between: float
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
    fidelities: Sequence[float] = FIDELITIES,
    learn_from: Source = "photos",
    threads: int = 0,
    progress: Progress = silent,
) -> list[RatePoint]:
    """Compress a scene at every fidelity, with fine-tuning and without it.

    Args:
        splats: clean.
        settings: of all else.
        views: a capture; by default virtual views judge, and the scene itself is the teacher.
        fidelities: settings of that name.
        learn_from: how much of the capture is learned from; its held-out views judge in any case.
        threads: 0 means one per processor.
        progress: receives the stages of compression.

    Raises:
        UnsupportedError: the settings weigh no bits, and so know no fidelity; or ask for fewer Gaussians.
    """
    if not settings.encode.weigh:
        raise UnsupportedError(f"the preset {settings.preset} weighs no bits, and knows no fidelity; choose another")
    if settings.compact.wanted:
        raise UnsupportedError("fine-tuning is measured on a scene as it is; compact it first: kissgs compact")
    judges = views or virtual_views(splats, threads=threads, progress=progress)
    taught = None if views is None or learn_from == "scene" else views.to_learn(learn_from)
    points = []
    for fidelity in fidelities:
        asked = {"fidelity": fidelity, "price": None, "psnr": None, "target_size": None}
        encode = EncodeSettings(**{**settings.encode.model_dump(), **asked})
        for way in (CHOSEN, TUNED):
            finetune = settings.finetune.model_copy(update={"wanted": way == TUNED})
            chosen = settings.model_copy(update={"encode": encode, "finetune": finetune})
            wall, cpu = time.perf_counter(), time.process_time()
            result = compress(splats, settings=chosen, views=taught, threads=threads, progress=progress)
            wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
            decoded = decompress(result.files, threads=threads)
            mean = evaluate(splats, decoded, judges, threads=threads, progress=as_stage("judge", progress)).mean
            points.append(
                RatePoint(
                    way=way,
                    fidelity=fidelity,
                    bytes=result.report.container_bytes,
                    psnr=mean.candidate.psnr,
                    ssim=mean.candidate.ssim,
                    between=mean.between.psnr,
                    seconds=wall,
                    cpu_seconds=cpu,
                    peak_memory=result.report.peak_memory,
                )
            )
    return points


def saved(points: Sequence[RatePoint], figure: str = "psnr") -> float | None:
    """By what share fine-tuned containers are smaller than others of the same quality, on average; negative if larger.

    Bjøntegaard's measure (VCEG-M33), with straight lines between the points: the mean difference of the logarithms of
    bytes over the range of ``figure`` that both curves cover. None where there is no such range.
    """
    curves = []
    for way in (CHOSEN, TUNED):
        of = sorted((getattr(point, figure), np.log(point.bytes)) for point in points if point.way == way)
        curves.append((np.array([q for q, _ in of], np.float64), np.array([b for _, b in of], np.float64)))
    low, high = max(q.min(initial=np.inf) for q, _ in curves), min(q.max(initial=-np.inf) for q, _ in curves)
    if not np.isfinite([low, high]).all() or low >= high:
        return None
    grid = np.linspace(low, high, 1001)
    chosen, tuned = (np.interp(grid, quality, log_bytes) for quality, log_bytes in curves)
    return 1 - float(np.exp(np.mean(tuned - chosen)))
