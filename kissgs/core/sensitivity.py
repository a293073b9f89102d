"""``Sensitivity``: what a change of each stored value costs in the pictures of a scene, whoever measured it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats

UNSEEN = 1e-3
"""Least sensitivity, in units of what it would be if nothing were before a Gaussian."""

FLOOR = 0.55
"""Least sensitivity where cameras were virtual, in units of the prior times the view uncertainty: a camera nearby still
finds the Gaussian within a few decibels of what its neighbours keep."""

LOOKED_AT = 0.2
"""Coverage from which on a Gaussian was seen well enough to tell what its like are worth."""

LARGEST = 1e25
"""Of a cost: beyond it stand Gaussians so large that squares overflow, and sums of costs would be infinite."""

OPACITY, SCALES, ROTATION = (0,), (7, 13, 18), (22, 25, 27)
"""Where the diagonal entries of a shape's form stand."""


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Quadratic forms: the mean squared error of a scene's pictures that small changes of each Gaussian cause.

    The error is the mean over pictures, pixels and RGB from 0 to 1, so that -10 log10 of a sum of such costs is the
    PSNR that they lead to, as far as the errors of different Gaussians are independent.

    Attributes:
        position_hessian: ``(N, 6)``, upper triangle of the Hessian by position, world units: xx, xy, xz, yy, yz, zz.
        shape_hessian: ``(N, 28)``, upper triangle, row by row, of the Hessian by (opacity logit; three log-scales; a
            rotation vector, radians, about the Gaussian's own axes). Its 48 equivalent descriptions only permute it.
        color_weight: ``(N,)``, of one channel of the colour from 0 to 1: mean of (alpha T)², a third.
        mean_sh_basis: ``(N, K)`` mean of the spherical harmonics without the constant one, over the directions from
            which the Gaussian is seen, K as in its scene; 0 where it is not seen.
        prior: ``(N,)`` the part of ``color_weight`` that was not measured, see :meth:`with_prior`.
        coverage: ``(N,)`` from 0, no camera saw the Gaussian or all from far away, to 1, one looked at it from nearby.
        captured: ``(N,)`` the same for the cameras of a capture alone, which say where people look.
        view_uncertainty: from 0 to 1, how little the pictures are taken to say of other pictures.
    """

    position_hessian: Float32[np.ndarray, "N 6"]
    shape_hessian: Float32[np.ndarray, "N 28"]
    color_weight: Float32[np.ndarray, " N"]
    mean_sh_basis: Float32[np.ndarray, "N K"]
    prior: Float32[np.ndarray, " N"]
    coverage: Float32[np.ndarray, " N"]
    captured: Float32[np.ndarray, " N"]
    view_uncertainty: float = 0.0

    @classmethod
    def none(cls, count: int, sh_degree: int) -> Sensitivity:
        """Of a scene that nobody has looked at."""
        return cls(
            position_hessian=np.zeros((count, 6), np.float32),
            shape_hessian=np.zeros((count, 28), np.float32),
            color_weight=np.zeros(count, np.float32),
            mean_sh_basis=np.zeros((count, SH_REST_COUNTS[sh_degree]), np.float32),
            prior=np.zeros(count, np.float32),
            coverage=np.zeros(count, np.float32),
            captured=np.zeros(count, np.float32),
        )

    def check(self, splats: Splats) -> None:
        """See that this is the sensitivity of such a scene.

        Raises:
            InvalidSceneError: it has another number of Gaussians or another SH degree, or values that no costs have, or
                coverage that is not from 0 to 1.
        """
        wanted = Sensitivity.none(len(splats), splats.sh_degree)
        for name in (
            "position_hessian",
            "shape_hessian",
            "color_weight",
            "mean_sh_basis",
            "prior",
            "coverage",
            "captured",
        ):
            found, shape = getattr(self, name), getattr(wanted, name).shape
            if found.shape != shape or found.dtype != np.float32:
                raise InvalidSceneError(
                    f"this sensitivity is not that of the scene: {name} must be {shape} float32, and is {found.shape} "
                    f"{found.dtype}; measure it for the scene as it is compressed"
                )
            if not np.isfinite(found).all() or (name in ("color_weight", "prior") and (found < 0).any()):
                raise InvalidSceneError(f"this sensitivity is damaged: {name} has a value that is no cost; measure it")
        for name in ("coverage", "captured"):
            found = getattr(self, name)
            outside = found[(found < 0) | (found > 1)]
            if len(outside):
                raise InvalidSceneError(
                    f"this sensitivity is damaged: {name} must be from 0 to 1, and has {outside[0]:g}"
                )
        if not 0 <= self.view_uncertainty <= 1:
            raise InvalidSceneError(
                f"this sensitivity is damaged: its view_uncertainty is {self.view_uncertainty}, not from 0 to 1"
            )

    def with_prior(
        self,
        splats: Splats,
        close_up: Float64[np.ndarray, " N"],
        coverage: Float64[np.ndarray, " N"],
        view_uncertainty: float,
    ) -> Sensitivity:
        """Sensitivity for all cameras, not only for those of the images it was measured in.

        Logarithms of sensitivity move towards those of a prior, what an unobstructed camera nearby would find: by
        ``view_uncertainty`` where a Gaussian was looked at from nearby, and all the way where no camera saw it. (Fitted
        to photographs of a scene, logarithms of sensitivity from virtual cameras count 0.72, the prior 0.23.) Nothing
        falls below :data:`FLOOR` times ``view_uncertainty`` of the prior, whatever the images say.

        Args:
            splats: the scene.
            close_up: ``(N,)`` see :attr:`kissgs.rendering.coverage.Coverage.close_up`.
            coverage: ``(N,)`` from 0 to 1, see :class:`kissgs.rendering.coverage.Coverage`.
            view_uncertainty: from 0, the images' cameras are the only ones that matter, to 1, they say nothing.
        """
        coverage = coverage.astype(np.float32)
        known = (self.color_weight > 0) & (close_up > 0) & (coverage > LOOKED_AT)
        if not known.any():
            known = (self.color_weight > 0) & (close_up > 0)
        if view_uncertainty == 0 or not known.any():
            return replace(self, coverage=coverage, view_uncertainty=view_uncertainty)
        prior = float(np.median(self.color_weight[known] / close_up[known])) * close_up
        colors = np.maximum(self.color_weight.astype(np.float64), UNSEEN * prior)
        share = 1 - coverage.astype(np.float64) * (1 - view_uncertainty)
        hedged = np.maximum(colors ** (1 - share) * prior**share, FLOOR * view_uncertainty * prior)
        raised = np.where(colors > 0, hedged / np.maximum(colors, 1e-300), 1.0)
        least = colors - self.color_weight
        across = np.exp(-2.0 * np.sort(splats.scales, axis=1)[:, 1].astype(np.float64))
        forms = {}
        shapes = ((OPACITY, _seen_through(splats) ** 2), (SCALES, 1.0), (ROTATION, 1.0))
        for name, diagonals in (("shape_hessian", shapes), ("position_hessian", (((0, 3, 5), across),))):
            values = getattr(self, name).astype(np.float64)
            for of, unit in diagonals:
                each = np.maximum(values[:, of].mean(axis=1), 0)
                ratio = float(np.median((each / (colors * unit))[known]))
                values[:, of] += (ratio * least * unit)[:, None]
            forms[name] = np.clip(values * raised[:, None], -LARGEST, LARGEST).astype(np.float32)
        return Sensitivity(
            color_weight=hedged.astype(np.float32),
            mean_sh_basis=self.mean_sh_basis * np.float32(1 - view_uncertainty),
            prior=np.maximum(hedged - self.color_weight, 0).astype(np.float32),
            coverage=coverage,
            captured=self.captured,
            view_uncertainty=view_uncertainty,
            **forms,
        )

    def diagonal(self, of: tuple[int, ...]) -> Float64[np.ndarray, "N n"]:
        """Costs of opacity, log-scales or rotation alone; never negative."""
        return np.maximum(self.shape_hessian[:, of].astype(np.float64), 0)

    def base_colors(self) -> Float64[np.ndarray, " N"]:
        """Costs of one coefficient of ``sh0``."""
        return self.color_weight.astype(np.float64) * SH_C0**2

    def removal(self, splats: Splats) -> Float64[np.ndarray, " N"]:
        """What it costs to leave a Gaussian out: the score of GaussianPOP, section 3.

        The picture is linear in alpha; a logit moves alpha by (1 - opacity) of itself, a removal by all of it. So this
        follows from the form of the opacity.
        """
        return self.diagonal(OPACITY)[:, 0] / _seen_through(splats) ** 2


def _seen_through(splats: Splats) -> Float64[np.ndarray, " N"]:
    """1 - opacity; at least 1e-7, for logits that :func:`kissgs.clean` would not leave so large."""
    return 1 / (1 + np.exp(np.clip(splats.opacities.astype(np.float64), None, 16)))
