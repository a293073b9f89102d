"""``Compacted``: fewer Gaussians, and what each step of getting there took and gave."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.splats import NOTHING_CLEANED, Cleaned, Splats


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactionStep:
    """One of the steps of a compaction, and the scene after it.

    Attributes:
        name: "input", "prune", "sparsify" or "refine".
        count: Gaussians.
        seconds: wall time, without what judging it took.
        psnr: decibels, mean over held-out views: to their photographs, or to the input's renderings where there are
            none; infinite for the input itself then. None where it was not asked for.
        ssim: the same.
        bytes: of its container as the preset ``fast`` makes it. None where it was not asked for.
    """

    name: str
    count: int
    seconds: float
    psnr: float | None = None
    ssim: float | None = None
    bytes: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactionReport:
    """What a compaction took and gave.

    Attributes:
        source_count: Gaussians before.
        count: Gaussians after.
        target_source: what it was fitted to: "photos" or "renderings" of the input; "nothing" where it was only pruned.
        source: of the views, for people.
        steps: in their order, the input first.
        trials: where a drop of PSNR was given instead of a count: counts that were tried, and the drop of each, dB.
        cleaned: what was wrong with the input, which counts are without.
        cpu_seconds: processor time, over all threads.
        peak_memory: bytes, the largest this process has ever had resident.
        note: a sentence for people about what they may not have expected, without a capital and a full stop; or none.
    """

    source_count: int
    count: int
    target_source: str
    source: str
    steps: tuple[CompactionStep, ...]
    trials: tuple[tuple[int, float], ...] = ()
    cleaned: Cleaned = NOTHING_CLEANED
    cpu_seconds: float = 0.0
    peak_memory: int = 0
    note: str = ""

    def as_dict(self) -> dict[str, Any]:
        """For machines; what is infinite is null."""
        told = asdict(self)
        for step in told["steps"]:
            step["psnr"] = None if step["psnr"] == float("inf") else step["psnr"]
        return told


@dataclass(frozen=True, slots=True)
class Compacted:
    """A smaller scene.

    Attributes:
        splats: clean.
        index: ``(M,)`` for each of its Gaussians, which one of the cleaned input it was; rising.
        report: what it took and gave.
        checkpoint: the file that holds all this, if there is one: to be deleted when it is kept elsewhere.
    """

    splats: Splats
    index: Int[np.ndarray, " M"]
    report: CompactionReport
    checkpoint: Path | None = None
