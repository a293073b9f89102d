"""What each preset costs and gives, for people who have to choose."""

from __future__ import annotations

import kissgs
from service.schemas import PresetFacts, Presets

MEASURED_ON = "fox, 79,451 Gaussians of SH degree 3, seven held-out photographs"
MEASURED_BY = "kissgs bench fox.ply --views fox"

EVALUATION = 60.0
"""CPU seconds per million Gaussians, roughly: decoding, and two pictures from each of four cameras."""

_FACTS: dict[kissgs.Preset, tuple[str, str, float, float, float]] = {
    kissgs.Preset.FAST: ("Fast", "Seconds, for uploads that wait.", 13.19, -0.39, 38),
    kissgs.Preset.BALANCED: ("Balanced", "The best pictures for their size. The default.", 12.96, -0.34, 154),
    kissgs.Preset.SMALL: ("Small", "A fifth smaller; for phones and thin lines.", 10.41, -0.61, 77),
    kissgs.Preset.PAPER: ("Paper", "KISS-GS as published, to compare with.", 17.19, -0.38, 449),
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


def usual_seconds(preset: str, evaluate: bool, gaussians: int) -> float:
    """Wall time of a job on a small server, until this one has its own experience."""
    cpu = (_FACTS[kissgs.Preset(preset)][4] + evaluate * EVALUATION) * gaussians / 1e6
    return START_SECONDS + cpu / BUSY_CORES
