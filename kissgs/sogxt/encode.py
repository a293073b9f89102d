"""``Splats`` -> SOG-XT files: plan the encoding, render the planes, compress them, write the metadata."""

from __future__ import annotations

from functools import partial

import numpy as np

from kissgs._version import __version__
from kissgs.core.array_types import Float32, UInt8
from kissgs.core.context import DEFAULT_CONTEXT, Context, blas_workers, load_kernels
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import NOTHING_CLEANED, Cleaned, Splats
from kissgs.io.images import compress_images, pixels_crc32
from kissgs.planning.planner import ColorRefit, Encoded, EncodingPlan, plan_encoding
from kissgs.planning.quantize import Quantized, observed_range
from kissgs.planning.sh_codebook import Codebook
from kissgs.settings import GOALS, EncodeSettings
from kissgs.sogxt import JSON_NAME, SCENE_NAME, YAML_NAME, metadata


def encode(
    splats: Splats,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    sensitivity: Sensitivity | None = None,
    recolor: ColorRefit | None = None,
) -> Encoded:
    """Encode a clean scene: :func:`kissgs.planning.planner.plan_encoding`, then :func:`write_files`."""
    load_kernels(context.progress)
    plan = plan_encoding(splats, settings, context, sensitivity=sensitivity, recolor=recolor)
    return write_files(plan, settings, context)


def write_files(
    plan: EncodingPlan,
    settings: EncodeSettings,
    context: Context = DEFAULT_CONTEXT,
    *,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    finetune_steps: int = 0,
) -> Encoded:
    """Make the files of a plan; the bytes do not depend on the number of threads. The metadata records the counts."""
    context.progress("images", 0.0)
    images = render_planes(plan)
    with blas_workers(context.threads) as pool:
        files = compress_images(images, settings, pool, partial(context.progress, "images"))
    scene, count = plan.scene, int(plan.grid.mask.sum())
    changed = {
        "invisible": scene.count - scene.visible,
        "pruned_by_rd": scene.visible - count,
        "clipped_colors": plan.clipped_colors,
        "compacted": compacted,
        **cleaned.as_dict(),
    }
    recorded = settings.model_dump(exclude={*GOALS, "max_encodes"}, exclude_defaults=True)
    recorded |= {"rd_lambda": plan.rd_lambda, "finetune_steps": finetune_steps or None}
    layout = metadata.Layout(
        grid_side=plan.grid.side,
        codebook_side=plan.codebook.side,
        count=count,
        ranges=_ranges(plan.fields),
        origin=scene.origin,
        model="antialiased" if scene.antialiased else None,
        first_view=scene.first_view,
        provenance=metadata.Provenance(
            version=__version__,
            sh_degree=scene.sh_degree,
            count=count,
            source_count=scene.count + compacted + cleaned.removed,
            changed={name: number for name, number in changed.items() if number},
            settings={name: value for name, value in recorded.items() if value is not None},
        ),
        crc32={name: pixels_crc32(image) for name, image in images.items()},
    )
    files = {JSON_NAME: layout.to_meta_json(), **files}
    files = {YAML_NAME: layout.to_yaml(), SCENE_NAME: metadata.scene_json(files), **files}
    return Encoded.of(plan, files)


def render_planes(plan: EncodingPlan) -> dict[str, UInt8[np.ndarray, "H W C"]]:
    """Return the nine images of a plan, by file name."""
    fields, grid, codebook = plan.fields, plan.grid, plan.codebook
    means = fields["means"].levels
    labels = np.zeros((grid.side**2, 3), dtype=np.uint8)
    labels[:, 1], labels[:, 0] = np.divmod(codebook.labels[grid.cell_to_gaussian], codebook.side)
    rows = {
        "active_mask": grid.mask[:, None].astype(np.uint8),
        "means_bytes_0": (means & 255).astype(np.uint8),
        "means_bytes_1": (means >> 8).astype(np.uint8),
        **{name: fields[name].levels for name in ("opacities", "scales", "quaternions", "f_dc")},
        "f_rest_labels": labels,
    }
    images = {f"{name}.webp": levels.reshape(grid.side, grid.side, -1) for name, levels in rows.items()}
    return {**images, "f_rest_centroids.webp": _tiles(codebook)}


def _tiles(codebook: Codebook) -> UInt8[np.ndarray, "H W 3"]:
    """Return the codebook's image: one tile of S × S pixels per coefficient, three rows of five."""
    rows, columns = metadata.TILE_ROWS, metadata.TILE_COLUMNS
    levels = codebook.centroids.levels.reshape(codebook.side, codebook.side, 3, rows, columns)
    tiled = levels.transpose(3, 0, 4, 1, 2)
    return np.ascontiguousarray(tiled.reshape(rows * codebook.side, columns * codebook.side, 3))


def _ranges(fields: dict[str, Quantized]) -> dict[str, tuple[list[float], list[float]]]:
    """Return each field's range, in the fewest digits that identify its float32 numbers."""

    def digits(name: str, end: Float32[np.ndarray, " C"]) -> list[float]:
        return [float(str(value)) for value in end[: metadata.CHANNELS[name]]]

    ranges = {name: observed_range(field) for name, field in fields.items()}
    return {name: (digits(name, low), digits(name, high)) for name, (low, high) in ranges.items()}
