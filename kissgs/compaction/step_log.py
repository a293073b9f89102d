"""``StepLog``: the steps of a compaction for the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from kissgs.compaction.result import CompactionStep
from kissgs.core.splats import Splats
from kissgs.evaluation.results import ImageMetrics


@dataclass(slots=True, eq=False)
class StepLog:
    """Records each step with its wall time and, if requested, its quality and size.

    Attributes:
        evaluate: function that returns image metrics and compressed bytes of a scene, see
            :func:`kissgs.compaction.evaluate.evaluate_scene`; None to leave them out. Its time does not count.
        steps: recorded steps.
    """

    evaluate: Callable[[Splats], tuple[ImageMetrics, int]] | None
    steps: list[CompactionStep] = field(default_factory=list)
    _started: float = field(default_factory=time.perf_counter)

    @property
    def seconds(self) -> float:
        """Wall time since the last step ended, seconds."""
        return time.perf_counter() - self._started

    def record(self, name: str, scene: Splats) -> None:
        """Add the step that has just ended with ``scene``."""
        seconds = self.seconds
        metrics, size = (None, None) if self.evaluate is None else self.evaluate(scene)
        self.steps.append(
            CompactionStep(
                name=name,
                count=len(scene),
                seconds=seconds,
                psnr=None if metrics is None else metrics.psnr,
                ssim=None if metrics is None else metrics.ssim,
                ms_ssim=None if metrics is None else metrics.ms_ssim,
                bytes=size,
            )
        )
        self._started = time.perf_counter()

    def restore(self, steps: Sequence[CompactionStep], seconds: float) -> None:
        """Continue after ``steps``, with ``seconds`` of the next one spent before the interruption."""
        self.steps = list(steps)
        self._started -= seconds
