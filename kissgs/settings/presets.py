"""Presets: named trade-offs between speed, size and quality, as differences from the defaults."""

from __future__ import annotations

from enum import StrEnum
from typing import Any


class Preset(StrEnum):
    """Named trade-offs between speed, size and quality."""

    FAST = "fast"
    BALANCED = "balanced"
    SMALL = "small"
    PAPER = "paper"


ENCODE: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {
        "rate_distortion": False,
        "order": "hilbert",
        "sh_kmeans_iterations": 1,
        "sh_neighbors": 32,
        "codebook_order": "axes",
        "codebook_max_effort": False,
        "high_effort_pixels": 0,
        "webp_quality": 50,
        "webp_method": 2,
    },
    Preset.BALANCED: {},
    Preset.SMALL: {
        "quality_offset_db": -0.4,
        "color_refit_iterations": 4,
        "sh_kmeans_iterations": 8,
        "sh_neighbors": 128,
        "plas_radius_decay": 0.9,
        "webp_method": 6,
        "high_effort_pixels": 100_000,
    },
    Preset.PAPER: {
        "rate_distortion": False,
        "order": "plas",
        "rotation_form": "pras",
        "shared_step_size": False,
        "means_bits": 16,
        "gaussians_per_codebook_entry": 8,
        "sh_weight_power": 0,
        "sh_tolerance": 0,
        "sh_kmeans_iterations": 8,
        "sh_neighbors": 128,
        "codebook_order": "plas",
        "plas_radius_decay": 0.95,
        "prune_invisible": False,
        "webp_quality": 75,
        "webp_method": 4,
        "codebook_max_effort": False,
        "high_effort_pixels": 0,
    },
}

COMPACT: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {"sparsify_steps": 0, "refine_steps": 0},
    Preset.BALANCED: {},
    Preset.SMALL: {"sparsify_steps": 5000, "refine_steps": 5000},
    Preset.PAPER: {
        "min_keep_per_scoring": 0.0,
        "sparsify_steps": 5000,
        "prune_rounds": 1,
        "admm_rho": 5e-4,
        "refine_steps": 5000,
        "erank_weight": 0.01,
        "min_scale_weight": 1.0,
        "synthetic_view_share": 0.0,
        "ssim_weight": 0.2,
        "mse_weight": 0.0,
        "means_lr_scale": 0.01,
        "lr_scale": 1.0,
        "final_lr_scale": 1.0,
        "synthetic_lr_scale": 1.0,
        "final_means_lr_scale": 0.00215,
    },
}

FINETUNE: dict[Preset, dict[str, Any]] = {
    Preset.FAST: {"steps": 200},
    Preset.BALANCED: {},
    Preset.SMALL: {"steps": 2000},
    Preset.PAPER: {
        "steps": 4000,
        "batch": 8,
        "ssim_weight": 0.2,
        "mse_weight": 0.0,
        "rate_weight": 0.0,
        "tv_weight": 1.0,
        "synthetic_view_share": 0.0,
    },
}

PRESETS = {
    preset: {"compact": COMPACT[preset], "encode": ENCODE[preset], "finetune": FINETUNE[preset]} for preset in Preset
}
"""Differences from the defaults, by preset and group."""
