"""What each preset costs and gives, for people who have to choose."""

from __future__ import annotations

from importlib.util import find_spec

import kissgs
from service.core.schemas import COMPACTED, SOUGHT, TUNED, PresetFacts, Presets

MEASURED_ON = "fox, 79,451 Gaussians of SH degree 3, seven held-out photographs"
MEASURED_BY = "kissgs compress fox.ply, kissgs evaluate fox.ply fox.zip --views fox"

EVALUATION = 60.0
"""CPU seconds per million Gaussians, roughly: decoding, finding 24 cameras, and two small pictures from each."""

_FACTS: dict[kissgs.Preset, tuple[str, str, float, float, float]] = {
    kissgs.Preset.FAST: ("Fast", "Seconds, for uploads that wait.", 13.13, -0.39, 26),
    kissgs.Preset.BALANCED: ("Balanced", "The best pictures for their size. The default.", 12.32, -0.30, 370),
    kissgs.Preset.SMALL: ("Small", "A little smaller still, and slower.", 12.22, -0.27, 370),
    kissgs.Preset.PAPER: ("Paper", "KISS-GS as published, to compare with.", 17.13, -0.38, 460),
}


def presets() -> Presets:
    """All presets, cheapest first."""
    return Presets(
        default=kissgs.Preset.BALANCED,
        measured_on=MEASURED_ON,
        measured_by=MEASURED_BY,
        presets=[
            PresetFacts(
                name=name,
                title=title,
                description=text,
                settings=kissgs.Settings(preset=name).model_dump(mode="json"),
                bytes_per_gaussian=size,
                psnr_change=change,
                cpu_seconds_per_million=seconds,
            )
            for name, (title, text, size, change, seconds) in _FACTS.items()
        ],
    )


START_SECONDS = 1.0
"""What a job takes whatever its size: a process and its imports."""

BUSY_CORES = 1.8
"""Of the two of a small server."""


TRAINING = {
    kissgs.Preset.FAST: (10.0, 120.0),
    kissgs.Preset.BALANCED: (300.0, 600.0),
    kissgs.Preset.SMALL: (600.0, 1200.0),
    kissgs.Preset.PAPER: (700.0, 2000.0),
}
"""CPU seconds of a compaction to a fifth, roughly: of any, and per million Gaussians."""


TUNING = {
    kissgs.Preset.FAST: (50.0, 300.0),
    kissgs.Preset.BALANCED: (50.0, 1300.0),
    kissgs.Preset.SMALL: (100.0, 2600.0),
    kissgs.Preset.PAPER: (1000.0, 40_000.0),
}
"""The same of fine-tuning all Gaussians."""

SEEKING = 4.0
"""Times all of it, where a goal is sought."""


def usual_seconds(kind: str, evaluate: bool, gaussians: int) -> float:
    """Wall time of a job on a small server, until this one has its own experience.

    ``kind`` is that of :class:`service.core.schemas.JobOptions`.
    """
    name, *stages = kind.split("+")
    preset, millions = kissgs.Preset(name), gaussians / 1e6
    cpu = (_FACTS[preset][4] + evaluate * EVALUATION) * millions
    for suffix, costs in ((COMPACTED, TRAINING), (TUNED, TUNING)):
        if suffix.removeprefix("+") in stages:
            whatever, each = costs[preset]
            cpu += whatever + each * millions
    cpu *= SEEKING if SOUGHT.removeprefix("+") in stages else 1.0
    return START_SECONDS + cpu / BUSY_CORES


def can_train() -> bool:
    """Whether there is a torch, which fine-tuning needs, and compaction for all but pruning."""
    return find_spec("torch") is not None
