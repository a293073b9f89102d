"""``Splats``: a Gaussian scene in memory, its largest size, and its cleaning."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Bool, Float, Float32, Float64, Int
from kissgs.core.errors import InvalidSceneError

MAX_GRID_SIDE = 13_376  # pixels: Pillow refuses larger images as decompression bombs; WebP's limit is 16383
MAX_CODEBOOK_SIDE = 256  # largest side of the codebook's tiles, pixels: labels have two 8-bit coordinates
MAX_GAUSSIANS = 20_000_000  # by default: 5 GB of arrays, which a file of some kilobytes can declare
SH_REST_COUNTS = (0, 3, 8, 15)  # SH coefficients per channel beyond the constant one, for degree 0 to 3
SH_C0 = 0.28209479177387814  # value of the constant real spherical harmonic: colour = 0.5 + SH_C0 * sh0

OPACITY_LOGIT_MIN = float(np.float32(-13.815509796142578))
OPACITY_LOGIT_MAX = float(np.float32(13.80231761932373))
"""float32 logits of the opacities 1e-6 and 1 - 1e-6; beyond, no 8-bit image changes and float32 sigmoids fail."""

LOG_SCALE_LIMIT = 30.0
MEAN_LIMIT = 1e15
SH_LIMIT = 1e6  # bounds of absolute values that cleaning leaves unchanged; beyond, renderers' float32 squares overflow


ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh0", "shN")

BLOCK = 1 << 14  # rows of a block: its float64 values stay in the processor's cache
SAMPLED = 1 << 20  # largest number of rows of sampled_rows


def blocks(count: int, size: int = BLOCK) -> list[slice]:
    """Return slices that cover ``count`` rows, so that no temporary array is as large as the scene."""
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Splats:
    """Scene of N Gaussians: stored (pre-activation) parameters, as in a 3DGS ``.ply``.

    Attributes:
        means: ``(N, 3)`` float32, positions in world units.
        quats: ``(N, 4)`` float32, rotations as w, x, y, z; unit norm once cleaned.
        scales: ``(N, 3)`` float32, natural logarithm of the standard deviations in world units.
        opacities: ``(N,)`` float32, logits.
        sh0: ``(N, 3)`` float32, constant SH coefficient of R, G, B.
        shN: ``(N, K, 3)`` float32, the other SH coefficients, first band first; K is 0, 3, 8 or 15.
        antialiased: whether the scene was trained with opacities compensated for the dilation of footprints (Mip-
            Splatting's 2D filter), and has to be drawn so.
        origin: point of the world at which ``means`` is zero, world units: coordinates beyond float32 are near
            ``origin``.
        notes: what reading the scene's file left out or changed, one phrase each.

    Raises:
        InvalidSceneError: an array has a wrong dtype or shape.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    sh0: Float32[np.ndarray, "N 3"]
    shN: Float32[np.ndarray, "N K 3"]
    antialiased: bool = False
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = len(self.means) if self.means.ndim else -1
        k = self.shN.shape[1] if self.shN.ndim == 3 else -1
        if k not in SH_REST_COUNTS:
            shape = self.shN.shape
            raise InvalidSceneError(f"shN has shape {shape}; it must be (N, K, 3) with K one of {SH_REST_COUNTS}")
        shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 3), (n, k, 3))
        for name, shape in zip(ATTRIBUTES, shapes, strict=True):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != np.float32:
                found = f"{array.dtype} of shape {array.shape}"
                raise InvalidSceneError(f"{name} is {found}; it must be float32 of shape {shape}")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """SH degree of the scene, 0 to 3."""
        return SH_REST_COUNTS.index(self.shN.shape[1])

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(getattr(self, name).nbytes for name in ATTRIBUTES)

    def select(self, index: Int[np.ndarray, " M"] | Bool[np.ndarray, " N"] | slice) -> Splats:
        """Return the Gaussians at ``index`` (indices, a boolean mask or a slice), in that order."""
        return replace(self, **{name: getattr(self, name)[index] for name in ATTRIBUTES})


def concatenate(scenes: Sequence[Splats]) -> Splats:
    """Return one scene with the Gaussians of all scenes, at least one, in their order. All else, such as their SH
    degrees and origins, is equal."""
    arrays: dict[str, Any] = {name: np.concatenate([getattr(each, name) for each in scenes]) for name in ATTRIBUTES}
    return replace(scenes[0], **arrays)


def sampled_rows(blocks: Iterable[Float[np.ndarray, "n C"]], count: int) -> Float[np.ndarray, "S C"]:
    """Return every k-th of ``count`` rows that come in blocks, at most :data:`SAMPLED`; no blocks give no rows."""
    stride, first, found = max(1, -(-count // SAMPLED)), 0, []
    for block in blocks:
        found.append(block[first::stride].copy())
        first = (first - len(block)) % stride
    return np.concatenate(found) if found else np.empty((0, 4), np.float32)


def empty_splats(count: int, coefficients: int) -> Splats:
    """Return a scene whose arrays are to be filled, with K ``coefficients`` in ``shN``. These are zero, so that a part
    of lower SH degree fills only its own."""
    return Splats(
        means=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        scales=np.empty((count, 3), np.float32),
        opacities=np.empty(count, np.float32),
        sh0=np.empty((count, 3), np.float32),
        shN=np.zeros((count, coefficients, 3), np.float32),
    )


CLEANED_TEXTS = {
    "non_finite": "removed: a value is NaN or infinite",
    "far_away": "removed: a coordinate is beyond 1e15",
    "infinite_opacities": "with an infinite opacity logit: set to that of opacity 1e-6 or 1 - 1e-6",
    "saturated_opacities": "with an opacity logit beyond that of 1e-6 or 1 - 1e-6: clamped",
    "zero_quats": "with a rotation of length zero: set to the identity",
    "unnormalised_quats": "with a rotation that is no unit quaternion: normalised",
    "clamped_scales": "with a log-scale beyond 30: clamped",
    "clamped_sh": "with an SH coefficient beyond 1e6: clamped",
}
"""Words that follow the number of Gaussians in a sentence, by field of :class:`Cleaned`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Cleaned:
    """Number of Gaussians that :func:`clean` changed, by reason (:data:`CLEANED_TEXTS`)."""

    non_finite: int = 0  # NaN anywhere, or an infinite position, rotation or colour
    far_away: int = 0
    infinite_opacities: int = 0
    saturated_opacities: int = 0  # no 8-bit image changes
    zero_quats: int = 0
    unnormalised_quats: int = 0  # by more than 1e-3
    clamped_scales: int = 0  # also ±inf, the logarithm of 0
    clamped_sh: int = 0

    @property
    def removed(self) -> int:
        """Number of Gaussians that were removed."""
        return self.non_finite + self.far_away

    @property
    def notes(self) -> tuple[str, ...]:
        """One phrase for each kind of change that images can show: renderers draw the others alike."""
        invisible = ("infinite_opacities", "saturated_opacities", "unnormalised_quats")
        counts = {name: count for name, count in self.as_dict().items() if count and name not in invisible}
        return tuple(f"{count:,} Gaussian{'s' * (count > 1)} {CLEANED_TEXTS[name]}" for name, count in counts.items())

    def as_dict(self) -> dict[str, int]:
        """Return all counts by name."""
        return asdict(self)


NOTHING_CLEANED = Cleaned()


def clean(splats: Splats) -> tuple[Splats, Cleaned]:
    """Make a scene finite and bounded, with rotations of unit length.

    A clean scene is returned unchanged. The input is not modified; arrays that need no change are shared.

    Returns:
        The scene, with its Gaussians in their order, and the number of changes.
    """
    keep, non_finite = np.empty(len(splats), bool), 0
    for rows in blocks(len(splats)):
        finite = _finite_rows(splats.select(rows))
        with np.errstate(invalid="ignore"):  # NaN
            keep[rows] = finite & (np.abs(splats.means[rows]) <= MEAN_LIMIT).all(axis=1)
        non_finite += int((~finite).sum())
    removed = len(keep) - int(keep.sum())
    if removed:
        splats = splats.select(keep)

    quats, zero, unnormalised = _unit_quats(splats.quats)
    opacities = splats.opacities
    if opacities.size and (opacities.min() < OPACITY_LOGIT_MIN or opacities.max() > OPACITY_LOGIT_MAX):
        opacities = np.clip(opacities, np.float32(OPACITY_LOGIT_MIN), np.float32(OPACITY_LOGIT_MAX))
    infinite = np.isinf(splats.opacities)
    scales, clamped_scales = _clamp(splats.scales, LOG_SCALE_LIMIT)
    sh0, clamped_sh0 = _clamp(splats.sh0, SH_LIMIT)
    shN, clamped_shN = _clamp(splats.shN, SH_LIMIT)
    report = Cleaned(
        non_finite=non_finite,
        far_away=removed - non_finite,
        infinite_opacities=int(infinite.sum()),
        saturated_opacities=int(((opacities != splats.opacities) & ~infinite).sum()),
        zero_quats=zero,
        unnormalised_quats=unnormalised,
        clamped_scales=int(clamped_scales.sum()),
        clamped_sh=int((clamped_sh0 | clamped_shN).sum()),
    )
    cleaned = replace(splats, quats=quats, scales=scales, opacities=opacities, sh0=sh0, shN=shN)
    return cleaned, report


def _finite_rows(splats: Splats) -> Bool[np.ndarray, " N"]:
    n = len(splats)
    rows = np.isfinite(splats.means).all(axis=1) & np.isfinite(splats.quats).all(axis=1)
    rows &= ~np.isnan(splats.scales).any(axis=1) & ~np.isnan(splats.opacities)
    # A sum is finite exactly when no term is NaN or infinite (float64 cannot overflow here): no (N, K, 3) temporary.
    with np.errstate(invalid="ignore"):  # inf - inf
        for sh in (splats.sh0, splats.shN.reshape(n, splats.shN.shape[1] * 3)):
            rows &= np.isfinite(sh.sum(axis=1, dtype=np.float64))
    return rows


def _unit_quats(quats: Float32[np.ndarray, "N 4"]) -> tuple[Float32[np.ndarray, "N 4"], int, int]:
    """Return unit quaternions (the given array if nothing changes), and how many were zero and not of unit length."""
    zeros = unnormalised = 0
    changed = False
    for rows in blocks(len(quats)):
        norm = _lengths(quats[rows])
        zeros += int((norm == 0).sum())
        unnormalised += int(((norm != 0) & (np.abs(norm - 1) > 1e-3)).sum())
        changed |= bool((np.abs(norm - 1) > 1e-6).any())
    if not changed:
        return quats, 0, 0
    unit = np.empty_like(quats)
    for rows in blocks(len(quats)):
        norm = _lengths(quats[rows])
        unit[rows] = quats[rows].astype(np.float64) / np.where(norm == 0, 1, norm)[:, None]
        unit[rows][norm == 0] = (1, 0, 0, 0)
    return unit, zeros, unnormalised


def _lengths(quats: Float32[np.ndarray, "N 4"]) -> Float64[np.ndarray, " N"]:
    wide = quats.astype(np.float64)  # float32 squares underflow at 1e-23 and overflow at 1e19
    return np.sqrt(np.einsum("nc,nc->n", wide, wide))


def _clamp(values: np.ndarray, limit: float) -> tuple[np.ndarray, Bool[np.ndarray, " N"]]:
    """Return ``values`` clamped to ±limit (the given array if nothing changes), and which rows were changed."""
    if values.size == 0 or (values.max() <= limit and values.min() >= -limit):
        return values, np.zeros(len(values), dtype=bool)
    rows = (np.abs(values) > limit).reshape(len(values), -1).any(axis=1)
    return np.clip(values, np.float32(-limit), np.float32(limit)), rows
