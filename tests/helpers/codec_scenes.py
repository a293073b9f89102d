"""Small scenes for the codec tests, created without the library."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import kissgs
from kissgs.core.splats import ATTRIBUTES, SH_REST_COUNTS, Splats

PRESETS = ("fast", "balanced", "paper")

GLANCE = {"sensitivity_views": 4, "sensitivity_view_size": 48}
"""Settings that measure the sensitivity of a small scene quickly."""

PLANES = (
    "active_mask",
    "means_bytes_0",
    "means_bytes_1",
    "opacities",
    "scales",
    "quaternions",
    "f_dc",
    "f_rest_labels",
    "f_rest_centroids",
)


def unit(quats):
    """Return float32 quaternions of unit length."""
    wide = np.asarray(quats, dtype=np.float64)
    return (wide / np.linalg.norm(wide, axis=1, keepdims=True)).astype(np.float32)


def random_scene(count, degree=0, seed=0):
    """Return a clean scene with heavy tails and independent attributes, which have no redundancy for an encoder."""
    rng = np.random.default_rng(seed)
    coefficients = SH_REST_COUNTS[degree]
    return Splats(
        means=(rng.standard_t(3, (count, 3)) * 3).astype(np.float32),
        quats=unit(rng.normal(size=(count, 4))),
        scales=rng.normal(-4, 1.2, (count, 3)).astype(np.float32),
        opacities=np.clip(rng.normal(1, 3, count), -5.5, 13).astype(np.float32),
        sh0=rng.normal(0, 1, (count, 3)).astype(np.float32),
        shN=(rng.normal(0, 0.1, (count, coefficients, 3)) * rng.exponential(1, (count, 1, 1))).astype(np.float32),
    )


def constant_scene(count, degree=0):
    """Return equal Gaussians."""
    return random_scene(1, degree, seed=9).select(np.zeros(count, dtype=np.int64))


def replaced(splats, **arrays):
    """Return the scene with some arrays replaced, cast to float32."""
    new = {name: np.asarray(array, dtype=np.float32) for name, array in arrays.items()}
    return Splats(**{name: new.get(name, getattr(splats, name)) for name in ATTRIBUTES})


def covariances(quats, scales):
    """Return the covariances R diag(s²) Rᵀ in float64, with R from the normalised quaternions."""
    w, x, y, z = (np.asarray(quats, np.float64) / np.linalg.norm(np.asarray(quats, np.float64), axis=1)[:, None]).T
    rotation = np.empty((len(w), 3, 3))
    rotation[:, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    rotation[:, 1] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    rotation[:, 2] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    squares = np.exp(2 * np.asarray(scales, np.float64))
    return np.einsum("nij,nj,nkj->nik", rotation, squares, rotation)


def product(p, q):
    """Return the Hamilton product p q of quaternions w, x, y, z, from SciPy's rotations."""
    w, x, y, z = np.moveaxis(np.asarray(p, np.float64), -1, 0)
    a, b, c, d = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    parts = [w * a - x * b - y * c - z * d, w * b + x * a + y * d - z * c]
    return np.stack([*parts, w * c - x * d + y * a + z * b, w * d + x * c - y * b + z * a], axis=-1)


def equivalents(quats, scales):
    """Return all 48 equivalent forms, (48, N, 4) and (48, N, 3), from SciPy's rotations of the cube."""
    turns = Rotation.create_group("O")
    new_quats, new_scales = [], []
    for turn, matrix in zip(turns.as_quat(scalar_first=True), turns.as_matrix(), strict=True):
        source = np.abs(matrix).argmax(axis=0)
        turned = product(quats, turn)
        new_quats += [turned, -turned]
        new_scales += [scales[:, source]] * 2
    return np.stack(new_quats), np.stack(new_scales)


def stored_forms(quats, scales):
    """Return all forms that a container may hold: the equivalent ones with a length of 1, and those with w = 1."""
    forms, permuted = equivalents(quats, scales)
    w = np.where(forms[:, :, :1] > 0.5, forms[:, :, :1], 1)  # canonical forms have 0.85 at least
    return np.concatenate([forms, forms / w]), np.concatenate([permuted, permuted])


def signed_log(x):
    """Return sign(x) ln(1 + |x|) in float64."""
    wide = np.asarray(x, np.float64)
    return np.sign(wide) * np.log1p(np.abs(wide))


def rounding(values):
    """Return a bound for the error from rounding values, ranges and steps to float32, for the largest value."""
    return 1e-6 * np.abs(values).max(initial=0) + 1e-44


def assert_within(found, wanted, max_quantization_error):
    """Assert that no error is larger than half a step."""
    excess = np.abs(np.asarray(found, np.float64) - wanted) - np.asarray(max_quantization_error) * (1 + 1e-6)
    assert excess.max(initial=0) <= rounding(wanted)


def assert_round_trip(splats, result):
    """Assert that each Gaussian decodes within the half steps of the report, in one of its equivalent forms."""
    found, wanted, half = (
        kissgs.decompress(result.files),
        splats.select(result.order),
        result.report.max_quantization_error,
    )
    assert_within(signed_log(found.means), signed_log(wanted.means), half["means"])
    assert_within(found.opacities, wanted.opacities, half["opacities"][0])
    assert_within(found.sh0, wanted.sh0, half["f_dc"])
    quats, scales = stored_forms(wanted.quats, wanted.scales)
    fits = (np.abs(quats - found.quats) <= np.array(half["quaternions"]) + rounding(quats)).all(axis=2)
    fits &= (np.abs(scales - found.scales) <= np.array(half["scales"]) + rounding(scales)).all(axis=2)
    assert fits.any(axis=0).all()
