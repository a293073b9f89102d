"""Schedule of POPSpa: phases of training, the prunings between them, and learning rates (KISS-GS, section 3.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from kissgs.core.progress import Progress
from kissgs.settings import CompactSettings

if TYPE_CHECKING:
    from kissgs.training.loop import LrSchedule

BASE_LR = {"means": 1.6e-4, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}
"""Learning rates of 3DGS by parameter; that of positions is in units of the extent of the cameras around each."""


@dataclass(frozen=True, slots=True)
class Phase:
    """Training steps, and the number of Gaussians that the pruning after them leaves.

    Attributes:
        name: name in progress events and of the steps in the report.
        steps: number of training steps.
        count: number of Gaussians left.
    """

    name: Literal["sparsify", "refine"]
    steps: int
    count: int


def first_pruning_count(settings: CompactSettings, source_count: int, count: int) -> int:
    """Return the number of Gaussians that the first pruning leaves, before any training.

    Args:
        settings: settings of compaction.
        source_count: number of Gaussians of the scene.
        count: number of Gaussians to keep in the end, from 1 to ``source_count``.
    """
    fraction = settings.initial_prune_fraction if settings.sparsify_steps else 1.0
    return round(source_count * (count / source_count) ** fraction)


def training_phases(settings: CompactSettings, source_count: int, count: int) -> list[Phase]:
    """Return all phases of training: one before each further pruning, then refinement; none if nothing is trained.

    The prunings are spread evenly over ``sparsify_steps``, and each keeps the same share of the Gaussians.
    Arguments are those of :func:`first_pruning_count`.
    """
    phases = []
    if settings.sparsify_steps:
        rounds = min(settings.prune_rounds, settings.sparsify_steps)
        first, fractions = first_pruning_count(settings, source_count, count), np.arange(1, rounds + 1) / rounds
        counts = np.rint(first * (count / first) ** fractions).astype(int)
        ends = np.rint(settings.sparsify_steps * np.concatenate([[0], fractions])).astype(int)
        phases = [Phase("sparsify", int(steps), int(left)) for steps, left in zip(np.diff(ends), counts, strict=True)]
    if settings.refine_steps:
        phases.append(Phase("refine", settings.refine_steps, count))
    return phases


def stage_progress(progress: Progress, phases: Sequence[Phase], number: int) -> Progress:
    """Return a receiver that reports phase ``number`` and the pruning after it as a part of one stage.

    All phases of the same name, and the prunings after them, are one stage of that name.
    """
    name = phases[number].name
    before = sum(phase.steps for phase in phases[:number] if phase.name == name)
    total = sum(phase.steps for phase in phases if phase.name == name)

    def receive(stage: str, fraction: float, note: str = "") -> None:
        done = phases[number].steps * (fraction if stage == name else 1.0)
        progress(name, (before + done) / total, note)

    return receive


def lr_schedule(settings: CompactSettings, phase: Phase, target_source: str) -> LrSchedule:
    """Return learning rates: constant while Gaussians are pruned, falling exponentially during refinement.

    3DGS does the latter for positions only. ``target_source`` is that of the training targets: "photos" or
    "renderings".
    """
    from kissgs.training.loop import exponential_lr

    base = dict(BASE_LR)
    if target_source == "renderings":
        base = {name: rate * settings.synthetic_lr_scale for name, rate in base.items()}
    begin = {name: settings.means_lr_scale if name == "means" else settings.lr_scale for name in base}
    end = {name: settings.final_means_lr_scale if name == "means" else settings.final_lr_scale for name in base}
    return exponential_lr(base, begin, end if phase.name == "refine" else begin)
