"""``Report``: sizes, counts, errors, times and settings of one compression."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from kissgs.compaction.result import CompactionReport
from kissgs.core.splats import Cleaned
from kissgs.evaluation.results import Evaluation
from kissgs.finetuning.result import FinetuneReport
from kissgs.pipeline.goal import Attempt


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Sizes, counts, errors, times and settings of one compression.

    Attributes:
        source_count: Gaussians in the scene.
        count: Gaussians in the container.
        sh_degree: 0 to 3.
        source_bytes: size of the scene file; of the arrays if the scene came in memory.
        container_bytes: size of the zip, or of all files in the folder.
        file_bytes: size of each file of the container, as its zip stores it.
        cleaned: defects of the input that were removed or corrected (:class:`kissgs.core.splats.Cleaned`).
        compaction: report of the compaction before encoding; None unless requested.
        finetuning: report of the fine-tuning of the levels; None unless requested, or if the scene is empty.
        invisible: Gaussians left out because no renderer draws them.
        pruned_by_rd: Gaussians left out because their rate cost exceeds the distortion that they save.
        clipped_colors: Gaussians with an outlying base colour, which was clipped to keep the range of all others small.
        form_error: largest relative change of a covariance by the choice of its equivalent rotation form.
        max_quantization_error: largest error of quantisation, per field and channel; half a step where all steps of a
            channel are equal.
        rd_lambda: squared error per bit; None without rate-distortion planning.
        trials: where the settings name a goal: the containers that were made, in order.
        seconds: wall time per stage.
        cpu_seconds: processor time of all stages, over all threads.
        peak_memory: largest resident size of this process so far, bytes.
        settings: all settings, as used.
        note: what the user may not expect: more than a fifth of the Gaussians left out, a target size above the finest
            container of the scene, or a capture that is unlike the scene; empty if there is nothing to say.
        evaluation: comparison of the container's renderings with those of the cleaned input; None unless requested.
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
    max_quantization_error: dict[str, list[float]]
    rd_lambda: float | None
    trials: tuple[Attempt, ...]
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
        """Bytes of the container per Gaussian of the scene file."""
        return self.container_bytes / max(self.source_count, 1)

    @property
    def compacted(self) -> int:
        """Gaussians that compaction left out."""
        return 0 if self.compaction is None else self.compaction.source_count - self.compaction.count

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON."""
        derived = {"ratio": self.ratio, "bytes_per_gaussian": self.bytes_per_gaussian}
        evaluation = None if self.evaluation is None else self.evaluation.as_dict()
        compaction = None if self.compaction is None else self.compaction.as_dict()
        finetuning = None if self.finetuning is None else self.finetuning.as_dict()
        trials = [trial.as_dict() for trial in self.trials]
        parts = {"compaction": compaction, "finetuning": finetuning, "evaluation": evaluation, "trials": trials}
        return {**asdict(self), **derived, **parts}
