"""Cameras for parts of a scene that drawn cameras overlook: whose loss would hardly change any of their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.camera_sampling import BACKGROUNDS, FIELDS_OF_VIEW, PATIENCE, THUMBNAIL, Point, aim, direction
from kissgs.evaluation.parts import Part, find_parts
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

MOST_ADDED = 72
"""Cameras that are added, at most."""

NOTICED = 18.0
"""Decibels between thumbnails with and without a part: where there are no more, full pictures have at most about 20."""

FILLING = (0.6, 1.6)
"""Distances from which to look at a part, in those from which the sphere around it just fits the picture."""


@dataclass(frozen=True, slots=True, eq=False)
class Added:
    """A camera that looks at a part.

    Attributes:
        camera: for a full picture.
        target: the middle of the part.
        background: grey level, the one of :data:`BACKGROUNDS` over which its loss shows best.
        psnr: of thumbnails with and without the part, decibels.
    """

    camera: Camera
    target: Point
    background: float
    psnr: float


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """What stands apart in a scene, and how much of it the pictures so far show.

    Attributes:
        splats: finite.
        parts: see :func:`kissgs.evaluation.parts.find_parts`.
        part_of: ``(N,)`` the part of each Gaussian, -1 for none.
    """

    splats: Splats
    parts: list[Part]
    part_of: Int[np.ndarray, " N"]

    @classmethod
    def of(cls, splats: Splats, counts: Float64[np.ndarray, " N"]) -> Parts:
        """See :func:`kissgs.evaluation.parts.find_parts`."""
        return cls(splats, *find_parts(splats, counts))

    def shares(self, weights: Float64[np.ndarray, " N"], pixels: int) -> Float64[np.ndarray, " P"]:
        """The share of a picture that each part takes up, given the Gaussians' weights in it."""
        return np.bincount(self.part_of + 1, weights, minlength=len(self.parts) + 1)[1:] / pixels

    def overlooked(
        self, shares: Float64[np.ndarray, "V P"], views: Sequence[tuple[Camera, float]], pool: Workers
    ) -> list[int]:
        """Parts that could be lost with hardly a change of the view that shows most of them; the least shown first.

        Args:
            shares: see :meth:`shares`, for each of the views.
            views: cameras, and the grey level of their backgrounds.
            pool: of threads.
        """

        def psnr(part: int) -> float:
            camera, background = views[int(shares[:, part].argmax())]
            return self._psnrs_without(part, camera, (background,))[0]

        order = [int(part) for part in np.argsort(shares.max(axis=0), kind="stable")]
        return [part for part, found in zip(order, pool.map(psnr, order), strict=True) if found > NOTICED]

    def cameras_for(
        self, parts: Sequence[int], size: tuple[int, int], rng: np.random.Generator, pool: Workers
    ) -> list[Added]:
        """A camera for each, drawn anew until the loss of the part shows; the best one where that never is the case.

        Args:
            parts: their numbers.
            size: of pictures, pixels.
            rng: draws cameras, part after part.
            pool: of threads.
        """
        best: dict[int, Added] = {}
        left = list(parts)
        for _ in range(PATIENCE):
            drawn = [(part, self._look_at(self.parts[part], size, rng)) for part in left]
            for part, found in zip(left, pool.map(lambda each: self._added(*each), drawn), strict=True):
                if part not in best or found.psnr < best[part].psnr:
                    best[part] = found
            left = [part for part in left if best[part].psnr > NOTICED]
        return [best[part] for part in parts]

    def _look_at(self, part: Part, size: tuple[int, int], rng: np.random.Generator) -> Camera:
        fov = float(rng.uniform(*FIELDS_OF_VIEW))
        narrow = np.arctan(np.tan(fov / 2) * min(size) / max(size))
        distance = part.radius / np.sin(narrow) * np.exp(rng.uniform(*np.log(FILLING)))
        return aim(part.middle + distance * direction(rng), part.middle, fov, size)

    def _added(self, part: int, camera: Camera) -> Added:
        psnrs = self._psnrs_without(part, camera, BACKGROUNDS)
        least = int(np.argmin(psnrs))
        return Added(camera, self.parts[part].middle, BACKGROUNDS[least], psnrs[least])

    def _psnrs_without(self, part: int, camera: Camera, backgrounds: Sequence[float]) -> list[float]:
        """Of thumbnails with and without a part, over each of these backgrounds."""
        others, pictures = self.splats.select(np.flatnonzero(self.part_of != part)), []
        with Workers(1) as alone:
            for scene in (self.splats, others):
                frame = draw(scene, camera.at_most(THUMBNAIL), np.zeros(3, np.float32), alone)
                pictures.append((frame.image, frame.transmittance[:, :, None]))
        return [_psnr(*(np.clip(image + grey * through, 0, 1) for image, through in pictures)) for grey in backgrounds]


def _psnr(one: Float32[np.ndarray, "H W 3"], other: Float32[np.ndarray, "H W 3"]) -> float:
    return -10 * float(np.log10(max(float(np.mean(np.square(one - other), dtype=np.float64)), 1e-12)))
