"""Surfaces of the sample scene: shapes, which map the unit square to a surface, and paint, solid textures.

Axes as in COLMAP, y pointing down: the ground is y = 0, the camera looks along +z.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32

UV = Float32[np.ndarray, "M 2"]
Rows = Float32[np.ndarray, "M 3"]
Column = Float32[np.ndarray, " M"]
Patch = tuple[Rows, Rows, Column]
"""Points, unit normals, and the area of the surface per unit of the square."""


def f32(values: Sequence[Any] | np.ndarray) -> Float32[np.ndarray, "..."]:
    """Return ``values`` as a float32 array."""
    return np.asarray(values, np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Surface to be covered with Gaussians."""

    share: float
    """Share of all Gaussians."""
    shape: Callable[[UV], Patch]
    paint: Callable[[Rows], Rows]
    """Map points to RGB in 0..1."""
    specular: float = 0.0
    """Brightness of the reflection of a light of strength 1."""
    shadowed: bool = False
    """Whether the objects cast shadows on the surface."""
    luminous: bool = False
    """Whether the surface shows its paint without lighting."""


# --- Shapes ---------------------------------------------------------------------------------------

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


# --- Paint ----------------------------------------------------------------------------------------


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
