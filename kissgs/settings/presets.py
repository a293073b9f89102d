"""The presets: named points on the curve of speed, size and quality, as what differs from the defaults."""

from __future__ import annotations

from enum import StrEnum
from typing import Any


class Preset(StrEnum):
    """Named points on the curve of speed, size and quality."""

    FAST = "fast"
    BALANCED = "balanced"
    SMALL = "small"
    PAPER = "paper"


ENCODE: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {
        "weigh": False,
        "sh_rounds": 1,
        "sh_reach": 6,
        "plas_decay": 0.6,
        "codebook_effort": False,
        "webp_quality": 50,
        "webp_method": 2,
    },
    Preset.BALANCED: {},
    Preset.SMALL: {"fidelity": -0.4, "refit": 4, "sh_rounds": 8, "sh_reach": 32, "plas_decay": 0.9},
    Preset.PAPER: {
        "weigh": False,
        "order": "plas",
        "forms": "smooth",
        "shared_steps": False,
        "means_bits": 16,
        "sh_ratio": 8,
        "sh_weight_power": 0,
        "sh_tolerance": 0,
        "sh_rounds": 8,
        "sh_reach": 32,
        "plas_decay": 0.95,
        "drop_invisible": False,
        "webp_quality": 75,
        "webp_method": 4,
        "codebook_effort": False,
    },
}

COMPACT: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {"sparsify_steps": 0, "refine_steps": 0},
    Preset.BALANCED: {},
    Preset.SMALL: {"sparsify_steps": 5000, "refine_steps": 5000},
    Preset.PAPER: {
        "score_share": 0.0,
        "sparsify_steps": 5000,
        "rounds": 1,
        "rho": 5e-4,
        "refine_steps": 5000,
        "needle_weight": 0.01,
        "flat_weight": 1.0,
        "around": 0.0,
        "means_rate": 0.01,
        "rate": 1.0,
        "rate_end": 1.0,
        "renderings_rate": 1.0,
        "means_rate_end": 0.00215,
    },
}

FINETUNE: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {"steps": 200},
    Preset.BALANCED: {},
    Preset.SMALL: {"steps": 2000},
    Preset.PAPER: {"steps": 4000, "batch": 8, "code_length": 0.0, "smoothness": 1.0, "around": 0.0},
}

PRESETS = {
    preset: {"compact": COMPACT[preset], "encode": ENCODE[preset], "finetune": FINETUNE[preset]} for preset in Preset
}
"""By preset and group."""
