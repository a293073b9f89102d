"""The codec of the KISS-GS paper with one part left out: the bytes that result, and the scene that a decoder would get.

No decoder reads these files; they only measure what each part contributes. Where the levels of an attribute are left
out, its float32 values are stored instead, split into byte planes and deflated.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.context import Context, blas_workers
from kissgs.core.splats import Splats
from kissgs.io.containers import zip_bytes
from kissgs.io.images import compress_images
from kissgs.planning.planner import EncodingPlan, plan_encoding
from kissgs.planning.quantize import MEANS_TOP, quantize
from kissgs.planning.rotation_forms import apply_forms, pras_forms
from kissgs.planning.sh_codebook import PAPER_TOP
from kissgs.settings import EncodeSettings
from kissgs.sogxt.decode import decode
from kissgs.sogxt.encode import render_planes, write_files

Images = Mapping[str, UInt8[np.ndarray, "H W C"]]

METADATA = ("container_meta.yaml", "meta.json", "scene.json")
"""Files of a container that are not images."""


@dataclass(frozen=True, slots=True, eq=False)
class EncodedParts:
    """An encoded scene before its images are compressed, and its decoded version.

    The images are those before compression, by file name; ``exact`` are the Gaussians of the container in its order and
    rotation forms, not quantised, and ``decoded`` is the scene that a decoder would get.
    """

    settings: EncodeSettings
    splats: Splats
    plan: EncodingPlan
    images: Images
    other_files: Mapping[str, bytes]
    exact: Splats
    decoded: Splats

    def size(self) -> int:
        """Return the bytes of a zip of all files, with the images compressed."""
        with blas_workers(0) as pool:
            files = compress_images(self.images, self.settings, pool, lambda fraction: None)
        return len(zip_bytes({**files, **self.other_files}))

    def without(self, *names: str) -> dict[str, UInt8[np.ndarray, "H W C"]]:
        """Return all images except those of these names, which have no ``.webp``."""
        return {name: image for name, image in self.images.items() if name.removesuffix(".webp") not in names}


LeaveOut = Callable[[EncodedParts], EncodedParts]
"""Function that leaves a part out."""


def encode_parts(splats: Splats, settings: EncodeSettings) -> EncodedParts:
    """Encode a scene with uniform planning."""
    plan = plan_encoding(splats, settings, Context())
    files = write_files(plan, settings, Context()).files
    decoded = decode(files)
    exact = _in_forms_of(splats.select(plan.grid.cells[plan.grid.mask]), decoded)
    other_files = {name: files[name] for name in METADATA}
    return EncodedParts(settings, splats, plan, render_planes(plan), other_files, exact, decoded)


def as_floats(whole: EncodedParts, field: str, *images: str) -> EncodedParts:
    """Store the float32 values of an attribute instead of its levels in ``images``."""
    values = getattr(whole.exact, field)
    other_files = {**whole.other_files, field: deflated(values)}
    decoded = replace(whole.decoded, **{field: values})
    return replace(whole, images=whole.without(*images), other_files=other_files, decoded=decoded)


def codebook_levels(whole: EncodedParts) -> EncodedParts:
    """Store float32 values in the SH codebook instead of levels: means over the Gaussians of each entry."""
    book, count = whole.plan.codebook, len(whole.exact)
    rows = whole.exact.shN.reshape(count, -1)
    entries = np.zeros((book.side**2, rows.shape[1]))
    np.add.at(entries, book.labels[:count], rows)
    entries /= np.maximum(np.bincount(book.labels[:count], minlength=len(entries)), 1)[:, None]
    values = entries.astype(np.float32)
    decoded = replace(whole.decoded, shN=values[book.labels[:count]].reshape(whole.exact.shN.shape))
    other_files = {**whole.other_files, "shN": deflated(values)}
    return replace(whole, images=whole.without("f_rest_centroids"), other_files=other_files, decoded=decoded)


def sh_codebook(whole: EncodedParts) -> EncodedParts:
    """Store an image of 100 levels for each SH coefficient instead of labels and a codebook."""
    count, coefficients, _ = whole.exact.shN.shape
    levels = quantize(whole.exact.shN.reshape(count, 3 * coefficients), step=1, shared=False, max_top=PAPER_TOP)
    side = whole.plan.grid.side
    cells = np.zeros((side**2, coefficients, 3), np.uint8)
    cells[whole.plan.grid.mask] = levels.levels.reshape(count, coefficients, 3)
    images = {f"sh_{n}.webp": cells[:, n].reshape(side, side, 3) for n in range(coefficients)}
    decoded = replace(whole.decoded, shN=levels.values().astype(np.float32).reshape(count, coefficients, 3))
    return replace(whole, images={**whole.without("f_rest_centroids", "f_rest_labels"), **images}, decoded=decoded)


def webp(whole: EncodedParts) -> EncodedParts:
    """Store levels uncompressed, one byte each; labels take three, as the published figure has it."""
    levels = {name: image.tobytes() for name, image in whole.images.items()}
    return replace(whole, images={}, other_files={**whole.other_files, **levels})


def scene_order(whole: EncodedParts) -> EncodedParts:
    """Leave the Gaussians in the order of the scene, with the padding among them; PRAS finds their forms there."""
    grid = whole.plan.grid
    order = np.argsort(grid.cells, kind="stable")
    scene = whole.splats.select(grid.cells[order])
    quats = scene.quats.astype(np.float64)
    with blas_workers(0) as pool:
        forms = pras_forms(quats, scene.scales, grid.side, pool, decay=whole.settings.plas_radius_decay)
    quats, scales = apply_forms(quats, scene.scales, forms)
    place = np.argsort(order)  # render_planes has the grid's order
    parts = _with_forms(whole, quats[place], scales[place], whole.settings.quat_levels - 1)
    planes = {name: image for name, image in parts.images.items() if name != "f_rest_centroids.webp"}
    moved = {name: image.reshape(len(order), -1)[order].reshape(image.shape) for name, image in planes.items()}
    return replace(parts, images={**parts.images, **moved})


def codebook_order(whole: EncodedParts) -> EncodedParts:
    """Put the codebook's entries in random order."""
    book = whole.plan.codebook
    order = np.random.Generator(np.random.PCG64(whole.settings.seed)).permutation(book.side**2)
    position = np.argsort(order).astype(np.int32)
    shuffled = replace(book, centroids=book.centroids.take(order), labels=position[book.labels])
    return replace(whole, images=render_planes(replace(whole.plan, codebook=shuffled)))


def label_pairs(whole: EncodedParts) -> EncodedParts:
    """Store labels as the high and the low byte of one number, in two images, instead of as column and row."""
    book, grid = whole.plan.codebook, whole.plan.grid
    labels = book.labels[grid.cell_to_gaussian].reshape(grid.side, grid.side, 1)
    halves = {"labels_0.webp": (labels & 255).astype(np.uint8), "labels_1.webp": (labels >> 8).astype(np.uint8)}
    return replace(whole, images={**whole.without("f_rest_labels"), **halves})


def rotation_forms(whole: EncodedParts, top: int) -> EncodedParts:
    """Leave rotations and scales in the scene's own forms; ``top`` is the largest level of rotations."""
    scene = whole.splats.select(whole.plan.grid.cells)
    return _with_forms(whole, scene.quats, scene.scales, top)


def _with_forms(whole: EncodedParts, quats: np.ndarray, scales: np.ndarray, top: int) -> EncodedParts:
    """Return the parts with other rotations and scales, in the order of the grid."""
    levels = {
        "quaternions": quantize(quats, step=1, shared=False, max_top=top),
        "scales": quantize(scales, step=1, shared=False),
    }
    plan, kept = replace(whole.plan, fields={**whole.plan.fields, **levels}), whole.plan.grid.mask
    quats, scales = (each.values()[kept].astype(np.float32) for each in levels.values())
    return replace(whole, images=render_planes(plan), decoded=replace(whole.decoded, quats=quats, scales=scales))


def mask(whole: EncodedParts) -> EncodedParts:
    """Keep the most opaque Gaussians only, as many as fill a square without padding, so that no mask is needed."""
    side = max(int(len(whole.splats) ** 0.5) // 8 * 8, 8)
    keep = np.sort(np.argsort(-whole.splats.opacities, kind="stable")[: side**2])
    pruned = encode_parts(whole.splats.select(keep), whole.settings)
    return replace(pruned, images=pruned.without("active_mask"))


def signed_log(whole: EncodedParts) -> EncodedParts:
    """Quantise positions uniformly over the scene's extent, not their signed logarithm."""
    grid = whole.plan.grid
    means = whole.splats.means[grid.cells].astype(np.float64)
    low, extent = means.min(), max(np.ptp(means), 1e-30)
    levels = np.rint((means - low) / extent * MEANS_TOP)
    field = replace(whole.plan.fields["means"], levels=levels.astype(np.uint16))
    plan = replace(whole.plan, fields={**whole.plan.fields, "means": field})
    decoded = (low + levels[grid.mask] * (extent / MEANS_TOP)).astype(np.float32)
    return replace(whole, images=render_planes(plan), decoded=replace(whole.decoded, means=decoded))


def deflated(values: Float32[np.ndarray, "..."]) -> bytes:
    """Deflate float32 values split into byte planes: all first bytes, then all second bytes, and so on."""
    return zlib.compress(np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, 4).T.tobytes(), 6)


def _in_forms_of(splats: Splats, decoded: Splats) -> Splats:
    """Return the Gaussians in the equivalent rotation forms that are nearest to the decoded rotations."""
    quats = splats.quats.astype(np.float64)
    best, form = np.full(len(splats), -np.inf), np.zeros(len(splats), np.uint8)
    for number in range(48):
        every = np.full(len(splats), number, np.uint8)
        dots = (apply_forms(quats, splats.scales, every)[0] * decoded.quats).sum(axis=1)
        form[dots > best], best = number, np.maximum(best, dots)
    rotated, scales = apply_forms(quats, splats.scales, form)
    return replace(splats, quats=rotated.astype(np.float32), scales=scales)


PUBLISHED_BYTES = 3_877_944
"""Bytes of the paper's container of bicycle (256,000 Gaussians) with all parts."""

PARTS: dict[str, tuple[LeaveOut, int | None, float | None]] = {
    "nothing": (lambda whole: whole, None, None),
    "levels of the SH codebook": (codebook_levels, 4_042_523, 0.0097),
    "SH codebook": (sh_codebook, 3_434_816, 0.232),
    "WebP": (webp, 3_030_148, 0.0),
    "levels of rotations": (lambda whole: as_floats(whole, "quats", "quaternions"), 2_548_718, 0.032),
    "levels of base colours": (lambda whole: as_floats(whole, "sh0", "f_dc"), 2_084_291, 0.006),
    "levels of sizes": (lambda whole: as_floats(whole, "scales", "scales"), 1_966_415, 0.004),
    "levels of positions": (
        lambda whole: as_floats(whole, "means", "means_bytes_0", "means_bytes_1"),
        1_392_843,
        0.012,
    ),
    "order (PLAS)": (scene_order, 614_851, 0.0059),
    "levels of opacities": (lambda whole: as_floats(whole, "opacities", "opacities"), 609_117, 0.0006),
    "forms (PRAS), 256 levels": (lambda whole: rotation_forms(whole, 255), 161_748, 0.010),
    "order of the codebook": (codebook_order, 42_416, 0.0),
    "labels as column and row": (label_pairs, 12_142, 0.0),
    "mask: pruned to a square": (mask, 3_344, -0.115),
    "forms (PRAS), 100 levels": (lambda whole: rotation_forms(whole, 99), -11_810, -0.110),
    "logarithm of positions": (signed_log, -519_272, -7.55),
}
"""Function that leaves a part out, and the published growth in bytes and change of PSNR to photographs."""

OF_CODEBOOK = ("levels of the SH codebook", "SH codebook", "order of the codebook", "labels as column and row")
