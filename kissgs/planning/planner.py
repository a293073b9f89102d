"""``plan_encoding``: rate-distortion or uniform planning, in an order along the Hilbert curve that is refined."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int, Int32, Integer, UInt8, UInt16
from kissgs.core.context import DEFAULT_CONTEXT, Context, Progress
from kissgs.core.errors import UnsupportedError
from kissgs.core.positions import coarse_note
from kissgs.core.resources import Workers, blas_workers, return_free_memory
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import SH_REST_COUNTS, Splats
from kissgs.planning import quantize, rd_fields
from kissgs.planning.encoding_plan import EncodingPlan, PlannedScene
from kissgs.planning.layout import hilbert_order, layout_grid
from kissgs.planning.quantize import EVEN_LEVELS, ByteTables, ContainerModel, Planning, Quantized, Rows, selected
from kissgs.planning.rate_distortion import ColorRefit, plan_rate_distortion
from kissgs.planning.rd_fields import OUTLIERS, largest_errors
from kissgs.planning.rotation_forms import SHAPE_COLUMNS, choose_forms
from kissgs.planning.sh_codebook import FEW, fit_codebook, size_weights
from kissgs.settings import EncodeSettings

# Order along the Hilbert curve, refined by the local search of the travelling-salesman problem (2-opt and Or-opt).
#
# WebP codes the differences of a pixel from the one on its left, which then take fewer bits for what resembles that of
# neighbours: high bytes of positions and base colours.

BLOCK, SMALLEST = 1 << 13, 64  # Gaussians reordered together; fewer have too few differences to count
ROUNDS, PASSES = 2, 2  # rounds of counting bits, in blocks that begin elsewhere, and most passes in each
NEAR, REACH = 8, 16  # Gaussians that each may be joined to, and places on the curves where they are found
CURVES = ((0, 1, 2, 0), (1, 2, 0, 21845), (2, 0, 1, 43690))  # axes and shift: where one has a gap, another has none
SMOOTHING = ((-2, 1 / 9), (-1, 2 / 9), (0, 3 / 9), (1, 2 / 9), (2, 1 / 9))  # average of counts: shifts, weights
UNIT = 256  # fractions of a bit that the local search counts in, so that no rounding of a machine changes the order


def refine_order(
    plan: EncodingPlan, groups: UInt16[np.ndarray, " N"] | None, pool: Workers, progress: Progress
) -> EncodingPlan:
    """Reorder a plan along the Hilbert curve within each class, and within each of ``groups``; reports "reorder".
    Padding, at the end, repeats the last Gaussian, which stays."""
    count = len(plan.classes)
    if count == 0:
        return plan
    runs = plan.classes if groups is None else groups[plan.grid.cells[:count]].astype(np.int32) * 256 + plan.classes
    progress("reorder", 0.0)
    means, colors = (plan.fields[name].levels[:count] for name in ("means", "f_dc"))
    order = refined_order(means, colors, runs, pool, lambda fraction: progress("reorder", fraction))
    cells = np.concatenate([order, np.arange(count, len(plan.grid.cells), dtype=np.int32)])
    rows = {name: field.take(cells) for name, field in plan.fields.items() if name != "f_rest_centroids"}
    return replace(
        plan,
        grid=replace(plan.grid, cells=plan.grid.cells[cells]),
        fields={**plan.fields, **rows},
        codebook=replace(plan.codebook, labels=plan.codebook.labels[order]),
        classes=plan.classes[order],
        costs=None if plan.costs is None else plan.costs.take(order),
    )


def refined_order(
    means: UInt16[np.ndarray, "M 3"],
    colors: UInt8[np.ndarray, "M 3"],
    runs: Integer[np.ndarray, " M"],
    pool: Workers,
    report: Callable[[float], None] = lambda fraction: None,
) -> Int32[np.ndarray, " M"]:
    """Return the index of the Gaussian for every place. Gaussians at the same position keep their order, because
    renderers blend them in it. The first and the last Gaussian of a run stay."""
    pixels, order = _pixels(means, colors), np.arange(len(means), dtype=np.int32)
    ends = np.concatenate([np.flatnonzero(np.diff(runs)) + 1, [len(runs)]]).tolist()

    def refine(places: slice) -> None:
        chosen = order[places]
        order[places] = chosen[_block_order(means[chosen], pixels[chosen])]

    for done in range(ROUNDS):

        def report_done(fraction: float, done: int = done) -> None:
            report((done + fraction) / ROUNDS)

        pool.map(refine, _blocks(ends, BLOCK if done % 2 == 0 else BLOCK // 2), report_done)
    return _with_equal_positions_in_order(order, means)


def _pixels(means: UInt16[np.ndarray, "M 3"], colors: UInt8[np.ndarray, "M 3"]) -> UInt8[np.ndarray, "M 6"]:
    """Return what WebP predicts from the left: high bytes of positions; green, and red and blue without it."""
    red, green, blue = colors.T
    return np.ascontiguousarray(np.column_stack([(means >> 8).astype(np.uint8), green, red - green, blue - green]))


def _blocks(ends: list[int], first_size: int) -> list[slice]:
    """Return blocks of runs with these ends: in each run, one of at most ``first_size`` places, then larger ones. What
    is left of a run may be too small to count differences in, and is no block."""
    blocks = []
    for start, end in pairwise([0, *ends]):
        edges = [start, *range(start + first_size, end, BLOCK), end]
        blocks += [slice(a, b) for a, b in pairwise(edges) if b - a >= SMALLEST]
    return blocks


def _block_order(means: UInt16[np.ndarray, "B 3"], pixels: UInt8[np.ndarray, "B 6"]) -> Int32[np.ndarray, " B"]:
    """Return the refined order of some Gaussians, of which the first and the last stay."""
    from kissgs.planning import kernels

    order = np.arange(len(means), dtype=np.int32)
    bits = _difference_bits(pixels)
    curves = np.stack([hilbert_order(means[:, axes] + np.uint16(shift)) for *axes, shift in CURVES])
    near = np.empty((len(means), NEAR), np.int32)
    kernels.near_pixels(pixels, bits, curves, REACH, near)
    kernels.improve(pixels, bits, near, PASSES, order)
    return order


def _difference_bits(pixels: UInt8[np.ndarray, "B C"]) -> Int32[np.ndarray, "C 256"]:
    """Return the bits of each difference of a channel from the pixel before, modulo 256, by how often it occurs. The
    counts of differences that are alike are averaged. A difference and its negative take the same bits."""
    counts = np.stack([np.bincount(channel, minlength=256) for channel in np.diff(pixels, axis=0).T]).astype(np.float64)
    counts += counts[:, -np.arange(256)]
    counts = (counts + sum(weight * np.roll(counts, shift, axis=1) for shift, weight in SMOOTHING)) / 2 + 1
    return np.rint(UNIT * np.log2(counts.sum(axis=1, keepdims=True) / counts)).astype(np.int32)


def _with_equal_positions_in_order(
    order: Int32[np.ndarray, " M"], means: UInt16[np.ndarray, "M 3"]
) -> Int32[np.ndarray, " M"]:
    """Return an order in which Gaussians of equal position have ascending indices."""
    x, y, z = means[order].T
    keys = x | y.astype(np.uint64) << np.uint64(16) | z.astype(np.uint64) << np.uint64(32)
    places = quantize.sorted_order(keys, 48)
    group = np.cumsum(np.diff(keys, prepend=keys[:1]) > 0)
    shared = np.bincount(group, minlength=1)[group] > 1
    places, group = places[shared], group[shared]
    order = order.copy()
    order[places] = order[places][np.lexsort((order[places], group))]
    return order


# Uniform planning: the steps of the settings for all Gaussians, without rendering the scene.

FINEST = 1e-4  # step of values that may take all levels of a table


def plan_uniform(
    splats: Splats, kept: Int[np.ndarray, " M"], planning: Planning, groups: UInt16[np.ndarray, " N"] | None = None
) -> EncodingPlan:
    """Plan the Gaussians ``kept``, which may be none, for a container."""
    settings, container, pool = planning.settings, planning.container, planning.pool
    most = 16 if container.tables is None else 32
    bits = settings.means_bits or quantize.means_bits(splats, kept, settings.means_tolerance, pool, most=most)
    grid = layout_grid(splats.means, kept, min(bits, 16), settings, pool, planning.report("order"), None, groups)
    grid = grid.with_padding_last() if container.padding_last else grid
    # Padding repeats Gaussians of the scene; in a scene without any, padding is a neutral Gaussian.
    source, cells = (splats, grid.cells) if len(kept) else (_neutral(splats.sh_degree), grid.cells * 0)
    shared, sh0 = settings.shared_step_size, source.sh0
    if shared and container.tables is None:
        sh0 = quantize.clip_outliers(sh0, step=settings.sh0_step, share=OUTLIERS)
    shapes, form_error = choose_forms(source, cells, grid.side, planning)
    chosen = cells[grid.mask]
    weights = np.ones(len(chosen), np.float32)
    if source.sh_degree > 0:
        weights = size_weights(source, settings.sh_weight_power)[chosen]
    size = max(len(chosen) / settings.gaussians_per_codebook_entry, FEW)
    codebook = fit_codebook(source, chosen, weights, size, planning)
    return_free_memory()
    own = settings.opacity_step, settings.scale_step, settings.quat_step, settings.sh0_step
    steps = dict(zip(("opacities", "scales", "quaternions", "f_dc"), own, strict=True))
    if container.tables is not None:
        if not shared:
            steps = dict.fromkeys(steps, FINEST)
        means, colors = source.means[cells], source.sh0[cells]
        fields, errors = _table_fields(means, colors, shapes[:], bits, steps, container.tables)
    else:
        rows: dict[str, Rows] = {name: shapes.field(name) for name in SHAPE_COLUMNS}
        rows["f_dc"] = selected(sh0, cells)
        fields = {"means": quantize.quantize_means(selected(source.means, cells), bits=bits, pool=pool)}
        for name, step in steps.items():
            top = settings.quat_levels - 1 if name == "quaternions" and not shared else 255
            fields[name] = quantize.quantize(rows[name], step=step, shared=shared, max_top=top, pool=pool)
        errors = {name: quantize.half_steps(field) for name, field in fields.items()}
        errors["means"] = quantize.half_steps(fields["means"], 1 << (16 - bits))
    return EncodingPlan(
        scene=PlannedScene(len(splats), len(kept), splats.sh_degree, splats.origin, splats.antialiased),
        grid=grid,
        fields={**fields, "f_rest_centroids": codebook.centroids},
        codebook=codebook,
        classes=np.zeros(len(chosen), np.uint8),
        form_error=form_error,
        clipped_colors=0 if sh0 is source.sh0 else int((sh0 != source.sh0).any(axis=1).sum()),
        errors={**errors, "f_rest_centroids": codebook.errors},
    )


def _table_fields(
    means: Float32[np.ndarray, "cells 3"],
    colors: Float32[np.ndarray, "cells 3"],
    values: Float64[np.ndarray, "cells 8"],
    bits: int,
    steps: Mapping[str, float],
    tables: ByteTables,
) -> tuple[dict[str, Quantized], dict[str, list[float]]]:
    """Return the levels by field, and the largest errors, for a container with tables."""
    equal = np.ones(len(means))
    each = {name: step * equal for name, step in steps.items()}
    unit = quantize.log_extent(means) / quantize.MEANS_TOP
    wanted = rd_fields.stored_values(values, tables)
    shapes = rd_fields.rounded_shapes(wanted, equal, each, tables)
    fields = {
        **rd_fields.finished_shapes(shapes, values[:, 0], tables),
        "means": rd_fields.means_field(means, max(unit, 1e-30) * 2.0 ** (16 - bits)),
        "f_dc": rd_fields.color_field(colors.astype(np.float64), each["f_dc"], equal),
    }
    return fields, largest_errors(fields, values, means, colors)


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


INVISIBLE_LOGIT = -5.5373  # logit of opacity 1/255, rounded up; no renderer draws Gaussians of this opacity or less
SAMPLED = 1 << 18  # number of Gaussians whose sizes are compared with the steps of positions
MAX_GROUPS = 1 << 14  # in a container: group and class of steps together are a number of 16 bits


def plan_encoding(
    splats: Splats,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    sensitivity: Sensitivity | None = None,
    recolor: ColorRefit | None = None,
    container: ContainerModel = EVEN_LEVELS,
    keep_costs: bool = True,
    groups: UInt16[np.ndarray, " N"] | None = None,
) -> EncodingPlan:
    """Choose order, rotation forms, codebook and levels for a clean scene. Without sensitivity, or if no camera saw any
    Gaussian, planning is uniform, with the steps of the settings. With ``groups``, the Gaussians of each follow one
    another in the container, the groups in ascending order."""
    if groups is not None and settings.order == "plas":
        raise UnsupportedError("a container with groups of Gaussians needs order=hilbert or order=refined")
    if groups is not None and int(groups.max(initial=0)) >= MAX_GROUPS:
        raise UnsupportedError(f"a container holds up to {MAX_GROUPS:,} groups of Gaussians; make them larger")
    if sensitivity is not None:
        sensitivity.check(splats)
    kept = visible_gaussians(splats, settings)
    with blas_workers(context.threads) as pool:
        planning = Planning(settings, container, pool, context.progress)
        if sensitivity is not None and (sensitivity.color_weight[kept] > 0).any():
            plan = plan_rate_distortion(splats, kept, sensitivity, recolor, planning, keep_costs, groups)
        else:
            plan = plan_uniform(splats, kept, planning, groups)
        if settings.order == "refined":
            plan = refine_order(plan, groups, pool, context.progress)
        order, means = plan.grid.cells[plan.grid.mask], plan.fields["means"]
        some = order[:: 1 + len(order) // SAMPLED]
        note = coarse_note(splats.means[some], splats.scales[some], means.low, means.high, len(order))
        return replace(plan, coarse=note)


def visible_gaussians(splats: Splats, settings: EncodeSettings) -> Int32[np.ndarray, " K"]:
    """Return the indices of the Gaussians that a renderer draws, or of all if ``prune_invisible`` is off."""
    if not settings.prune_invisible:
        return np.arange(len(splats), dtype=np.int32)
    return np.flatnonzero(splats.opacities > np.float32(INVISIBLE_LOGIT)).astype(np.int32)
