"""``Compacted``: a scene with fewer Gaussians, and the report of its compaction."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.splats import NOTHING_CLEANED, Cleaned, Splats


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactionStep:
    """One step of a compaction, and the scene after it; quality and size are None if not requested. PSNR is the mean
    over held-out views, to their photographs; without photographs, over cameras drawn over the whole scene, to
    renderings of the input, so that the input itself has infinity."""

    name: str  # "input", "prune", "merge", "sparsify" or "refine"
    count: int
    seconds: float  # without evaluation
    psnr: float | None = None  # decibels
    ssim: float | None = None
    ms_ssim: float | None = None
    bytes: int | None = None  # of its container with the preset fast


@dataclass(frozen=True, slots=True)
class CountTrial:
    """One number of Gaussians that a search tried, before any encoding."""

    count: int
    drop: float  # of PSNR as goals count it, decibels
    ssim_drop: float | None = None  # None where counts are searched for a drop of PSNR alone
    decisive: str = ""  # the loss with the least margin to its limit, in words; empty for a size or a PSNR

    def summary(self) -> str:
        """Return the loss that decides in one phrase: "50,000 Gaussians lose 0.120 dB"."""
        return f"{self.count:,} Gaussians lose {self.loss()}"

    def loss(self) -> str:
        """Return the loss that decides: "0.120 dB" or "0.003 of SSIM"."""
        return self.decisive or f"{self.drop:.3f} dB"


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactionReport:
    """Effort and results of a compaction.

    Attributes:
        source_count: number of Gaussians before, cleaned.
        count: number of Gaussians after.
        target_source: training targets: "photos", or "renderings" of the input; "nothing" without training.
        source: description of the training views; empty if no view was used.
        steps: all steps in order, the input first; empty if the scene is unchanged.
        trials: counts that a search tried, with the loss of each; empty if the count was given.
        cleaned: invalid values of the input that cleaning removed or replaced.
        cpu_seconds: CPU time of all threads.
        peak_memory: largest resident memory of the process so far, bytes.
        note: note for the user, a sentence without capital and full stop; may be empty.
    """

    source_count: int
    count: int
    target_source: str = "nothing"
    source: str = ""
    steps: tuple[CompactionStep, ...] = ()
    trials: tuple[CountTrial, ...] = ()
    cleaned: Cleaned = NOTHING_CLEANED
    cpu_seconds: float = 0.0
    peak_memory: int = 0
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON; an infinite PSNR is None (null)."""
        values = asdict(self)
        for step in values["steps"]:
            step["psnr"] = None if step["psnr"] == float("inf") else step["psnr"]
        return values


@dataclass(frozen=True, slots=True)
class Compacted:
    """A compacted scene.

    Attributes:
        splats: the scene, clean.
        index: ``(M,)`` index in the cleaned input of each of its Gaussians, ascending; of a merged one, that of the
            member with the largest weight.
        report: effort and results.
        checkpoint: file with the final state of the training; to be deleted once the scene is saved. None if there is
            no such file.
    """

    splats: Splats
    index: Int[np.ndarray, " M"]
    report: CompactionReport
    checkpoint: Path | None = None
