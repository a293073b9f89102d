"""Procedural sample scene with the appearance and statistics of a trained 3DGS reconstruction.

Surfaces are covered with flat Gaussians, densest where the texture has detail and where most cameras of a capture would
look. Light and shadow are baked into the constant colour, specular reflections into the higher SH bands.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32
from kissgs.core.errors import UnsupportedError
from kissgs.core.spherical_harmonics import sh_basis
from kissgs.core.splats import (
    ATTRIBUTES,
    OPACITY_LOGIT_MAX,
    OPACITY_LOGIT_MIN,
    SH_C0,
    SH_REST_COUNTS,
    Splats,
    empty_splats,
)
from kissgs.synthetic.surfaces import SHADOW_CASTERS, SURFACES, Column, Rows, Surface, f32, unit_sphere


def sample_scene(count: int = 60_000, *, sh_degree: int = 3, seed: int = 0) -> Splats:
    """Return a table top with a shiny ball, a torus knot and a toy block under an open sky, with floaters.

    The scene is clean (:func:`kissgs.core.splats.clean` changes nothing), but rotations have many of their equivalent
    forms, Gaussians are in random order, and a few per cent of them are nearly transparent, some below 1/255.
    Axes as in COLMAP, y down. The objects are within 2.5 units of the origin, the sky is 30 away; a camera at
    (1.2, -2.2, -5.2) looking at (0, -0.8, 0) has all objects in view.

    Args:
        count: Number of Gaussians, 0 or more.
        sh_degree: 0 to 3.
        seed: Random seed, 0 or more; equal seeds give equal scenes, bit-identical on equal machines.

    Raises:
        UnsupportedError: ``count`` or ``seed`` is negative, or ``sh_degree`` is not 0, 1, 2 or 3.
    """
    if count < 0 or seed < 0:
        raise UnsupportedError(f"count and seed must be 0 or more, got {count} and {seed}")
    if sh_degree not in range(len(SH_REST_COUNTS)):
        raise UnsupportedError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
    rng = np.random.Generator(np.random.PCG64(seed))
    scene = empty_splats(count, SH_REST_COUNTS[sh_degree])
    rows = rng.permutation(count)
    start = 0
    for part in _parts(count, sh_degree, rng):
        for name in ATTRIBUTES:
            getattr(scene, name)[rows[start : start + len(part)]] = getattr(part, name)
        start += len(part)
    return scene


def _parts(count: int, sh_degree: int, rng: np.random.Generator) -> Iterator[Splats]:
    """Yield one part per surface, then the floaters; together ``count`` Gaussians."""
    ends = np.rint(np.cumsum([surface.share for surface in SURFACES]) * count).astype(int)
    shadows = [_shadow_map(light.direction, rng) for light in LIGHTS]
    for surface, n in zip(SURFACES, np.diff(ends, prepend=0), strict=True):
        if n:
            yield _cover(surface, int(n), shadows, sh_degree, rng)
    yield _floaters(count - int(ends[-1]), sh_degree, rng)


# --- Geometry of the Gaussians --------------------------------------------------------------------------


def _cover(
    surface: Surface, n: int, shadows: list[Float32[np.ndarray, "S S"]], sh_degree: int, rng: np.random.Generator
) -> Splats:
    points, normals, spacing = _scatter(surface, n, rng)
    opacities = _opacities(n, rng)
    gradient = _brightness_gradient(surface, points, spacing)
    edge = np.minimum(2 * spacing * np.linalg.norm(gradient, axis=1), 1)
    along = np.cross(normals, gradient) + 1e-3 * rng.standard_normal((n, 3), np.float32)
    # Training stretches Gaussians along the edges of the texture, and leaves translucent ones larger.
    size = np.log(spacing) - 0.3 + 0.08 * np.clip(-opacities, 0, 3)
    scales = size[:, None] + rng.normal((0, 0, -1.6), (0.3, 0.3, 0.7), (n, 3)).astype(np.float32)
    scales += edge[:, None] * f32([0.4, -0.9, 0])
    quats, scales = _orient(normals, along, scales, rng)
    colour, sh = _appearance(surface, points, normals, shadows, sh_degree)
    colour += 0.02 * rng.standard_normal((n, 3), np.float32)
    return Splats(
        means=points + normals * (0.1 * spacing * rng.standard_normal(n, np.float32))[:, None],
        quats=quats,
        scales=scales,
        opacities=opacities,
        sh0=(colour - 0.5) / np.float32(SH_C0) + sh[:, 0],
        shN=sh[:, 1:] + _sh_noise(n, sh_degree, rng),
    )


def _scatter(surface: Surface, n: int, rng: np.random.Generator) -> tuple[Rows, Rows, Column]:
    """Return ``n`` points of the surface, their normals, and the expected distance between neighbours.

    A grid of n to 4n cells covers the surface. Along a Z-order curve through it, each n-th part of the integral of the
    density gets one Gaussian. Independent draws would leave holes, which a trained scene does not have.
    """
    corners, side = _z_order(n)
    points, _, area = surface.shape((corners + 0.5) / np.float32(side))
    distance2 = (points**2).sum(axis=1)
    step = 0.02 * np.sqrt(distance2)[:, None] * rng.standard_normal(points.shape, np.float32)
    busy = np.abs(surface.paint(points + step) - surface.paint(points)).sum(axis=1)
    watched = 1 / (1 + distance2 / 6)  # captures circle around the middle
    density = watched * (1 + 5 * np.minimum(busy, 1))

    filled = np.cumsum(density * area, dtype=np.float64)
    cells = np.searchsorted(filled, (np.arange(n) + 0.5) / n * filled[-1])
    points, normals, _ = surface.shape((corners[cells] + rng.random((n, 2), np.float32)) / np.float32(side))
    spacing = np.sqrt(filled[-1] / (n * side**2 * density[cells]))
    return points, normals, spacing.astype(np.float32)


def _z_order(n: int) -> tuple[Float32[np.ndarray, "C 2"], int]:
    """Return the cells of a square grid of at least ``n`` cells along the Z-order curve, and the grid's side."""
    bits = ((n - 1).bit_length() + 1) // 2
    index = np.arange(4**bits)
    corners = np.zeros((4**bits, 2), np.float32)
    for bit in range(bits):
        corners[:, 0] += ((index >> (2 * bit)) & 1) << bit
        corners[:, 1] += ((index >> (2 * bit + 1)) & 1) << bit
    return corners, 2**bits


def _brightness_gradient(surface: Surface, points: Rows, spacing: Column) -> Rows:
    """Return the paint's brightness gradient per world unit, from one-sided differences over a third of the spacing."""
    here = surface.paint(points).mean(axis=1)
    step = spacing / 3
    there = [surface.paint(points + step[:, None] * axis).mean(axis=1) for axis in np.eye(3, dtype=np.float32)]
    gradient: Rows = (np.stack(there, axis=1) - here[:, None]) / step[:, None]
    return gradient


def _opacities(n: int, rng: np.random.Generator) -> Column:
    """Return logits: 66 % nearly opaque, 30 % translucent and 4 % nearly transparent, as training leaves them."""
    kind = rng.choice(3, n, p=(0.66, 0.30, 0.04))
    logits = rng.normal(np.array([3.2, -0.6, -5.0])[kind], np.array([1.8, 1.3, 0.7])[kind])
    return np.clip(logits, OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX).astype(np.float32)


def _orient(
    normals: Rows, along: Rows, scales: Rows, rng: np.random.Generator
) -> tuple[Float32[np.ndarray, "M 4"], Rows]:
    """Return rotations with the third axis on the normal and the first towards ``along``, in random forms."""
    n = len(normals)
    normals = normals * rng.choice(f32([-1, 1]), (n, 1))  # a disc has two sides
    x, y, z = normals.T
    # The smallest rotation of the z axis to the normal; for -z, no rotation, since the axis has no direction.
    w, a, b = (np.stack([1 + z, -y, x]) / np.sqrt(2 * np.maximum(1 + z, 1e-6))).astype(np.float32)
    w = np.where(z < -0.999999, 1, w)
    first = np.stack([1 - 2 * b * b, 2 * a * b, -2 * w * b], axis=1)
    second = np.stack([2 * a * b, 1 - 2 * a * a, 2 * w * a], axis=1)
    half = np.arctan2((along * second).sum(axis=1), (along * first).sum(axis=1)) / 2
    zero = np.zeros_like(half)
    tilt, spin = np.stack([w, a, b, zero], axis=1), np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)

    permutations = f32([[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5]])  # axes 012, 120, 201
    pick = rng.integers(3, size=n)
    quats = _product(_product(tilt, spin), permutations[pick]) * rng.choice(f32([-1, 1]), (n, 1))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return quats, np.take_along_axis(scales, (np.arange(3) + pick[:, None]) % 3, axis=1)


def _product(p: Float32[np.ndarray, "M 4"], q: Float32[np.ndarray, "M 4"]) -> Float32[np.ndarray, "M 4"]:
    """Return the Hamilton product, components w, x, y, z."""
    (pw, px, py, pz), (qw, qx, qy, qz) = p.T, q.T
    w = pw * qw - px * qx - py * qy - pz * qz
    x = pw * qx + px * qw + py * qz - pz * qy
    y = pw * qy - px * qz + py * qw + pz * qx
    z = pw * qz + px * qy - py * qx + pz * qw
    return np.stack([w, x, y, z], axis=1)


def _floaters(n: int, sh_degree: int, rng: np.random.Generator) -> Splats:
    """Return faint, large Gaussians in the air, as in reconstructions from few views."""
    log_sizes = rng.normal(-2, 0.7, (n, 1)) + rng.normal(0, 0.35, (n, 3))
    normals, along = unit_sphere(rng.random((n, 2), np.float32)), unit_sphere(rng.random((n, 2), np.float32))
    quats, scales = _orient(normals, along, log_sizes.astype(np.float32), rng)
    return Splats(
        means=rng.normal((0, -1.6, 0), (2.5, 1.0, 2.5), (n, 3)).astype(np.float32),
        quats=quats,
        scales=scales,
        opacities=rng.normal(-4, 0.8, n).astype(np.float32),
        sh0=(rng.normal(0.2, 0.5, (n, 1)) + rng.normal(0, 0.15, (n, 3))).astype(np.float32),
        shN=2 * _sh_noise(n, sh_degree, rng),
    )


# --- Appearance of the Gaussians --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _Light:
    direction: Float32[np.ndarray, "3"]
    """Unit vector towards the light."""
    colour: Float32[np.ndarray, "3"]
    wrap: float
    """Extent of diffuse light: 0 lights the half of a ball that faces the light, 1 all of it, as an open sky does."""
    softness: float
    """Width of the specular lobe: SH band l is damped by exp(-l (l + 1) softness)."""


SUN = _Light(direction=f32([-0.48, -0.64, -0.6]), colour=f32([0.78, 0.72, 0.62]), wrap=0.0, softness=0.04)
SKY = _Light(direction=f32([0, -1, 0]), colour=f32([0.36, 0.40, 0.46]), wrap=1.0, softness=0.12)
LIGHTS = (SUN, SKY)
AMBIENT = 0.2
SHADOW_EXTENT, SHADOW_CELLS = 5.0, 200


def _appearance(
    surface: Surface, points: Rows, normals: Rows, shadows: list[Float32[np.ndarray, "S S"]], sh_degree: int
) -> tuple[Rows, Float32[np.ndarray, "M K 3"]]:
    """Return diffuse RGB, and the SH coefficients (the constant one first) of the specular reflections."""
    albedo = surface.paint(points)
    sh = np.zeros((len(points), (sh_degree + 1) ** 2, 3), np.float32)
    if surface.luminous:
        return albedo, sh
    band = np.sqrt(np.arange(sh.shape[1])).astype(int)
    received = np.full_like(albedo, AMBIENT)
    for light, shadow in zip(LIGHTS, shadows, strict=True):
        facing = normals @ light.direction
        reach = _look_up(shadow, points) if surface.shadowed else np.ones_like(facing)
        diffuse = np.maximum((facing + light.wrap) / (1 + light.wrap), 0)
        received += (reach * diffuse)[:, None] * light.colour
        # A camera looking along d sees the reflected light if d is close to ``mirrored``: a round lobe, whose SH
        # coefficients are the basis functions at its axis (addition theorem), damped band by band.
        mirrored = light.direction - 2 * facing[:, None] * normals
        lobe = sh_basis(mirrored, sh_degree) * np.exp(-band * (band + 1) * light.softness).astype(np.float32)
        strength = surface.specular * reach * np.clip(4 * facing, 0, 1)
        sh += lobe[:, :, None] * (strength[:, None] * light.colour)[:, None]
    return albedo * received, sh


def _shadow_map(light: Float32[np.ndarray, "3"], rng: np.random.Generator) -> Float32[np.ndarray, "S S"]:
    """Return the share of a light that reaches each cell of the ground, ±SHADOW_EXTENT in x and z."""
    points = np.concatenate([shape(rng.random((30_000, 2), np.float32))[0] for shape in SHADOW_CASTERS])
    landed = points - light * (points[:, 1] / light[1])[:, None]
    edges = np.linspace(-SHADOW_EXTENT, SHADOW_EXTENT, SHADOW_CELLS + 1)
    reach = np.exp(-0.4 * np.histogram2d(landed[:, 0], landed[:, 2], [edges, edges])[0])
    for axis in (0, 1):  # a penumbra
        reach = np.mean([np.roll(reach, shift, axis) for shift in range(-3, 4)], axis=0)
    return f32(reach)


def _look_up(shadow: Float32[np.ndarray, "S S"], points: Rows) -> Column:
    cells = ((points[:, [0, 2]] / np.float32(SHADOW_EXTENT) + 1) * (SHADOW_CELLS / 2)).astype(int)
    column, row = np.clip(cells, 0, SHADOW_CELLS - 1).T
    return np.asarray(shadow[column, row])


def _sh_noise(n: int, sh_degree: int, rng: np.random.Generator) -> Float32[np.ndarray, "M K 3"]:
    """Return noise as in trained scenes: heavy-tailed over the Gaussians, correlated between the three channels."""
    k = SH_REST_COUNTS[-1]  # always all coefficients, so that the degree changes nothing else of the scene
    noise = 0.5 * rng.standard_normal((n, k, 3), np.float32) + 0.9 * rng.standard_normal((n, k, 1), np.float32)
    strength = 0.016 * np.exp(0.7 * rng.standard_normal((n, 1, 1), np.float32))
    return np.asarray(strength * noise[:, : SH_REST_COUNTS[sh_degree]])
