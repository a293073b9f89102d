"""KISS-GS' codec with one of its parts left out: what the bytes would be, and what a decoder would then find.

No container has these forms; they say what each part is worth. Where levels are left out, float32 numbers stand in
their place, byte by byte and deflated.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float32, UInt8
from kissgs.core.splats import Splats
from kissgs.core.threads import blas_workers
from kissgs.planning.encoding_plan import EncodingPlan
from kissgs.planning.planner import plan_encoding
from kissgs.planning.quantize import MEANS_TOP, quantize
from kissgs.planning.rotation_forms import apply_forms
from kissgs.planning.sh_codebook import PAPER_TOP
from kissgs.settings import EncodeSettings
from kissgs.sogxt.container import zip_bytes
from kissgs.sogxt.decode import decode
from kissgs.sogxt.encode import render_planes, write_files
from kissgs.sogxt.planes import compress_images

Images = Mapping[str, UInt8[np.ndarray, "H W C"]]

STORED = ("container_meta.yaml", "meta.json", "scene.json")


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """A scene in parts.

    Attributes:
        splats: the scene that was encoded.
        choice: what was chosen for it.
        images: that WebP compresses, by file name.
        stored: what is no image, by name.
        exact: what is in the container, in the order of the grid and in the forms that were chosen, as it was.
        decoded: what a decoder finds.
    """

    splats: Splats
    choice: EncodingPlan
    images: Images
    stored: Mapping[str, bytes]
    exact: Splats
    decoded: Splats

    def size(self, settings: EncodeSettings, threads: int) -> int:
        """Bytes of a zip of all parts, compressed."""
        with blas_workers(threads) as pool:
            files = compress_images(self.images, settings, pool, lambda fraction: None)
        return len(zip_bytes({**files, **self.stored}))

    def without(self, *names: str) -> dict[str, UInt8[np.ndarray, "H W C"]]:
        """All images but these."""
        return {name: image for name, image in self.images.items() if name.removesuffix(".webp") not in names}


LeaveOut = Callable[[Coded, EncodeSettings, int], Coded]


def coded(splats: Splats, settings: EncodeSettings, threads: int) -> Coded:
    """As settings that weigh nothing have it."""
    choice = plan_encoding(splats, settings, threads=threads)
    files = write_files(choice, splats, settings, threads=threads).files
    decoded = decode(files, threads=threads)
    exact = _in_forms_of(splats.select(choice.grid.cells[choice.grid.mask]), decoded)
    stored = {name: files[name] for name in STORED}
    return Coded(splats, choice, render_planes(choice), stored, exact, decoded)


def as_floats(field: str, *images: str) -> LeaveOut:
    """Numbers instead of the levels of one attribute, and of the images that hold them."""

    def leave_out(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
        values = getattr(whole.exact, field)
        return replace(
            whole,
            images=whole.without(*images),
            stored={**whole.stored, field: deflated(values)},
            decoded=replace(whole.decoded, **{field: values}),
        )

    return leave_out


def codebook_levels(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Numbers instead of levels in the SH codebook: means of those Gaussians that have the entry."""
    book, count = whole.choice.codebook, len(whole.exact)
    rows = whole.exact.shN.reshape(count, -1)
    entries = np.zeros((book.side**2, rows.shape[1]))
    np.add.at(entries, book.labels[:count], rows)
    entries /= np.maximum(np.bincount(book.labels[:count], minlength=len(entries)), 1)[:, None]
    numbers = entries.astype(np.float32)
    return replace(
        whole,
        images=whole.without("f_rest_centroids"),
        stored={**whole.stored, "shN": deflated(numbers)},
        decoded=replace(whole.decoded, shN=numbers[book.labels[:count]].reshape(whole.exact.shN.shape)),
    )


def sh_codebook(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """An image of 100 levels for every SH coefficient, and no codebook."""
    count, coefficients, _ = whole.exact.shN.shape
    levels = quantize(whole.exact.shN.reshape(count, 3 * coefficients), step=1, shared=False, max_top=PAPER_TOP)
    side = whole.choice.grid.side
    cells = np.zeros((side**2, coefficients, 3), np.uint8)
    cells[whole.choice.grid.mask] = levels.levels.reshape(count, coefficients, 3)
    images = {f"sh_{n}.webp": cells[:, n].reshape(side, side, 3) for n in range(coefficients)}
    decoded = replace(whole.decoded, shN=levels.values().astype(np.float32).reshape(count, coefficients, 3))
    return replace(whole, images={**whole.without("f_rest_centroids", "f_rest_labels"), **images}, decoded=decoded)


def webp(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Levels as they are, a byte each; labels are two of the three that their image has."""
    images = {**whole.images, "f_rest_labels.webp": whole.images["f_rest_labels.webp"][:, :, :2]}
    return replace(whole, images={}, stored={**whole.stored, **{n: i.tobytes() for n, i in images.items()}})


def scene_order(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Gaussians in the order in which the scene has them, padding between them."""
    order = np.argsort(whole.choice.grid.cells, kind="stable")
    planes = {name: image for name, image in whole.images.items() if name != "f_rest_centroids.webp"}
    moved = {name: image.reshape(len(order), -1)[order].reshape(image.shape) for name, image in planes.items()}
    return replace(whole, images={**whole.images, **moved})


def codebook_order(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Entries of the codebook in random order."""
    book = whole.choice.codebook
    order = np.random.Generator(np.random.PCG64(settings.seed)).permutation(book.side**2)
    place = np.argsort(order).astype(np.int32)
    shuffled = replace(book, centroids=book.centroids.take(order), labels=place[book.labels])
    return replace(whole, images=render_planes(replace(whole.choice, codebook=shuffled)))


def label_pairs(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Labels as one number in two images, its high and its low byte, instead of as column and row."""
    book, grid = whole.choice.codebook, whole.choice.grid
    labels = book.labels[grid.cell_to_gaussian].reshape(grid.side, grid.side, 1)
    halves = {"labels_0.webp": (labels & 255).astype(np.uint8), "labels_1.webp": (labels >> 8).astype(np.uint8)}
    return replace(whole, images={**whole.without("f_rest_labels"), **halves})


def forms(top: int) -> LeaveOut:
    """Rotations and sizes in the forms that the scene has; so many levels of rotations above the lowest."""

    def leave_out(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
        grid = whole.choice.grid
        scene = whole.splats.select(grid.cells)
        levels = {
            "quaternions": quantize(scene.quats, step=1, shared=False, max_top=top),
            "scales": quantize(scene.scales, step=1, shared=False),
        }
        choice = replace(whole.choice, fields={**whole.choice.fields, **levels})
        quats, scales = (levels[name].values()[grid.mask].astype(np.float32) for name in ("quaternions", "scales"))
        return replace(whole, images=render_planes(choice), decoded=replace(whole.decoded, quats=quats, scales=scales))

    return leave_out


def mask(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Only as many Gaussians as fill a square without padding, the most opaque."""
    side = max(int(len(whole.splats) ** 0.5) // 8 * 8, 8)
    keep = np.sort(np.argsort(-whole.splats.opacities, kind="stable")[: side**2])
    pruned = coded(whole.splats.select(keep), settings, threads)
    return replace(pruned, images=pruned.without("active_mask"))


def signed_log(whole: Coded, settings: EncodeSettings, threads: int) -> Coded:
    """Levels of positions evenly over the scene's extent."""
    grid = whole.choice.grid
    means = whole.splats.means[grid.cells].astype(np.float64)
    low, extent = means.min(), max(np.ptp(means), 1e-30)
    levels = np.rint((means - low) / extent * MEANS_TOP)
    choice = replace(
        whole.choice,
        fields={**whole.choice.fields, "means": replace(whole.choice.fields["means"], levels=levels.astype(np.uint16))},
    )
    decoded = (low + levels[grid.mask] * (extent / MEANS_TOP)).astype(np.float32)
    return replace(whole, images=render_planes(choice), decoded=replace(whole.decoded, means=decoded))


def deflated(values: Float32[np.ndarray, "..."]) -> bytes:
    """All first bytes of the numbers, then all second ones, and so on: what is alike lies together."""
    return zlib.compress(np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, 4).T.tobytes(), 6)


def _in_forms_of(splats: Splats, decoded: Splats) -> Splats:
    """The same Gaussians in the equivalent forms that lie nearest to those decoded."""
    quats = splats.quats.astype(np.float64)
    best, form = np.full(len(splats), -np.inf), np.zeros(len(splats), np.uint8)
    for number in range(48):
        every = np.full(len(splats), number, np.uint8)
        likeness = (apply_forms(quats, splats.scales, every)[0] * decoded.quats).sum(axis=1)
        form[likeness > best], best = number, np.maximum(best, likeness)
    turned, scales = apply_forms(quats, splats.scales, form)
    return replace(splats, quats=turned.astype(np.float32), scales=scales)
