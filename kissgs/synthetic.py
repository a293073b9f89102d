"""Procedural sample scene with the appearance and statistics of a trained 3DGS reconstruction. Axes as in COLMAP, y
pointing down: the ground is y = 0, the camera looks along +z."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

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

# Surfaces of the sample scene: shapes, which map the unit square to a surface, and paint, solid textures.

UV = Float32[np.ndarray, "M 2"]
Rows = Float32[np.ndarray, "M 3"]
Column = Float32[np.ndarray, " M"]
Patch = tuple[Rows, Rows, Column]  # points, unit normals, and the area of the surface per unit of the square


def f32(values: Sequence[Any] | np.ndarray) -> Float32[np.ndarray, "..."]:
    """Return ``values`` as a float32 array."""
    return np.asarray(values, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Surface to be covered with Gaussians."""

    share: float  # of all Gaussians
    shape: Callable[[UV], Patch]
    paint: Callable[[Rows], Rows]  # RGB of points, 0 to 1
    specular: float = 0.0  # brightness of the reflection of a light of strength 1
    shadowed: bool = False  # by the objects
    luminous: bool = False  # shows its paint without lighting


GROUND_RADIUS = 6.5
BALL_CENTRE, BALL_RADIUS = f32([-1.35, -0.8, -0.5]), 0.8
KNOT_CENTRE, KNOT_RADII = f32([0.1, -1.36, 0.9]), (0.8, 0.34, 0.2)
BLOCK_CENTRE, BLOCK_HALF = f32([1.35, -0.6, -0.55]), 0.6
BLOCK_AXES = f32([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
SKY_RADIUS, SKY_HEIGHTS = 30.0, (-1.0, 0.3)


def unit_sphere(uv: UV, heights: tuple[float, float] = (-1.0, 1.0)) -> Rows:
    """Return unit vectors of uniform density with y between ``heights``."""
    height, angle = heights[0] + (heights[1] - heights[0]) * uv[:, 0], 2 * np.pi * uv[:, 1]
    ring = np.sqrt(1 - height**2)
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)


def ground(uv: UV) -> Patch:
    """Return a round table top."""
    r, angle = GROUND_RADIUS * np.sqrt(uv[:, 0]), 2 * np.pi * uv[:, 1]
    points = np.stack([r * np.cos(angle), np.zeros_like(r), r * np.sin(angle)], axis=1)
    return points, np.tile(f32([0, -1, 0]), (len(uv), 1)), np.full_like(r, np.pi * GROUND_RADIUS**2)


def ball(uv: UV) -> Patch:
    """Return a sphere that rests on the ground."""
    normals = unit_sphere(uv)
    return BALL_CENTRE + BALL_RADIUS * normals, normals, np.full_like(uv[:, 0], 4 * np.pi * BALL_RADIUS**2)


def sky(uv: UV) -> Patch:
    """Return a dome seen from inside, from slightly below the horizon upwards."""
    outward = unit_sphere(uv, SKY_HEIGHTS)
    area = 2 * np.pi * SKY_RADIUS**2 * (SKY_HEIGHTS[1] - SKY_HEIGHTS[0])
    return SKY_RADIUS * outward, -outward, np.full_like(uv[:, 0], area)


def knot(uv: UV) -> Patch:
    """Return a tube along a trefoil knot, which winds twice around and thrice through a torus that faces the camera."""
    major, minor, tube = KNOT_RADII
    t, around = 2 * np.pi * uv[:, 0], 2 * np.pi * uv[:, 1]
    cos2, sin2, cos3, sin3 = np.cos(2 * t), np.sin(2 * t), np.cos(3 * t), np.sin(3 * t)
    reach, swing = major + minor * cos3, 3 * minor * sin3
    centre = np.stack([reach * cos2, reach * sin2, minor * sin3], axis=1)
    tangent = np.stack([-swing * cos2 - 2 * reach * sin2, -swing * sin2 + 2 * reach * cos2, 3 * minor * cos3], axis=1)
    speed = np.linalg.norm(tangent, axis=1)
    outward = np.stack([cos3 * cos2, cos3 * sin2, sin3], axis=1)  # the torus's normal, hence normal to the curve
    sideways = np.cross(tangent / speed[:, None], outward)
    normals = np.cos(around)[:, None] * outward + np.sin(around)[:, None] * sideways
    return KNOT_CENTRE + centre + tube * normals, normals, (2 * np.pi) ** 2 * tube * speed  # neglects the curvature


def block(uv: UV) -> Patch:
    """Return a cube that stands on the ground, rotated about the vertical."""
    faces = f32([[1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1], [0, -1, 0]])  # none below
    pick = np.minimum((5 * uv[:, 0]).astype(np.intp), 4)
    normals = faces[pick]
    a, b = 2 * (5 * uv[:, 0] - pick.astype(np.float32)) - 1, 2 * uv[:, 1] - 1
    local = normals + a[:, None] * np.roll(normals, 1, axis=1) + b[:, None] * np.roll(normals, 2, axis=1)
    return BLOCK_CENTRE + BLOCK_HALF * local @ BLOCK_AXES, normals @ BLOCK_AXES, np.full_like(a, 20 * BLOCK_HALF**2)


def _noise(points: Rows, frequency: float) -> Column:
    """Return smooth noise of about ±1: three octaves of crossed sines, each warped by the ones before."""
    rotation = 1.9 * f32([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])  # a rotation that fits no tiling
    total = np.zeros(len(points), np.float32)
    q = f32(points * np.float32(frequency))
    for octave in range(3):
        q = f32(q @ rotation)
        total += 0.5**octave * np.sin(q[:, 0] + 2 * total) * np.cos(q[:, 1] + total)
    return total


def _mix(a: tuple[float, float, float] | Rows, b: tuple[float, float, float] | Rows, amount: Column) -> Rows:
    weight = np.clip(amount, 0, 1)[:, None]
    return np.asarray(f32(a) * (1 - weight) + f32(b) * weight)


def tiles(points: Rows) -> Rows:
    """Return marble tiles in two colours, with grout between them."""
    cell = points[:, [0, 2]] / np.float32(0.8)
    odd = np.floor(cell).sum(axis=1) % 2
    marble = 0.5 + 0.5 * np.sin(2 * points[:, 0] + 4 * _noise(points, 0.6))
    light = _mix((0.90, 0.86, 0.78), (0.74, 0.64, 0.52), marble**4)
    dark = _mix((0.16, 0.25, 0.32), (0.36, 0.46, 0.50), marble**6)
    grout = np.abs(cell - np.rint(cell)).min(axis=1) < 0.03
    return _mix(_mix(light, dark, odd), (0.40, 0.37, 0.33), grout.astype(np.float32))


def lacquer(points: Rows) -> Rows:
    """Return red with an orange swirl."""
    swirl = np.sin(5 * (points[:, 1] + 0.4 * points[:, 0]) + 3 * _noise(points, 1.2))
    return _mix((0.62, 0.05, 0.06), (0.86, 0.25, 0.10), 2 * swirl - 0.6)


def candy(points: Rows) -> Rows:
    """Return petrol and cream stripes."""
    stripe = np.sin(14 * (points[:, 0] + points[:, 1]) + 6 * points[:, 2])
    return _mix((0.04, 0.40, 0.46), (0.95, 0.80, 0.40), 4 * stripe - 1)


def toy(points: Rows) -> Rows:
    """Return wood with a coloured ring and border on each face."""
    local = (points - BLOCK_CENTRE) @ BLOCK_AXES.T / np.float32(BLOCK_HALF)
    size = np.abs(local)
    inner, middle, _ = np.sort(size, axis=1).T
    wood = _mix((0.90, 0.73, 0.48), (0.72, 0.52, 0.30), 0.5 + 0.5 * np.sin(9 * local[:, 1] + 4 * _noise(local, 0.8)))
    hue = f32([[0.10, 0.34, 0.74], [0.84, 0.22, 0.16], [0.16, 0.52, 0.24]])[size.argmax(axis=1)]
    painted = (np.abs(np.hypot(inner, middle) - 0.42) < 0.16) | (middle > 0.8)
    return _mix(wood, hue, painted.astype(np.float32))


def landscape(points: Rows) -> Rows:
    """Return hills under a blue sky with a few clouds."""
    direction = points / np.float32(SKY_RADIUS)
    height = -direction[:, 1]
    blue = _mix((0.80, 0.88, 0.94), (0.22, 0.46, 0.82), 2.4 * height)
    heavens = _mix(blue, (0.98, 0.97, 0.96), 1.6 * _noise(direction * f32([1, 3, 1]), 1.1) - 0.6)
    hills = _mix((0.42, 0.54, 0.38), (0.20, 0.36, 0.20), 0.5 + 0.4 * _noise(direction, 3.0) - 2 * height)
    crest = 0.08 + 0.05 * _noise(direction * f32([1, 0, 1]), 2.0)
    return _mix(hills, heavens, 40 * (height - crest))


SURFACES = (
    Surface(share=0.45, shape=ground, paint=tiles, specular=0.10, shadowed=True),
    Surface(share=0.10, shape=ball, paint=lacquer, specular=0.7),
    Surface(share=0.16, shape=knot, paint=candy, specular=0.35),
    Surface(share=0.15, shape=block, paint=toy, specular=0.08),
    Surface(share=0.12, shape=sky, paint=landscape, luminous=True),
)
"""Surfaces of the scene; the shares leave 0.02 for floaters."""

SHADOW_CASTERS = (ball, knot, block)


# Surfaces are covered with flat Gaussians, densest where the texture has detail and where most cameras of a capture
# would look. Light and shadow are baked into the constant colour, specular reflections into the higher SH bands.


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
    rows, scene = rng.permutation(count), empty_splats(count, SH_REST_COUNTS[sh_degree])
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


def _cover(
    surface: Surface, n: int, shadows: list[Float32[np.ndarray, "S S"]], sh_degree: int, rng: np.random.Generator
) -> Splats:
    points, normals, spacing = _scatter(surface, n, rng)
    # Logits: 66 % nearly opaque, 30 % translucent and 4 % nearly transparent, as training leaves them.
    kind = rng.choice(3, n, p=(0.66, 0.30, 0.04))
    logits = rng.normal(np.array([3.2, -0.6, -5.0])[kind], np.array([1.8, 1.3, 0.7])[kind])
    opacities = np.clip(logits, OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX).astype(np.float32)
    # The gradient of the paint's brightness, from one-sided differences over a third of the spacing.
    here, step = surface.paint(points).mean(axis=1), spacing / 3
    there = [surface.paint(points + step[:, None] * axis).mean(axis=1) for axis in np.eye(3, dtype=np.float32)]
    gradient: Rows = (np.stack(there, axis=1) - here[:, None]) / step[:, None]
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
    """Return ``n`` points of the surface, their normals, and the expected distance between neighbours. A grid of n to
    4n cells covers the surface. Along a Z-order curve through it, each n-th part of the integral of the density gets
    one Gaussian. Independent draws would leave holes, which a trained scene does not have."""
    bits = ((n - 1).bit_length() + 1) // 2
    side, index = 2**bits, np.arange(4**bits)
    corners = np.zeros((4**bits, 2), np.float32)
    for bit in range(bits):
        corners[:, 0] += ((index >> (2 * bit)) & 1) << bit
        corners[:, 1] += ((index >> (2 * bit + 1)) & 1) << bit
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


@dataclass(frozen=True, slots=True, kw_only=True)
class _Light:
    direction: Float32[np.ndarray, "3"]  # unit vector towards the light
    colour: Float32[np.ndarray, "3"]
    wrap: float  # 0 lights the half of a ball that faces the light, 1 all of it, as an open sky does
    softness: float  # width of the specular lobe: SH band l is damped by exp(-l (l + 1) softness)


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
    cells = ((points[:, [0, 2]] / np.float32(SHADOW_EXTENT) + 1) * (SHADOW_CELLS / 2)).astype(int)
    column, row = np.clip(cells, 0, SHADOW_CELLS - 1).T
    for light, shadow in zip(LIGHTS, shadows, strict=True):
        facing = normals @ light.direction
        reach = shadow[column, row] if surface.shadowed else np.ones_like(facing)
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


def _sh_noise(n: int, sh_degree: int, rng: np.random.Generator) -> Float32[np.ndarray, "M K 3"]:
    """Return noise as in trained scenes: heavy-tailed over the Gaussians, correlated between the three channels."""
    k = SH_REST_COUNTS[-1]  # always all coefficients, so that the degree changes nothing else of the scene
    noise = 0.5 * rng.standard_normal((n, k, 3), np.float32) + 0.9 * rng.standard_normal((n, k, 1), np.float32)
    strength = 0.016 * np.exp(0.7 * rng.standard_normal((n, 1, 1), np.float32))
    return np.asarray(strength * noise[:, : SH_REST_COUNTS[sh_degree]])
