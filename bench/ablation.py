"""Bytes and PSNR with one part of the codec left out, or one setting of a preset changed.

    python bench/ablation.py fox.ply --views fox

The first table repeats the one of KISS-GS (bicycle, 256,000 Gaussians), also where no valid container results; the
second changes settings of ``paper`` to the values of other presets, the third leaves out choices of ``balanced``.
"""

from __future__ import annotations

from pathlib import Path

from bench import paper_parts
from bench.common import (
    arguments,
    at_quality_offset,
    bytes_at,
    head,
    percent,
    row,
    run,
    signed,
    with_changes,
    write,
)
from kissgs import InvalidSceneError, Settings, Views, clean, evaluate, load
from kissgs.cli.bench import measured
from kissgs.evaluation.results import Comparison

PUBLISHED_BYTES = 3_877_944
"""Bytes of the paper's container of bicycle with all parts."""

PARTS: tuple[tuple[str, paper_parts.LeaveOut, int, float], ...] = (
    ("levels of the SH codebook", paper_parts.codebook_levels, 4_042_523, 0.0097),
    ("SH codebook", paper_parts.sh_codebook, 3_434_816, 0.232),
    ("WebP", paper_parts.webp, 3_030_148, 0.0),
    ("levels of rotations", paper_parts.as_floats("quats", "quaternions"), 2_548_718, 0.032),
    ("levels of base colours", paper_parts.as_floats("sh0", "f_dc"), 2_084_291, 0.006),
    ("levels of sizes", paper_parts.as_floats("scales", "scales"), 1_966_415, 0.004),
    ("levels of positions", paper_parts.as_floats("means", "means_bytes_0", "means_bytes_1"), 1_392_843, 0.012),
    ("order (PLAS)", paper_parts.scene_order, 614_851, 0.0059),
    ("levels of opacities", paper_parts.as_floats("opacities", "opacities"), 609_117, 0.0006),
    ("forms (PRAS), 256 levels", paper_parts.rotation_forms(255), 161_748, 0.010),
    ("order of the codebook", paper_parts.codebook_order, 42_416, 0.0),
    ("labels as column and row", paper_parts.label_pairs, 12_142, 0.0),
    ("mask: pruned to a square", paper_parts.mask, 3_344, -0.115),
    ("forms (PRAS), 100 levels", paper_parts.rotation_forms(99), -11_810, -0.110),
    ("logarithm of positions", paper_parts.signed_log, -519_272, -7.55),
)
"""Name, function, and the published growth in bytes and change of PSNR to photographs."""

OF_CODEBOOK = ("levels of the SH codebook", "SH codebook", "order of the codebook", "labels as column and row")

PAPER: tuple[dict[str, object], ...] = (
    {},
    {"order": "hilbert"},
    {"rotation_form": "canonical"},
    {"shared_step_size": True},
    {"sh_weight_power": 0.35},
    {"prune_invisible": True},
    {"plas_radius_decay": 0.8},
    {"webp_quality": 50, "webp_method": 2},
)
"""Changes of ``paper`` to choices of the other presets."""

BALANCED: tuple[dict[str, object], ...] = (
    {},
    {"rate_distortion": False},
    {"rdo_quantization": False},
    {"step_classes": 1},
    {"prune_threshold_bits": 0.0},
    {"color_refit_iterations": 0},
    {"view_uncertainty": 0.0},
    {"sensitivity_views": 12},
    {"order": "hilbert"},
    {"order": "plas"},
    {"rotation_form": "pras"},
    {"sh_kmeans_iterations": 1, "sh_neighbors": 32},
    {"codebook_max_effort": False},
    {"webp_quality": 50, "webp_method": 2},
)
"""Changes of ``balanced``, each of which leaves out one of its choices."""

CURVE_DB = 2.5
"""Distance of the two outer points of the rate curve of ``balanced`` from its own quality offset, decibels."""


def main() -> None:
    """Print the three tables; PSNR is the change of PSNR to photographs, or to the original without photographs."""
    parser = arguments(__doc__)
    parser.add_argument("--lpips", action="store_true", help="also measure LPIPS in the first table")
    given = parser.parse_args()
    published(given.scene, given.views, lpips=given.lpips)
    variants(given.scene, given.views, Settings.from_preset("paper"), PAPER)
    settings, curve = Settings.from_preset("balanced"), []
    for step in (-CURVE_DB, CURVE_DB):
        outer = at_quality_offset(settings, settings.encode.quality_offset_db + step)
        found = measured(given.scene, outer, views=given.views)
        psnr = found.evaluation.mean.candidate_vs_reference.psnr
        curve.append((psnr, float(found.report.container_bytes)))
    variants(given.scene, given.views, settings, BALANCED, curve)


def published(path: Path, views: Views | None, *, lpips: bool) -> None:
    """Print the table of the paper, measured on this scene."""
    scene, settings = clean(load(path))[0], Settings.from_preset("paper").encode
    if not len(scene):
        raise InvalidSceneError(f"{path} has no usable Gaussian")
    whole = paper_parts.encode_parts(scene, settings, 0)
    size = whole.size(settings, 0)
    mean = evaluate(scene, whole.decoded, views, lpips=lpips).mean.candidate
    head("left out", "bytes", "change", "PSNR", "SSIM", "LPIPS", "published: change", "PSNR")
    row("nothing", size, "", f"{mean.psnr:.2f}", f"{mean.ssim:.4f}", _or_empty(mean.lpips), "", "")
    for name, leave_out, more, psnr in PARTS:
        if name in OF_CODEBOOK and not scene.sh_degree:
            continue
        parts = leave_out(whole, settings, 0)
        own = parts.size(settings, 0)
        found = evaluate(scene, parts.decoded, views, lpips=lpips).mean.candidate
        lost = None if found.lpips is None or mean.lpips is None else found.lpips - mean.lpips
        changes = signed(found.psnr - mean.psnr, 4), signed(found.ssim - mean.ssim, 5), signed(lost, 5)
        row(name, own, percent(own / size - 1), *changes, percent(more / PUBLISHED_BYTES), signed(psnr, 4))
    write("")


def _or_empty(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def variants(
    path: Path,
    views: Views | None,
    settings: Settings,
    changes: tuple[dict[str, object], ...],
    curve: list[tuple[float, float]] | None = None,
) -> None:
    """Print a table of a preset and its changes; ``curve`` are outer points (PSNR, bytes) of its rate curve."""
    head("changed", "bytes", "change", "PSNR to the original", "to photographs", "bytes at equal PSNR", "CPU s")
    base, base_bytes = None, 0
    for change in changes:
        found = measured(path, with_changes(settings, change), views=views)
        mean, size = found.evaluation.mean, found.report.container_bytes
        psnr, cpu = mean.candidate_vs_reference.psnr, f"{found.report.cpu_seconds:.1f}"
        if base is None:
            base, base_bytes = mean, size
            curve = None if curve is None else [*curve, (psnr, size)]
            photo = "" if mean.reference is None else f"{mean.candidate.psnr:.2f}"
            row("nothing", size, "", f"{psnr:.2f}", photo, "", cpu)
            continue
        equal = None if curve is None else bytes_at(curve, psnr)
        name = ", ".join(f"{key}={value}" for key, value in change.items())
        cells = percent(size / base_bytes - 1), signed(psnr - base.candidate_vs_reference.psnr), _photo(mean, base)
        row(f"`{name}`", size, *cells, percent(None if equal is None else size / equal - 1), cpu)
    write("")


def _photo(mean: Comparison, base: Comparison) -> str:
    return "" if mean.reference is None else signed(mean.candidate.psnr - base.candidate.psnr)


if __name__ == "__main__":
    run(main)
