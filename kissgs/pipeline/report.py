"""``Report``: what a compression took and gave."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from kissgs.compaction.result import CompactionReport
from kissgs.core.splats import Cleaned
from kissgs.evaluation.results import Evaluation
from kissgs.finetuning.result import FinetuneReport
from kissgs.pipeline.trial import Trial


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """What a compression took and gave.

    Attributes:
        source_count: Gaussians in the scene.
        count: Gaussians in the container.
        sh_degree: 0 to 3.
        source_bytes: of the scene file; of the arrays if there was none.
        container_bytes: of the zip.
        file_bytes: per file of the container, as its zip stores it.
        cleaned: what was wrong with the input (:class:`kissgs.core.splats.Cleaned`).
        compaction: of the scene before it was encoded; None unless it was asked for.
        finetuning: of the levels after they were chosen; None unless it was asked for, and there was a Gaussian.
        invisible: Gaussians left out because no renderer would draw them.
        pruned_by_rd: Gaussians left out because their bytes would cost more than they show.
        clipped_colors: Gaussians whose base colour is such an outlier that it was pulled in, for the others' sake.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        half_steps: largest error of quantisation, per field and channel; where all steps are alike, half of one.
        rd_lambda: of a bit, squared error; None where bits were not weighed.
        trials: where the settings name a goal: what was encoded on the way, in this order.
        seconds: wall time per stage.
        cpu_seconds: processor time of all stages, over all threads.
        peak_memory: bytes, the largest this process has ever had resident.
        settings: all of them, as used.
        note: a sentence about Gaussians that were left out, where these are more than a fifth; or empty.
        evaluation: the container's pictures beside those of the cleaned input; None unless it was asked for.
    """

    source_count: int
    count: int
    sh_degree: int
    source_bytes: int
    container_bytes: int
    file_bytes: dict[str, int]
    cleaned: Cleaned
    compaction: CompactionReport | None
    finetuning: FinetuneReport | None
    invisible: int
    pruned_by_rd: int
    clipped_colors: int
    form_error: float
    half_steps: dict[str, list[float]]
    rd_lambda: float | None
    trials: tuple[Trial, ...]
    seconds: dict[str, float]
    cpu_seconds: float
    peak_memory: int
    settings: dict[str, Any]
    evaluation: Evaluation | None = None
    note: str = ""

    @property
    def ratio(self) -> float:
        """How many times smaller the container is than the scene file."""
        return self.source_bytes / self.container_bytes

    @property
    def bytes_per_gaussian(self) -> float:
        """Of the whole zip, per Gaussian of the scene."""
        return self.container_bytes / max(self.source_count, 1)

    @property
    def compacted(self) -> int:
        """Gaussians that compaction left out."""
        return 0 if self.compaction is None else self.compaction.source_count - self.compaction.count

    def as_dict(self) -> dict[str, Any]:
        """For machines."""
        derived = {"ratio": self.ratio, "bytes_per_gaussian": self.bytes_per_gaussian}
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        compaction = None if self.compaction is None else self.compaction.as_dict()
        finetuning = None if self.finetuning is None else self.finetuning.as_dict()
        trials = [trial.as_dict() for trial in self.trials]
        parts = {"compaction": compaction, "finetuning": finetuning, "evaluation": evaluation, "trials": trials}
        return {**asdict(self), **derived, **parts}
