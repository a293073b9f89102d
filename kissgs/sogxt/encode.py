"""``Splats`` -> SOG-XT files, readable top to bottom: choose order and levels, draw them as images, compress."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs._version import __version__
from kissgs.core.array_types import Float32, Int, UInt8
from kissgs.core.limits import MAX_CODEBOOK_SIDE
from kissgs.core.progress import Progress, silent
from kissgs.core.sensitivity import Sensitivity
from kissgs.core.splats import NOTHING_CLEANED, Cleaned, Splats
from kissgs.core.threads import blas_workers
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.planner import plan_encoding, visible_gaussians
from kissgs.planning.quantize import Quantized, observed_range
from kissgs.planning.rate_distortion import ColorRefit
from kissgs.planning.sh_codebook import Codebook
from kissgs.settings import EncodeSettings
from kissgs.settings.encode import GOALS
from kissgs.sogxt import metadata, names
from kissgs.sogxt.planes import compress_images, pixels_crc32


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and how it came about.

    Attributes:
        files: name -> bytes, in the order in which they are best stored.
        order: ``(M,)`` for every Gaussian of the container, in its order, the index in the scene that was encoded.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        invisible: number of Gaussians left out because no renderer draws them.
        pruned_by_rd: number of Gaussians left out because their bytes cost more than they show.
        clipped_colors: number of Gaussians with a clipped base colour (:func:`kissgs.planning.quantize.clip_outliers`).
        errors: largest quantisation error by field and channel (:class:`kissgs.planning.encoding_plan.EncodingPlan`).
        rd_lambda: of a bit, squared error; None where bits were not weighed.
        codebook_side: of its image.
        note: a sentence for people about Gaussians that were left out, if these are many; or empty.
    """

    files: dict[str, bytes]
    order: Int[np.ndarray, " M"]
    form_error: float
    invisible: int
    pruned_by_rd: int
    clipped_colors: int
    errors: dict[str, list[float]]
    rd_lambda: float | None
    codebook_side: int
    note: str = ""


def encode(
    splats: Splats,
    settings: EncodeSettings,
    *,
    sensitivity: Sensitivity | None = None,
    recolor: ColorRefit | None = None,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    threads: int = 0,
    progress: Progress = silent,
) -> Encoded:
    """Encode a clean scene: :func:`kissgs.planning.planner.plan_encoding`, then :func:`write_files`.

    Args:
        splats: the scene.
        settings: see :class:`EncodeSettings`.
        sensitivity: see :func:`~kissgs.planning.planner.plan_encoding`.
        recolor: see the same.
        cleaned: see :func:`write_files`.
        compacted: see the same.
        threads: to use; 0 means one per processor. The bytes do not depend on it.
        progress: receives "kernels", "rate_distortion", "order", "forms", "codebook", "sort codebook", "rounding" and
            "images".

    Raises:
        InvalidSceneError: ``sensitivity`` does not fit the scene.
        UnsupportedError: the scene is too large for one container.
    """
    choice = plan_encoding(
        splats, settings, sensitivity=sensitivity, recolor=recolor, threads=threads, progress=progress
    )
    return write_files(
        *(choice, splats, settings), cleaned=cleaned, compacted=compacted, threads=threads, progress=progress
    )


def write_files(
    choice: EncodingPlan,
    splats: Splats,
    settings: EncodeSettings,
    *,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    finetune_steps: int = 0,
    threads: int = 0,
    progress: Progress = silent,
) -> Encoded:
    """Make the files that show a choice.

    Args:
        choice: of :func:`~kissgs.planning.planner.plan_encoding`, or better.
        splats: the scene for which it was made.
        settings: with which.
        cleaned: what was mended before, for the metadata.
        compacted: by how many Gaussians compaction has made the scene smaller before, for the metadata.
        finetune_steps: by which the choice became better, for the metadata.
        threads: to use; 0 means one per processor. The bytes do not depend on it.
        progress: receives "images".
    """
    images = render_planes(choice)
    with blas_workers(threads) as pool:
        files = compress_images(images, settings, pool, _stage(progress, "images"))
    kept, count = len(visible_gaussians(splats, settings)), int(choice.grid.mask.sum())
    unsaid = {*GOALS, "max_encodes"} | (
        {"sh_codebook_size"} if settings.sh_codebook_size == MAX_CODEBOOK_SIDE**2 else set()
    )
    made = {**settings.model_dump(exclude=unsaid), "rd_lambda": choice.rd_lambda}
    layout = metadata.Layout(
        grid_side=choice.grid.side,
        codebook_side=choice.codebook.side,
        count=count,
        ranges=_ranges(choice.fields),
        provenance=metadata.Provenance(
            version=__version__,
            sh_degree=splats.sh_degree,
            count=count,
            source_count=len(splats) + compacted + cleaned.removed,
            changed={
                "invisible": len(splats) - kept,
                "pruned_by_rd": kept - count,
                "clipped_colors": choice.clipped_colors,
                **({"compacted": compacted} if compacted else {}),
                **cleaned.as_dict(),
            },
            settings={**made, **({"finetune_steps": finetune_steps} if finetune_steps else {})},
            sha256={name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
        ),
        crc32={name: pixels_crc32(image) for name, image in images.items()},
    )
    files = {names.JSON_NAME: layout.to_meta_json(), **files}
    return Encoded(
        files={names.YAML_NAME: layout.to_yaml(), names.SCENE_NAME: metadata.scene_json(files), **files},
        order=choice.grid.cells[choice.grid.mask],
        form_error=choice.form_error,
        invisible=len(splats) - kept,
        pruned_by_rd=kept - count,
        clipped_colors=choice.clipped_colors,
        errors=choice.errors,
        rd_lambda=choice.rd_lambda,
        codebook_side=choice.codebook.side,
        note=choice.note,
    )


def render_planes(choice: EncodingPlan) -> dict[str, UInt8[np.ndarray, "H W C"]]:
    """The nine images, by file name."""
    fields, grid, codebook = choice.fields, choice.grid, choice.codebook
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
    """The codebook's image: one tile of S × S pixels per coefficient, three rows of five."""
    rows, columns = metadata.TILE_ROWS, metadata.TILE_COLUMNS
    levels = codebook.centroids.levels.reshape(codebook.side, codebook.side, 3, rows, columns)
    tiled = levels.transpose(3, 0, 4, 1, 2)
    return np.ascontiguousarray(tiled.reshape(rows * codebook.side, columns * codebook.side, 3))


def _ranges(fields: dict[str, Quantized]) -> dict[str, tuple[list[float], list[float]]]:
    """What the metadata says of each field, in the fewest digits that still give the same float32."""

    def digits(name: str, end: Float32[np.ndarray, " C"]) -> list[float]:
        return [float(str(value)) for value in end[: metadata.CHANNELS[name]]]

    anchors = {name: observed_range(field) for name, field in fields.items()}
    return {name: (digits(name, low), digits(name, high)) for name, (low, high) in anchors.items()}


def _stage(progress: Progress, name: str) -> Callable[[float], None]:
    progress(name, 0.0)
    return lambda fraction: progress(name, fraction)
