"""``Importance``: what a change of each stored value costs in the pictures of a scene, whoever measured it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32, Float64
from kissgs.errors import InvalidSceneError
from kissgs.splats import SH_C0, SH_REST_COUNTS, Splats

UNSEEN = 1e-3
"""Least importance, in units of what it would be if nothing were before a Gaussian."""

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
        guessed: ``(N,)`` the part of ``colors`` that was not measured, see :meth:`hedged`.
        hedge: from 0 to 1, how little the pictures are taken to say of other pictures.
    """

    places: Float32[np.ndarray, "N 6"]
    shapes: Float32[np.ndarray, "N 28"]
    colors: Float32[np.ndarray, " N"]
    directions: Float32[np.ndarray, "N K"]
    guessed: Float32[np.ndarray, " N"]
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
        )

    def check(self, splats: Splats) -> None:
        """See that this is the importance of such a scene.

        Raises:
            InvalidSceneError: it has another number of Gaussians or another SH degree, or values that no costs have.
        """
        wanted = Importance.none(len(splats), splats.sh_degree)
        for name in ("places", "shapes", "colors", "directions", "guessed"):
            found, shape = getattr(self, name), getattr(wanted, name).shape
            if found.shape != shape or found.dtype != np.float32:
                raise InvalidSceneError(
                    f"this importance is not that of the scene: {name} must be {shape} float32, and is {found.shape} "
                    f"{found.dtype}; measure it for the scene as it is compressed"
                )
            if not np.isfinite(found).all() or (name in ("colors", "guessed") and (found < 0).any()):
                raise InvalidSceneError(f"this importance is damaged: {name} has a value that is no cost; measure it")
        if not 0 <= self.hedge <= 1:
            raise InvalidSceneError(f"this importance is damaged: its hedge is {self.hedge}, not from 0 to 1")

    def hedged(self, splats: Splats, exposed: Float64[np.ndarray, " N"], share: float) -> Importance:
        """What it probably is for cameras other than those of the pictures, which see what was hidden from these.

        Logarithms of importance move by ``share`` towards a guess: what each Gaussian would weigh if nothing were
        before it. (Fitted to photographs of a scene, logarithms of importance from virtual cameras count 0.64, that
        guess 0.29, and what is left varies half as much as before.)

        Args:
            splats: the scene.
            exposed: ``(N,)`` mean of (alpha)² in the pictures, if nothing were before each Gaussian and all were in
                the picture.
            share: from 0 to 1.
        """
        known = (self.colors > 0) & (exposed > 0)
        if share == 0 or not known.any():
            return self
        guess = float(np.median(self.colors[known] / exposed[known])) * exposed
        colors = np.maximum(self.colors.astype(np.float64), UNSEEN * guess)
        least = colors - self.colors
        places = np.exp(-2.0 * np.sort(splats.scales, axis=1)[:, 1].astype(np.float64))
        raised = np.where(colors > 0, (guess / np.maximum(colors, 1e-300)) ** share, 1.0)
        forms = {}
        shapes = ((OPACITY, _seen_through(splats) ** 2), (SCALES, 1.0), (ROTATION, 1.0))
        for name, diagonals in (("shapes", shapes), ("places", (((0, 3, 5), places),))):
            values = getattr(self, name).astype(np.float64)
            for of, unit in diagonals:
                each = np.maximum(values[:, of].mean(axis=1), 0)
                ratio = float(np.median((each / (colors * unit))[known]))
                values[:, of] += (ratio * least * unit)[:, None]
            forms[name] = np.clip(values * raised[:, None], -LARGEST, LARGEST).astype(np.float32)
        hedged = colors * raised
        guessed = np.maximum(hedged - self.colors, 0)
        return Importance(
            colors=hedged.astype(np.float32),
            directions=self.directions * np.float32(1 - share),
            guessed=guessed.astype(np.float32),
            hedge=share,
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
