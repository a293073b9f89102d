"""``Splats`` -> SOG-XT files, readable top to bottom: choose, order, quantise, compress."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32, Int, UInt8
from kissgs._version import __version__
from kissgs.errors import InvalidSceneError
from kissgs.parallel import blas_workers
from kissgs.progress import Progress, silent
from kissgs.settings import EncodeSettings
from kissgs.sogxt import metadata, names
from kissgs.sogxt.codebook import Codebook, fit_codebook
from kissgs.sogxt.order import Grid, place
from kissgs.sogxt.planes import compress_images, pixels_crc32
from kissgs.sogxt.pras import choose_forms
from kissgs.sogxt.quantize import Quantized, anchor, means_bits, quantize, quantize_means, tame
from kissgs.splats import NOTHING_CLEANED, SH_REST_COUNTS, Cleaned, Splats

OUTLIERS = 1e-4
"""Share of base colours, at either end of a channel, that may be pulled in to keep the others' step."""

INVISIBLE_LOGIT = -5.5373
"""Logit of opacity 1/255, rounded up: no renderer draws what is this faint or fainter."""


@dataclass(frozen=True, slots=True)
class Encoded:
    """A container in memory, and how it came about.

    Attributes:
        files: name -> bytes, in the order in which they are best stored.
        order: ``(M,)`` for every Gaussian of the container, in its order, the index in the scene that was encoded.
        form_error: largest relative change of a covariance by the choice of its equivalent form.
        dropped: number of Gaussians left out because they are invisible.
        tamed: number of Gaussians whose base colour, an outlier, was pulled in (:func:`kissgs.sogxt.quantize.tame`).
        half_steps: largest error that quantisation may cause, per field and channel, in the field's own unit
            (positions: of their signed logarithm; f_rest_centroids: of the codebook's entries).
    """

    files: dict[str, bytes]
    order: Int[np.ndarray, " M"]
    form_error: float
    dropped: int
    tamed: int
    half_steps: dict[str, list[float]]


def encode(
    splats: Splats,
    settings: EncodeSettings,
    *,
    importance: Float32[np.ndarray, " N"] | None = None,
    cleaned: Cleaned = NOTHING_CLEANED,
    threads: int = 0,
    progress: Progress = silent,
) -> Encoded:
    """Encode a clean scene (:func:`kissgs.splats.clean`).

    Args:
        splats: the scene.
        settings: see :class:`EncodeSettings`.
        importance: ``(N,)``, from 0: how much an error in the colour of each Gaussian counts when the SH codebook is
            built; by default from opacity and size.
        cleaned: what was mended before, for the metadata.
        threads: to use; 0 means one per processor. The bytes do not depend on it.
        progress: receives "kernels", "order", "forms", "codebook", "sort codebook" and "images" events.

    Raises:
        InvalidSceneError: ``importance`` does not fit the scene.
        UnsupportedError: the scene is too large for one container.
    """
    _check_importance(importance, len(splats))
    load_kernels(progress)
    ordering = _stage(progress, "order")
    kept = np.arange(len(splats))
    if settings.drop_invisible:
        kept = np.flatnonzero(splats.opacities > np.float32(INVISIBLE_LOGIT))
    bits = settings.means_bits or means_bits(splats, kept, settings.means_tolerance)
    with blas_workers(threads) as pool:
        grid = place(splats.means, kept, bits, settings, pool, ordering)
        # Padding repeats Gaussians of the scene; a scene without any lends it a neutral one.
        shown, cells = (splats, grid.cells) if len(kept) else (_neutral(splats.sh_degree), grid.cells * 0)
        sh0 = tame(shown.sh0, step=settings.sh0_step, share=OUTLIERS) if settings.shared_steps else shown.sh0
        quats, scales, form_error = choose_forms(shown, cells, grid.side, settings, pool, _stage(progress, "forms"))
        codebook = fit_codebook(shown, cells[grid.mask], importance, settings, pool, progress)
        fields = {
            "means": quantize_means(shown.means[cells], bits=bits),
            "opacities": _quantize(shown.opacities[cells, None], settings.opacity_step, settings),
            "scales": _quantize(scales, settings.scale_step, settings),
            "quaternions": _quantize(quats, settings.quat_step, settings, paper_top=99),
            "f_dc": _quantize(sh0[cells], settings.sh0_step, settings),
            "f_rest_centroids": codebook.centroids,
        }
        images = _draw(fields, grid, codebook)
        files = compress_images(images, settings, pool, _stage(progress, "images"))

    tamed = int((sh0 != shown.sh0).any(axis=1).sum())
    layout = metadata.Layout(
        grid_side=grid.side,
        codebook_side=codebook.side,
        count=len(kept),
        ranges=_ranges(fields),
        provenance=metadata.Provenance(
            version=__version__,
            sh_degree=splats.sh_degree,
            count=len(kept),
            source_count=len(splats) + cleaned.removed,
            changed={"invisible": len(splats) - len(kept), "tamed_colours": tamed, **cleaned.as_dict()},
            settings=settings.model_dump(),
            sha256={name: hashlib.sha256(data).hexdigest() for name, data in files.items()},
        ),
        crc32={name: pixels_crc32(image) for name, image in images.items()},
    )
    files = {names.JSON_NAME: layout.to_meta_json(), **files}
    return Encoded(
        files={names.YAML_NAME: layout.to_yaml(), names.SCENE_NAME: metadata.scene_json(files), **files},
        order=grid.cells[grid.mask],
        form_error=form_error,
        dropped=len(splats) - len(kept),
        tamed=tamed,
        half_steps={name: _half_steps(field, bits if name == "means" else 16) for name, field in fields.items()},
    )


def load_kernels(progress: Progress = silent) -> None:
    """Compile the encoder's kernels, or load them from numba's cache of earlier times."""
    progress("kernels", 0.0)
    from kissgs.sogxt import kernels  # noqa: F401

    progress("kernels", 1.0)


def _check_importance(importance: Float32[np.ndarray, " N"] | None, count: int) -> None:
    if importance is None:
        return
    if importance.shape != (count,) or not (np.isfinite(importance) & (importance >= 0)).all():
        raise InvalidSceneError(
            f"importance must be {count} finite numbers from 0, one per Gaussian; it has shape {importance.shape}"
        )


def _neutral(sh_degree: int) -> Splats:
    """One Gaussian, as plain as can be."""
    return Splats(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.zeros((1, 3), np.float32),
        opacities=np.zeros(1, np.float32),
        sh0=np.zeros((1, 3), np.float32),
        shN=np.zeros((1, SH_REST_COUNTS[sh_degree], 3), np.float32),
    )


def _quantize(values: np.ndarray, step: float, settings: EncodeSettings, *, paper_top: int = 255) -> Quantized:
    if settings.shared_steps:
        return quantize(values, step=step)
    return quantize(values, step=step, shared=False, max_top=paper_top)


def _draw(fields: dict[str, Quantized], grid: Grid, codebook: Codebook) -> dict[str, UInt8[np.ndarray, "H W C"]]:
    """The nine images, by file name."""
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


def _ranges(fields: dict[str, Quantized]) -> dict[str, tuple[list[float], list[float]]]:
    """What the metadata says of each field, in the fewest digits that still give the same float32."""

    def digits(name: str, end: Float32[np.ndarray, " C"]) -> list[float]:
        return [float(str(value)) for value in end[: metadata.CHANNELS[name]]]

    anchors = {name: anchor(field) for name, field in fields.items()}
    return {name: (digits(name, low), digits(name, high)) for name, (low, high) in anchors.items()}


def _half_steps(field: Quantized, bits: int) -> list[float]:
    spacing = 1 << (16 - bits)
    extent = field.high.astype(np.float64) - field.low
    return [float(step) for step in extent / field.top * spacing / 2]


def _stage(progress: Progress, name: str) -> Callable[[float], None]:
    progress(name, 0.0)
    return lambda fraction: progress(name, fraction)
