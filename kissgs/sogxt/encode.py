"""``Splats`` -> SOG-XT files, readable top to bottom: choose order and levels, draw them as images, compress."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32, Int, UInt8
from kissgs._version import __version__
from kissgs.importance import Importance
from kissgs.parallel import blas_workers
from kissgs.progress import Progress, silent
from kissgs.settings import EncodeSettings
from kissgs.settings.encode import GOALS
from kissgs.sogxt import metadata, names
from kissgs.sogxt.choice import Choice
from kissgs.sogxt.even import choose_evenly
from kissgs.sogxt.planes import compress_images, pixels_crc32
from kissgs.sogxt.quantize import Quantized, anchor
from kissgs.sogxt.weighed import Recolor, weigh
from kissgs.splats import NOTHING_CLEANED, Cleaned, Splats

INVISIBLE_LOGIT = -5.5373
"""Logit of opacity 1/255, rounded up: no renderer draws what is this faint or fainter."""


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and how it came about.

    Attributes:
        files: name -> bytes, in the order in which they are best stored.
        order: ``(M,)`` for every Gaussian of the container, in its order, the index in the scene that was encoded.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        invisible: number of Gaussians left out because no renderer draws them.
        negligible: number of Gaussians left out because their bytes cost more than they show.
        tamed: number of Gaussians whose base colour, an outlier, was pulled in (:func:`kissgs.sogxt.quantize.tame`).
        errors: largest error of quantisation, per field and channel, see :class:`kissgs.sogxt.choice.Choice`.
        price: of a bit, squared error; None where bits were not weighed.
        codebook_side: of its image.
        note: a sentence for people about Gaussians that were left out, if these are many; or empty.
    """

    files: dict[str, bytes]
    order: Int[np.ndarray, " M"]
    form_error: float
    invisible: int
    negligible: int
    tamed: int
    errors: dict[str, list[float]]
    price: float | None
    codebook_side: int
    note: str = ""


def encode(
    splats: Splats,
    settings: EncodeSettings,
    *,
    importance: Importance | None = None,
    recolor: Recolor | None = None,
    cleaned: Cleaned = NOTHING_CLEANED,
    compacted: int = 0,
    threads: int = 0,
    progress: Progress = silent,
) -> Encoded:
    """Encode a clean scene (:func:`kissgs.splats.clean`): :func:`choose`, then :func:`write`.

    Args:
        splats: the scene.
        settings: see :class:`EncodeSettings`.
        importance: see :func:`choose`.
        recolor: see the same.
        cleaned: see :func:`write`.
        compacted: see the same.
        threads: to use; 0 means one per processor. The bytes do not depend on it.
        progress: receives "kernels", "price", "order", "forms", "codebook", "sort codebook", "rounding" and "images".

    Raises:
        InvalidSceneError: ``importance`` does not fit the scene.
        UnsupportedError: the scene is too large for one container.
    """
    choice = choose(splats, settings, importance=importance, recolor=recolor, threads=threads, progress=progress)
    return write(*(choice, splats, settings), cleaned=cleaned, compacted=compacted, threads=threads, progress=progress)


def choose(
    splats: Splats,
    settings: EncodeSettings,
    *,
    importance: Importance | None = None,
    recolor: Recolor | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> Choice:
    """Choose order, forms, codebook and levels for a clean scene.

    Args:
        splats: the scene.
        settings: see :class:`EncodeSettings`.
        importance: what changes of the scene cost in pictures. With it all choices are weighed under one price of a
            bit; without it, or where nothing was seen, steps are those of the settings.
        recolor: where choices are weighed: given the Gaussians as a decoder will find them, and their indices in the
            scene, returns better ``sh0``.
        threads: to use; 0 means one per processor.
        progress: receives all stages of :func:`encode` but the last.

    Raises:
        InvalidSceneError: ``importance`` does not fit the scene.
        UnsupportedError: the scene is too large for one container.
    """
    if importance is not None:
        importance.check(splats)
    load_kernels(progress)
    kept = _candidates(splats, settings)
    with blas_workers(threads) as pool:
        if importance is not None and (importance.colors[kept] > 0).any():
            return weigh(splats, kept, importance, recolor, settings, pool, progress)
        return choose_evenly(splats, kept, settings, pool, progress)


def _candidates(splats: Splats, settings: EncodeSettings) -> Int[np.ndarray, " K"]:
    """Those that any renderer draws."""
    if not settings.drop_invisible:
        return np.arange(len(splats))
    return np.flatnonzero(splats.opacities > np.float32(INVISIBLE_LOGIT))


def write(
    choice: Choice,
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
        choice: of :func:`choose`, or better.
        splats: the scene for which it was made.
        settings: with which.
        cleaned: what was mended before, for the metadata.
        compacted: by how many Gaussians compaction has made the scene smaller before, for the metadata.
        finetune_steps: by which the choice became better, for the metadata.
        threads: to use; 0 means one per processor. The bytes do not depend on it.
        progress: receives "images".
    """
    images = draw(choice)
    with blas_workers(threads) as pool:
        files = compress_images(images, settings, pool, _stage(progress, "images"))
    kept, count = len(_candidates(splats, settings)), int(choice.grid.mask.sum())
    unsaid = {*GOALS, "attempts"} | ({"sh_entries"} if settings.sh_entries == metadata.MAX_CODEBOOK_SIDE**2 else set())
    made = {**settings.model_dump(exclude=unsaid), "price": choice.price}
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
                "negligible": kept - count,
                "tamed_colours": choice.tamed,
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
        negligible=kept - count,
        tamed=choice.tamed,
        errors=choice.errors,
        price=choice.price,
        codebook_side=choice.codebook.side,
        note=choice.note,
    )


def draw(choice: Choice) -> dict[str, UInt8[np.ndarray, "H W C"]]:
    """The nine images, by file name."""
    fields, grid, codebook = choice.fields, choice.grid, choice.codebook
    means = fields["means"].levels
    labels = np.zeros((grid.side**2, 3), dtype=np.uint8)
    labels[:, 1], labels[:, 0] = np.divmod(codebook.labels[grid.rows], codebook.side)
    rows = {
        "active_mask": grid.mask[:, None].astype(np.uint8),
        "means_bytes_0": (means & 255).astype(np.uint8),
        "means_bytes_1": (means >> 8).astype(np.uint8),
        **{name: fields[name].levels for name in ("opacities", "scales", "quaternions", "f_dc")},
        "f_rest_labels": labels,
    }
    images = {f"{name}.webp": levels.reshape(grid.side, grid.side, -1) for name, levels in rows.items()}
    return {**images, "f_rest_centroids.webp": codebook.tiles()}


def load_kernels(progress: Progress = silent) -> None:
    """Compile the encoder's kernels, or load them from numba's cache of earlier times."""
    progress("kernels", 0.0)
    from kissgs.sogxt import kernels  # noqa: F401

    progress("kernels", 1.0)


def _ranges(fields: dict[str, Quantized]) -> dict[str, tuple[list[float], list[float]]]:
    """What the metadata says of each field, in the fewest digits that still give the same float32."""

    def digits(name: str, end: Float32[np.ndarray, " C"]) -> list[float]:
        return [float(str(value)) for value in end[: metadata.CHANNELS[name]]]

    anchors = {name: anchor(field) for name, field in fields.items()}
    return {name: (digits(name, low), digits(name, high)) for name, (low, high) in anchors.items()}


def _stage(progress: Progress, name: str) -> Callable[[float], None]:
    progress(name, 0.0)
    return lambda fraction: progress(name, fraction)
