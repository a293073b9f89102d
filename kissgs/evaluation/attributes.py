"""Errors of a scene's stored values, per attribute."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from itertools import permutations, product
from typing import Any

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64
from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats

CHUNK = 65_536
"""Gaussians per chunk: bounds the float64 temporaries to some tens of MB for any scene."""

AXIS_ROTATIONS = np.array(
    [
        axes
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(axes := np.eye(3)[:, order] * signs) > 0
    ]
)
"""``(24, 3, 3)`` the rotations that map the coordinate axes to each other (octahedral group)."""

AXIS_PERMUTATIONS = np.abs(AXIS_ROTATIONS).argmax(axis=1)
"""``(24, 3)`` the old axis that each new one is. R diag(s²) Rᵀ is invariant under R → R M, s → s[permutation]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorStats:
    """Root mean square and maximum of an error over all components of all Gaussians; 0 for an empty scene."""

    rmse: float
    max: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ShErrors:
    """Errors of the SH coefficients of one or more bands, without band 0."""

    rmse: float
    signal: float
    """root mean square of the reference's coefficients"""
    energy_kept: float | None
    """1 - (rmse / signal)²: 1 is lossless, 0 no better than zeros; None if the reference is all zeros"""


@dataclass(frozen=True, slots=True, kw_only=True)
class AttributeErrors:
    """Errors of a candidate's stored values; see :func:`attribute_errors`."""

    gaussians: int
    means: ErrorStats
    """world units, per coordinate"""
    means_relative: ErrorStats
    """|x' - x| / (1 + |x|), per coordinate: uniform for an encoding of logarithms"""
    rotation_degrees: ErrorStats
    """angle between the rotations"""
    scales: ErrorStats
    """natural logarithm, per axis: 0.01 is 1 % of the size"""
    covariance_relative_median: float
    covariance_relative_max: float
    """‖Σ' - Σ‖ / ‖Σ‖, Frobenius norms: joint effect of the rotation and scale errors"""
    opacity_logits: ErrorStats
    opacities: ErrorStats
    """activated, 0 to 1"""
    sh0: ErrorStats
    """coefficients"""
    sh0_levels: ErrorStats
    """levels of an 8-bit colour, not clipped to 0..255"""
    shN: ShErrors
    bands: tuple[ShErrors, ...]
    """one entry for each band of the reference, from band 1"""

    def as_dict(self) -> dict[str, Any]:
        """Return all values by name, nested like the fields, for JSON."""
        return asdict(self)


def attribute_errors(reference: Splats, candidate: Splats) -> AttributeErrors:
    """Compare the stored values of two scenes, Gaussian by Gaussian.

    The rotation and scales of a Gaussian have 48 equivalent forms, and codecs may choose any of them. So each candidate
    is first brought into the form nearest to its reference: the smallest sum of the squared angle (radians) and the
    squared differences of the log-scales. If two axes are about equally long, the angle around the third has little
    effect; see the covariance error.

    Args:
        reference: N Gaussians, cleaned.
        candidate: N Gaussians, cleaned, in the order of ``reference``. Missing SH bands count as zeros.

    Raises:
        InvalidSceneError: the scenes differ in length, or the candidate has the higher SH degree.
    """
    if len(reference) != len(candidate):
        raise InvalidSceneError(
            f"the scenes have {len(reference)} and {len(candidate)} Gaussians and cannot be compared row by row; "
            "find corresponding Gaussians with match_gaussians() first"
        )
    if candidate.sh_degree > reference.sh_degree:
        raise InvalidSceneError(
            f"the candidate's SH degree, {candidate.sh_degree}, is above the reference's, {reference.sh_degree}; "
            "swap the scenes or drop the candidate's upper bands"
        )
    angles, log_scales, covariances = _shape_errors(reference, candidate)
    bands = [_sh_sums(reference, candidate, degree) for degree in range(1, reference.sh_degree + 1)]
    means = (reference.means, candidate.means)
    opacities = (reference.opacities, candidate.opacities)
    sh0 = (reference.sh0, candidate.sh0)
    return AttributeErrors(
        gaussians=len(reference),
        means=_error_stats(y - x for x, y in _chunks(*means)),
        means_relative=_error_stats((y - x) / (1 + np.abs(x)) for x, y in _chunks(*means)),
        rotation_degrees=_error_stats([np.degrees(angles)]),
        scales=_error_stats([log_scales]),
        covariance_relative_median=float(np.median(covariances)) if len(covariances) else 0.0,
        covariance_relative_max=float(covariances.max(initial=0)),
        opacity_logits=_error_stats(y - x for x, y in _chunks(*opacities)),
        opacities=_error_stats(sigmoid(y) - sigmoid(x) for x, y in _chunks(*opacities)),
        sh0=_error_stats(y - x for x, y in _chunks(*sh0)),
        sh0_levels=_error_stats(255 * SH_C0 * (y - x) for x, y in _chunks(*sh0)),
        shN=_sh_errors(bands),
        bands=tuple(_sh_errors([band]) for band in bands),
    )


def _rows(n: int) -> Iterator[slice]:
    return (slice(start, start + CHUNK) for start in range(0, n, CHUNK))


def _chunks(
    reference: Float32[np.ndarray, "N ..."], candidate: Float32[np.ndarray, "N ..."]
) -> Iterator[tuple[Float64[np.ndarray, "C ..."], Float64[np.ndarray, "C ..."]]]:
    for rows in _rows(len(reference)):
        yield reference[rows].astype(np.float64), candidate[rows].astype(np.float64)


def _error_stats(errors: Iterable[Float64[np.ndarray, "..."]]) -> ErrorStats:
    count, total, largest = 0, 0.0, 0.0
    for error in errors:
        count += error.size
        total += float(np.vdot(error, error))
        largest = max(largest, float(np.abs(error).max(initial=0)))
    return ErrorStats(rmse=_root(total, count), max=largest)


def _root(total: float, count: int) -> float:
    return float(np.sqrt(total / count)) if count else 0.0


def sigmoid(logits: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Return the opacities, 0 to 1, of logits, in float64."""
    return np.asarray(1 / (1 + np.exp(-logits.astype(np.float64))))


# --- Rotation and scales --------------------------------------------------------------------------


def _shape_errors(
    reference: Splats, candidate: Splats
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, "N 3"], Float64[np.ndarray, " N"]]:
    """Return angles (radians) and log-scale differences in the nearest form, and relative covariance errors."""
    n = len(reference)
    angles, log_scales, covariances = np.empty(n), np.empty((n, 3)), np.empty(n)
    for rows in _rows(n):
        frames, scales = _rotations(reference.quats[rows]), reference.scales[rows].astype(np.float64)
        other_frames, other_scales = _rotations(candidate.quats[rows]), candidate.scales[rows].astype(np.float64)
        angles[rows], log_scales[rows] = _nearest_form(frames, scales, other_frames, other_scales)
        covariance = _covariances(frames, scales)
        difference = _covariances(other_frames, other_scales) - covariance
        covariances[rows] = np.linalg.norm(difference, axis=(1, 2)) / np.linalg.norm(covariance, axis=(1, 2))
    return angles, log_scales, covariances


def _nearest_form(
    frames: Float64[np.ndarray, "C 3 3"],
    scales: Float64[np.ndarray, "C 3"],
    other_frames: Float64[np.ndarray, "C 3 3"],
    other_scales: Float64[np.ndarray, "C 3"],
) -> tuple[Float64[np.ndarray, " C"], Float64[np.ndarray, "C 3"]]:
    """Return angles and log-scale differences between the first Gaussians and the nearest forms of the others."""
    relative = other_frames.transpose(0, 2, 1) @ frames
    traces = relative.reshape(-1, 9) @ AXIS_ROTATIONS.reshape(-1, 9).T  # trace(Mᵀ R'ᵀ R) for each M
    angles = np.arccos(np.clip((traces - 1) / 2, -1, 1))
    differences = other_scales[:, AXIS_PERMUTATIONS] - scales[:, None]
    best = (angles**2 + (differences**2).sum(axis=2)).argmin(axis=1)
    row = np.arange(len(best))
    return angles[row, best], differences[row, best]


def _rotations(quats: Float32[np.ndarray, "C 4"]) -> Float64[np.ndarray, "C 3 3"]:
    # Normalised in float64: the length error of float32 unit quaternions, 1e-7, would become 0.03 degrees.
    wide = quats.astype(np.float64)
    w, x, y, z = (wide / np.linalg.norm(wide, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _covariances(
    frames: Float64[np.ndarray, "C 3 3"], scales: Float64[np.ndarray, "C 3"]
) -> Float64[np.ndarray, "C 3 3"]:
    axes = frames * np.exp(scales)[:, None]
    return np.asarray(axes @ axes.transpose(0, 2, 1))


# --- Spherical harmonics ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _ShSums:
    error: float
    signal: float
    count: int


def _sh_sums(reference: Splats, candidate: Splats, degree: int) -> _ShSums:
    """Return the sums of squares over one band."""
    band = slice(SH_REST_COUNTS[degree - 1], SH_REST_COUNTS[degree])
    error = signal = 0.0
    for x, y in _chunks(reference.shN[:, band], candidate.shN[:, band]):
        difference = y - x if y.size else x
        error += float(np.vdot(difference, difference))
        signal += float(np.vdot(x, x))
    return _ShSums(error, signal, reference.shN[:, band].size)


def _sh_errors(bands: list[_ShSums]) -> ShErrors:
    error, signal = sum((band.error for band in bands), 0.0), sum((band.signal for band in bands), 0.0)
    count = sum(band.count for band in bands)
    return ShErrors(
        rmse=_root(error, count), signal=_root(signal, count), energy_kept=1 - error / signal if signal else None
    )
