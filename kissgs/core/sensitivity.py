"""``Sensitivity``: the squared image error that changes of the stored parameters cause."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from kissgs.core.array_types import Float, Float32, Float64, Int
from kissgs.core.errors import InvalidSceneError
from kissgs.core.splats import SH_C0, SH_REST_COUNTS, Splats, blocks

UNSEEN = 1e-3  # smallest colour sensitivity, in units of the prior, which ignores occlusion

FLOOR = 0.55
"""Smallest sensitivity, in units of the prior times the view uncertainty, so that for a camera nearby the Gaussian's
quality is within a few decibels of its neighbours'."""

SEEN_COVERAGE = 0.2  # coverage above which a Gaussian was seen well enough to scale the prior by
LARGEST = 1e25  # Hessian entry: squares of enormous Gaussians overflow, and sums of costs would be infinite
HARMONICS_TOLERANCE = 1.001  # factor by which the squares of mean harmonics may exceed their largest sum by rounding
OPACITY, SCALES, ROTATION = (0,), (4, 5, 6), (7, 8, 9)  # indices of the diagonal entries in shape_hessian
POSITION = (0, 1, 2)  # indices of the diagonal entries in position_hessian
RATIO_SAMPLE = 1 << 18  # largest number of Gaussians from which ratios of sensitivities are estimated


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivity:
    """Quadratic model of the mean squared image error that small changes of each Gaussian cause.

    The error is the mean over images, pixels and RGB from 0 to 1, so -10 log10 of a sum of such errors is the PSNR, as
    far as the errors of different Gaussians are independent.

    Attributes:
        position_hessian: ``(N, 3)``, diagonal of the Hessian by position, world units: xx, yy, zz.
        shape_hessian: ``(N, 10)``, entries of the Hessian by (opacity logit; three log-scales; a rotation vector about
            the Gaussian's own axes, radians): the opacity; opacity and each scale; each scale; each rotation. The 48
            equivalent forms only permute them. The other entries hardly change any decision, and are left out.
        color_weight: ``(N,)`` weight of one colour channel, 0 to 1: mean of (alpha T)², divided by 3.
        mean_harmonics: ``(N, K)`` means of the spherical harmonics without the constant one, over the directions from
            which the Gaussian is seen, K as in its scene; 0 if it is not seen.
        higher_harmonics: ``(N, H)`` the same of the degrees above that of the scene up to twice it, so that the means
            of all products are known: H is 33 at degree 3, 16 at 2, 5 at 1. Only with a capture among the cameras,
            which shows where viewers are; else H is 0.
        prior: ``(N,)`` the part of ``color_weight`` that was not measured, see :meth:`with_prior`.
        coverage: ``(N,)`` from 0, no camera saw the Gaussian or only from far away, to 1, one saw it from nearby.
        captured: ``(N,)`` coverage by the cameras of a capture alone, which show where people look.
        view_uncertainty: from 0 to 1, how strongly sensitivity is shrunk towards the prior for unseen views.
    """

    position_hessian: Float32[np.ndarray, "N 3"]
    shape_hessian: Float32[np.ndarray, "N 10"]
    color_weight: Float32[np.ndarray, " N"]
    mean_harmonics: Float32[np.ndarray, "N K"]
    higher_harmonics: Float32[np.ndarray, "N H"]
    prior: Float32[np.ndarray, " N"]
    coverage: Float32[np.ndarray, " N"]
    captured: Float32[np.ndarray, " N"]
    view_uncertainty: float = 0.0

    @classmethod
    def none(cls, count: int, sh_degree: int, *, captured: bool = False) -> Sensitivity:
        """Return the sensitivity of a scene that no camera has seen: zeros; ``captured`` decides about H."""
        higher = (2 * sh_degree + 1) ** 2 - (sh_degree + 1) ** 2 if captured else 0
        return cls(
            position_hessian=np.zeros((count, 3), np.float32),
            shape_hessian=np.zeros((count, 10), np.float32),
            color_weight=np.zeros(count, np.float32),
            mean_harmonics=np.zeros((count, SH_REST_COUNTS[sh_degree]), np.float32),
            higher_harmonics=np.zeros((count, higher), np.float32),
            prior=np.zeros(count, np.float32),
            coverage=np.zeros(count, np.float32),
            captured=np.zeros(count, np.float32),
        )

    def check(self, splats: Splats) -> None:
        """Check that this is a valid sensitivity of ``splats``.

        Raises:
            InvalidSceneError: wrong shapes or dtypes for the scene, values that are not finite, negative weights, or
                coverage or view uncertainty outside 0 to 1.
        """
        wanted = Sensitivity.none(len(splats), splats.sh_degree, captured=self.higher_harmonics.shape[-1] > 0)
        for name in (each.name for each in fields(self) if each.name != "view_uncertainty"):
            found, shape = getattr(self, name), getattr(wanted, name).shape
            if found.shape != shape or found.dtype != np.float32:
                raise InvalidSceneError(
                    f"the sensitivity does not fit the scene: {name} must be {shape} float32, not {found.shape} "
                    f"{found.dtype}; measure it for the scene that is compressed"
                )
            if not np.isfinite(found).all() or (name in ("color_weight", "prior") and (found < 0).any()):
                raise _damaged(f"{name} has a negative or non-finite value")
        for name in ("coverage", "captured"):
            found = getattr(self, name)
            outside = found[(found < 0) | (found > 1)]
            if len(outside):
                raise _damaged(f"{name} must be from 0 to 1, and has {outside[0]:g}")
        if not self._harmonics_are_means(splats.sh_degree):
            raise _damaged("mean_harmonics or higher_harmonics are no means of spherical harmonics")
        if not 0 <= self.view_uncertainty <= 1:
            raise _damaged(f"view_uncertainty must be from 0 to 1, not {self.view_uncertainty}")

    def _harmonics_are_means(self, sh_degree: int) -> bool:
        """Whether the squares of each degree n add up to (2 n + 1) / (4 pi) at most, as they do in each direction."""
        first = 0
        values = np.concatenate([self.mean_harmonics, self.higher_harmonics], axis=1)
        for degree in range(1, (2 if self.higher_harmonics.shape[1] else 1) * sh_degree + 1):
            last = first + 2 * degree + 1
            squares = np.square(values[:, first:last], dtype=np.float64).sum(axis=1)
            if squares.max(initial=0) > HARMONICS_TOLERANCE * (2 * degree + 1) / (4 * np.pi):
                return False
            first = last
        return True

    def with_prior(
        self,
        splats: Splats,
        close_up: Float[np.ndarray, " N"],
        coverage: Float[np.ndarray, " N"],
        view_uncertainty: float,
    ) -> Sensitivity:
        """Return sensitivity for all cameras, not only for those that it was measured with.

        The logarithm of sensitivity is shrunk towards that of a prior, the sensitivity for an unobstructed camera
        nearby: by ``view_uncertainty`` for Gaussians seen from nearby, and completely for those that no camera saw.
        (Fitted to photographs of a scene, logarithms of sensitivity from virtual cameras have weight 0.72, the prior
        0.23.) The result is at least :data:`FLOOR` · ``view_uncertainty`` times the prior.

        The arrays of this object become those of the result, so that large scenes need no second set of them. The class
        ``Coverage`` of :mod:`kissgs.rendering.sensitivity` explains ``close_up`` and ``coverage``.
        """
        coverage = coverage.astype(np.float32)
        known = (self.color_weight > 0) & (close_up > 0) & (coverage > SEEN_COVERAGE)
        if not known.any():
            known = (self.color_weight > 0) & (close_up > 0)
        if view_uncertainty == 0 or not known.any():
            return replace(self, coverage=coverage, view_uncertainty=view_uncertainty)
        some = np.flatnonzero(known)
        some = some[:: -(-len(some) // RATIO_SAMPLE)]
        near, measured = close_up[some].astype(np.float64), self.color_weight[some].astype(np.float64)
        per_close_up = float(np.median(measured / near))
        colors = np.maximum(measured, UNSEEN * per_close_up * near)
        ratios = []
        for values, of, unit in self._diagonals(splats, some):
            each = np.maximum(values[some][:, list(of)].mean(axis=1, dtype=np.float64), 0)
            ratios.append(float(np.median(each / (colors * unit))))
        for rows in blocks(len(splats)):
            prior = per_close_up * close_up[rows].astype(np.float64)
            measured = self.color_weight[rows].astype(np.float64)
            colors = np.maximum(measured, UNSEEN * prior)
            share = 1 - coverage[rows].astype(np.float64) * (1 - view_uncertainty)
            shrunk = np.maximum(colors ** (1 - share) * prior**share, FLOOR * view_uncertainty * prior)
            raised = np.where(colors > 0, shrunk / np.maximum(colors, 1e-300), 1.0)
            for ratio, (values, of, unit) in zip(ratios, self._diagonals(splats, rows), strict=True):
                for column in of:
                    values[rows, column] += ratio * (colors - measured) * unit
            for values in (self.shape_hessian[rows], self.position_hessian[rows]):
                np.clip(values * raised[:, None], -LARGEST, LARGEST, out=values)
            self.color_weight[rows], self.prior[rows] = shrunk, np.maximum(shrunk - measured, 0)
            for values in (self.mean_harmonics[rows], self.higher_harmonics[rows]):
                values *= np.float32(1 - view_uncertainty)
        return replace(self, coverage=coverage, view_uncertainty=view_uncertainty)

    def _diagonals(
        self, splats: Splats, rows: slice | Int[np.ndarray, " n"]
    ) -> list[tuple[np.ndarray, tuple[int, ...], Float64[np.ndarray, " n"] | float]]:
        """Return Hessians, their diagonal entries, and the factor by which these differ from a colour sensitivity."""
        across = np.exp(-2.0 * np.median(splats.scales[rows], axis=1).astype(np.float64))
        return [
            (self.shape_hessian, OPACITY, _transparency(splats.opacities[rows]) ** 2),
            (self.shape_hessian, SCALES, 1.0),
            (self.shape_hessian, ROTATION, 1.0),
            (self.position_hessian, POSITION, across),
        ]

    def diagonal(self, of: tuple[int, ...]) -> Float64[np.ndarray, "N n"]:
        """Return diagonal entries of ``shape_hessian``, at least 0; ``of`` is OPACITY, SCALES or ROTATION."""
        return np.maximum(self.shape_hessian[:, of].astype(np.float64), 0)

    def base_colors(self) -> Float64[np.ndarray, " N"]:
        """Return the squared error per squared unit of one coefficient of ``sh0``."""
        return self.color_weight.astype(np.float64) * SH_C0**2

    def removal(self, splats: Splats) -> Float64[np.ndarray, " N"]:
        """Return the squared error of removing each Gaussian, the score of GaussianPOP, section 3.

        The image is linear in alpha; the derivative of alpha by the logit is (1 - opacity) alpha, a removal changes
        alpha by all of it. So the score follows from the Hessian's opacity entry.
        """
        return self.diagonal(OPACITY)[:, 0] / _transparency(splats.opacities) ** 2


def _damaged(problem: str) -> InvalidSceneError:
    return InvalidSceneError(f"the sensitivity is damaged: {problem}; measure it again")


def _transparency(opacities: Float32[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Return 1 - opacity, at least 1e-7, the value of the largest logits that :func:`kissgs.clean` allows or more."""
    return 1 / (1 + np.exp(np.clip(opacities.astype(np.float64), None, 16)))
