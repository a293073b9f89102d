"""``Importance``: what a change of each stored value costs in the pictures of a scene, whoever measured it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kissgs._typing import Float32, Float64
from kissgs.errors import InvalidSceneError
from kissgs.splats import SH_C0, SH_REST_COUNTS, Splats

UNSEEN = 1e-3
"""Least importance, in units of what it would be if nothing were before a Gaussian."""

FLOOR = 0.55
"""Least importance where cameras were virtual, in units of the prior and of the hedge: a camera nearby still finds the
Gaussian within a few decibels of what its neighbours keep."""

LOOKED_AT = 0.2
"""Coverage from which on a Gaussian was seen well enough to tell what its like are worth."""

LARGEST = 1e25
"""Of a cost: beyond it stand Gaussians so large that squares overflow, and sums of costs would be infinite."""

OPACITY, SCALES, ROTATION = (0,), (7, 13, 18), (22, 25, 27)
"""Where the diagonal entries of a shape's form stand."""


@dataclass(frozen=True, slots=True, eq=False)
class Importance:
    """Quadratic forms: the mean squared error of a scene's pictures that small changes of each Gaussian cause.

    The error is the mean over pictures, pixels and RGB from 0 to 1, so that -10 log10 of a sum of such costs is the
    PSNR that they lead to, as far as the errors of different Gaussians are independent.

    Attributes:
        places: ``(N, 6)``, upper triangle of the form of the position, world units: xx, xy, xz, yy, yz, zz.
        shapes: ``(N, 28)``, upper triangle, row by row, of the form of (opacity logit; three log-scales; a rotation
            vector, radians, about the Gaussian's own axes). Its 48 equivalent descriptions only permute it.
        colors: ``(N,)``, of one channel of the colour from 0 to 1: mean of (alpha T)², a third.
        directions: ``(N, K)`` mean of the spherical harmonics without the constant one, over the directions from which
            the Gaussian is seen, K as in its scene; 0 where it is not seen.
        guessed: ``(N,)`` the part of ``colors`` that was not measured, see :meth:`with_prior`.
        coverage: ``(N,)`` from 0, no camera saw the Gaussian or all from far away, to 1, one looked at it from nearby.
        captured: ``(N,)`` the same for the cameras of a capture alone, which say where people look.
        hedge: from 0 to 1, how little the pictures are taken to say of other pictures.
    """

    places: Float32[np.ndarray, "N 6"]
    shapes: Float32[np.ndarray, "N 28"]
    colors: Float32[np.ndarray, " N"]
    directions: Float32[np.ndarray, "N K"]
    guessed: Float32[np.ndarray, " N"]
    coverage: Float32[np.ndarray, " N"]
    captured: Float32[np.ndarray, " N"]
    hedge: float = 0.0

    @classmethod
    def none(cls, count: int, sh_degree: int) -> Importance:
        """Of a scene that nobody has looked at."""
        return cls(
            places=np.zeros((count, 6), np.float32),
            shapes=np.zeros((count, 28), np.float32),
            colors=np.zeros(count, np.float32),
            directions=np.zeros((count, SH_REST_COUNTS[sh_degree]), np.float32),
            guessed=np.zeros(count, np.float32),
            coverage=np.zeros(count, np.float32),
            captured=np.zeros(count, np.float32),
        )

    def check(self, splats: Splats) -> None:
        """See that this is the importance of such a scene.

        Raises:
            InvalidSceneError: it has another number of Gaussians or another SH degree, or values that no costs have, or
                coverage that is not from 0 to 1.
        """
        wanted = Importance.none(len(splats), splats.sh_degree)
        for name in ("places", "shapes", "colors", "directions", "guessed", "coverage", "captured"):
            found, shape = getattr(self, name), getattr(wanted, name).shape
            if found.shape != shape or found.dtype != np.float32:
                raise InvalidSceneError(
                    f"this importance is not that of the scene: {name} must be {shape} float32, and is {found.shape} "
                    f"{found.dtype}; measure it for the scene as it is compressed"
                )
            if not np.isfinite(found).all() or (name in ("colors", "guessed") and (found < 0).any()):
                raise InvalidSceneError(f"this importance is damaged: {name} has a value that is no cost; measure it")
        for name in ("coverage", "captured"):
            found = getattr(self, name)
            outside = found[(found < 0) | (found > 1)]
            if len(outside):
                raise InvalidSceneError(
                    f"this importance is damaged: {name} must be from 0 to 1, and has {outside[0]:g}"
                )
        if not 0 <= self.hedge <= 1:
            raise InvalidSceneError(f"this importance is damaged: its hedge is {self.hedge}, not from 0 to 1")

    def with_prior(
        self, splats: Splats, close_up: Float64[np.ndarray, " N"], coverage: Float64[np.ndarray, " N"], hedge: float
    ) -> Importance:
        """Importance for all cameras, not only for those of the images it was measured in.

        Logarithms of importance move towards those of a prior, what an unobstructed camera nearby would find: by
        ``hedge`` where a Gaussian was looked at from nearby, and all the way where no camera saw it. (Fitted to
        photographs of a scene, logarithms of importance from virtual cameras count 0.72, the prior 0.23.) Nothing
        falls below :data:`FLOOR` times ``hedge`` of the prior, whatever the images say.

        Args:
            splats: the scene.
            close_up: ``(N,)`` see :attr:`kissgs.rendering.coverage.Coverage.close_up`.
            coverage: ``(N,)`` from 0 to 1, see :class:`kissgs.rendering.coverage.Coverage`.
            hedge: from 0, the images' cameras are the only ones that matter, to 1, they say nothing.
        """
        coverage = coverage.astype(np.float32)
        known = (self.colors > 0) & (close_up > 0) & (coverage > LOOKED_AT)
        if not known.any():
            known = (self.colors > 0) & (close_up > 0)
        if hedge == 0 or not known.any():
            return replace(self, coverage=coverage, hedge=hedge)
        prior = float(np.median(self.colors[known] / close_up[known])) * close_up
        colors = np.maximum(self.colors.astype(np.float64), UNSEEN * prior)
        share = 1 - coverage.astype(np.float64) * (1 - hedge)
        hedged = np.maximum(colors ** (1 - share) * prior**share, FLOOR * hedge * prior)
        raised = np.where(colors > 0, hedged / np.maximum(colors, 1e-300), 1.0)
        least = colors - self.colors
        across = np.exp(-2.0 * np.sort(splats.scales, axis=1)[:, 1].astype(np.float64))
        forms = {}
        shapes = ((OPACITY, _seen_through(splats) ** 2), (SCALES, 1.0), (ROTATION, 1.0))
        for name, diagonals in (("shapes", shapes), ("places", (((0, 3, 5), across),))):
            values = getattr(self, name).astype(np.float64)
            for of, unit in diagonals:
                each = np.maximum(values[:, of].mean(axis=1), 0)
                ratio = float(np.median((each / (colors * unit))[known]))
                values[:, of] += (ratio * least * unit)[:, None]
            forms[name] = np.clip(values * raised[:, None], -LARGEST, LARGEST).astype(np.float32)
        return Importance(
            colors=hedged.astype(np.float32),
            directions=self.directions * np.float32(1 - hedge),
            guessed=np.maximum(hedged - self.colors, 0).astype(np.float32),
            coverage=coverage,
            captured=self.captured,
            hedge=hedge,
            **forms,
        )

    def diagonal(self, of: tuple[int, ...]) -> Float64[np.ndarray, "N n"]:
        """Costs of opacity, log-scales or rotation alone; never negative."""
        return np.maximum(self.shapes[:, of].astype(np.float64), 0)

    def base_colors(self) -> Float64[np.ndarray, " N"]:
        """Costs of one coefficient of ``sh0``."""
        return self.colors.astype(np.float64) * SH_C0**2

    def removal(self, splats: Splats) -> Float64[np.ndarray, " N"]:
        """What it costs to leave a Gaussian out: the score of GaussianPOP, section 3.

        The picture is linear in alpha; a logit moves alpha by (1 - opacity) of itself, a removal by all of it. So this
        follows from the form of the opacity.
        """
        return self.diagonal(OPACITY)[:, 0] / _seen_through(splats) ** 2


def _seen_through(splats: Splats) -> Float64[np.ndarray, " N"]:
    """1 - opacity; at least 1e-7, for logits that :func:`kissgs.clean` would not leave so large."""
    return 1 / (1 + np.exp(np.clip(splats.opacities.astype(np.float64), None, 16)))
