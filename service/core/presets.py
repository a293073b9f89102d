"""Size, quality and time of each preset, for users and for estimates."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.util import find_spec

import kissgs

from .schemas import COMPACTED, FINETUNED, SEARCHED, PresetFacts, Presets

MEASURED_ON = "fox, 79,451 Gaussians of SH degree 3, seven held-out photographs"
MEASURED_BY = "kissgs compress fox.ply, kissgs evaluate fox.ply fox.zip --views fox"

EVALUATION = 60.0  # CPU seconds per million Gaussians, about: to decode, choose 24 cameras, render twice from each


@dataclass(frozen=True, slots=True)
class _Facts:
    """Texts and figures of a preset, and approximate CPU seconds: a fixed part, and a part per million Gaussians."""

    title: str
    description: str
    bytes_per_gaussian: float
    psnr_change: float
    cpu_seconds_per_million: float  # of encoding
    training: tuple[float, float]  # of a compaction to one fifth
    tuning: tuple[float, float]  # of all Gaussians


_FACTS: dict[kissgs.Preset, _Facts] = {
    kissgs.Preset.FAST: _Facts(
        "Fast", "Takes seconds; for previews and quick checks.", 13.01, -0.37, 13, (1, 15), (50, 300)
    ),
    kissgs.Preset.BALANCED: _Facts(
        "Balanced", "The best quality for its size. The default.", 11.88, -0.28, 205, (300, 600), (50, 1300)
    ),
    kissgs.Preset.PAPER: _Facts(
        "Paper", "The method of the KISS-GS paper, for comparison.", 16.72, -0.39, 260, (700, 2000), (1000, 40_000)
    ),
}


def presets() -> Presets:
    """Return all presets, fastest first."""
    return Presets(
        default=kissgs.Preset.BALANCED,
        measured_on=MEASURED_ON,
        measured_by=MEASURED_BY,
        presets=[
            PresetFacts.model_validate(
                {"name": name, "settings": kissgs.Settings(preset=name).model_dump(mode="json"), **asdict(facts)}
            )
            for name, facts in _FACTS.items()
        ],
    )


START_SECONDS = 1.0  # fixed seconds of every job, to start a process and import the library
BUSY_CORES = 1.8  # average number of busy cores on a two-core server
SEARCH_ENCODINGS = 4.0  # of a search for a goal
TUNED_CONTAINERS = 2.0  # containers that it fine-tunes


def usual_seconds(kind: str, evaluate: bool, gaussians: int) -> float:
    """Estimate the wall time of a job on a small server, used until this server has measured jobs of its own. ``kind``
    is :attr:`service.core.schemas.JobOptions.kind`."""
    name, *stages = kind.split("+")
    known = kissgs.Preset(name) if name in list(kissgs.Preset) else kissgs.Preset.BALANCED  # of an older version
    facts, millions = _FACTS[known], gaussians / 1e6
    encoding = (facts.cpu_seconds_per_million + evaluate * EVALUATION) * millions
    compacts, tunes, searches = (suffix.removeprefix("+") in stages for suffix in (COMPACTED, FINETUNED, SEARCHED))
    training, tuning = (fixed + per_million * millions for fixed, per_million in (facts.training, facts.tuning))
    encodings, tunings = (SEARCH_ENCODINGS, TUNED_CONTAINERS) if searches else (1.0, 1.0)
    return START_SECONDS + (encodings * encoding + compacts * training + tunes * tunings * tuning) / BUSY_CORES


LONGEST_FINETUNING = 2.0  # factor on the time of a job that fine-tunes with a time limit: up to twice the steps


def limited_seconds(kind: str, evaluate: bool, gaussians: int, unlimited: float, limit: float) -> float:
    """Estimate the wall time of a job with a time limit, which does not include the start and the evaluation. Nor does
    it limit a search for the number of Gaussians without fine-tuning. ``kind`` is that of the same job without the
    limit, and ``unlimited`` its time, in seconds."""
    if COMPACTED in kind and FINETUNED not in kind:
        return unlimited
    longest = LONGEST_FINETUNING if FINETUNED in kind else 1.0
    evaluation = evaluate * EVALUATION * gaussians / 1e6 / BUSY_CORES
    return min(longest * unlimited, START_SECONDS + limit + evaluation)


def can_train() -> bool:
    """Return whether torch is installed, which fine-tuning needs, and compaction that trains."""
    return find_spec("torch") is not None
