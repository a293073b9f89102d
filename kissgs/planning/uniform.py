"""Uniform planning: the steps of the settings for all Gaussians, without rendering the scene."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.progress import Progress
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.core.threads import Workers
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.layout import layout_grid
from kissgs.planning.quantize import Quantized, clip_outliers, means_bits, quantize, quantize_means
from kissgs.planning.rotation_forms import canonicalize
from kissgs.planning.sh_codebook import fit_codebook, size_weights
from kissgs.settings import EncodeSettings

OUTLIERS = 1e-4
"""Share of base colours, at either end of a channel, that may be clipped so that the step of the others stays small."""


def plan_uniform(
    splats: Splats, kept: Int[np.ndarray, " M"], settings: EncodeSettings, pool: Workers, progress: Progress
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, which may be none."""
    progress("order", 0.0)
    bits = settings.means_bits or means_bits(splats, kept, settings.means_tolerance)
    grid = layout_grid(splats.means, kept, bits, settings, pool, lambda fraction: progress("order", fraction))
    # Padding repeats Gaussians of the scene; in a scene without any, padding is a neutral Gaussian.
    source, cells = (splats, grid.cells) if len(kept) else (_neutral(splats.sh_degree), grid.cells * 0)
    sh0 = clip_outliers(source.sh0, step=settings.sh0_step, share=OUTLIERS) if settings.shared_step_size else source.sh0
    progress("forms", 0.0)
    quats, scales, form_error, _ = canonicalize(
        source, cells, grid.side, settings, pool, lambda fraction: progress("forms", fraction)
    )
    chosen = cells[grid.mask]
    weights = size_weights(source, settings.sh_weight_power)[chosen]
    codebook = fit_codebook(
        source, chosen, weights, len(chosen) / settings.gaussians_per_codebook_entry, settings, pool, progress
    )
    fields = {
        "means": quantize_means(source.means[cells], bits=bits),
        "opacities": _quantize(source.opacities[cells, None], settings.opacity_step, settings),
        "scales": _quantize(scales, settings.scale_step, settings),
        "quaternions": _quantize(quats, settings.quat_step, settings, paper_top=99),
        "f_dc": _quantize(sh0[cells], settings.sh0_step, settings),
        "f_rest_centroids": codebook.centroids,
    }
    return EncodingPlan(
        grid=grid,
        fields=fields,
        codebook=codebook,
        classes=np.zeros(len(chosen), np.int64),
        form_error=form_error,
        clipped_colors=int((sh0 != source.sh0).any(axis=1).sum()),
        errors={name: _half_steps(field, bits if name == "means" else 16) for name, field in fields.items()},
    )


def _neutral(sh_degree: int) -> Splats:
    """Return a scene of one Gaussian at the origin, of unit size and half opacity."""
    return Splats(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.zeros((1, 3), np.float32),
        opacities=np.zeros(1, np.float32),
        sh0=np.zeros((1, 3), np.float32),
        shN=np.zeros((1, SH_REST_COUNTS[sh_degree], 3), np.float32),
    )


def _quantize(values: np.ndarray, step: float, settings: EncodeSettings, *, paper_top: int = 255) -> Quantized:
    if settings.shared_step_size:
        return quantize(values, step=step)
    return quantize(values, step=step, shared=False, max_top=paper_top)


def _half_steps(field: Quantized, bits: int) -> list[float]:
    spacing = 1 << (16 - bits)
    extent = field.high.astype(np.float64) - field.low
    return [float(step) for step in extent / field.top * spacing / 2]
