"""Cameras for overlooked parts of a scene: parts whose loss would hardly change any image of the drawn cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kissgs.core.array_types import Float32, Float64, Int
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.evaluation.camera_sampling import (
    BACKGROUNDS,
    FIELDS_OF_VIEW,
    MAX_DRAWS,
    THUMBNAIL,
    Point,
    camera_at,
    random_direction,
)
from kissgs.evaluation.parts import Part, find_parts
from kissgs.rendering.camera import Camera
from kissgs.rendering.cpu.frame import draw

MAX_ADDED = 72
"""Largest number of added cameras."""

VISIBLE_PSNR = 18.0
"""Largest PSNR, decibels, between thumbnails with and without a part at which its loss counts as visible; between full
images it is then at most about 20."""

DISTANCES = (0.6, 1.6)
"""Smallest and largest distance of a camera to its part, in units of the distance at which the part's sphere just fits
into the image."""


@dataclass(frozen=True, slots=True, eq=False)
class AddedCamera:
    """A camera that was added for a part.

    Attributes:
        camera: the camera, at full image size.
        target: centre of the part.
        background: grey level of :data:`BACKGROUNDS` over which the loss of the part is most visible.
        psnr: PSNR between thumbnails with and without the part, decibels.
    """

    camera: Camera
    target: Point
    background: float
    psnr: float


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Separate parts of a scene.

    Attributes:
        splats: the scene, finite.
        parts: see :func:`kissgs.evaluation.parts.find_parts`.
        part_of: ``(N,)`` index of each Gaussian's part, -1 for none.
    """

    splats: Splats
    parts: list[Part]
    part_of: Int[np.ndarray, " N"]

    @classmethod
    def of(cls, splats: Splats, counts: Float64[np.ndarray, " N"]) -> Parts:
        """Find the parts of a scene, see :func:`kissgs.evaluation.parts.find_parts`."""
        return cls(splats, *find_parts(splats, counts))

    def shares(self, weights: Float64[np.ndarray, " N"], pixels: int) -> Float64[np.ndarray, " P"]:
        """Return the share of an image that each part covers, given the blending weights of all Gaussians in it."""
        return np.bincount(self.part_of + 1, weights, minlength=len(self.parts) + 1)[1:] / pixels

    def overlooked(
        self, shares: Float64[np.ndarray, "V P"], views: Sequence[tuple[Camera, float]], pool: Workers
    ) -> list[int]:
        """Return the parts whose loss hardly changes the view that shows them best, least visible parts first.

        Args:
            shares: share of each image that each part covers, see :meth:`shares`.
            views: cameras and the grey levels of their backgrounds.
            pool: threads.
        """

        def psnr(part: int) -> float:
            camera, background = views[int(shares[:, part].argmax())]
            return self._psnrs_without(part, camera, (background,))[0]

        order = [int(part) for part in np.argsort(shares.max(axis=0), kind="stable")]
        return [part for part, without in zip(order, pool.map(psnr, order), strict=True) if without > VISIBLE_PSNR]

    def cameras_for(
        self, parts: Sequence[int], size: tuple[int, int], rng: np.random.Generator, pool: Workers
    ) -> list[AddedCamera]:
        """Draw a camera for each part until its loss is visible; after the last attempt, return the best one.

        Args:
            parts: indices of the parts.
            size: width and height of the images, pixels.
            rng: draws cameras, part after part.
            pool: threads.
        """
        best: dict[int, AddedCamera] = {}
        remaining = list(parts)
        for _ in range(MAX_DRAWS):
            drawn = [(part, self._draw_camera(self.parts[part], size, rng)) for part in remaining]
            for part, added in zip(remaining, pool.map(lambda each: self._added(*each), drawn), strict=True):
                if part not in best or added.psnr < best[part].psnr:
                    best[part] = added
            remaining = [part for part in remaining if best[part].psnr > VISIBLE_PSNR]
        return [best[part] for part in parts]

    def _draw_camera(self, part: Part, size: tuple[int, int], rng: np.random.Generator) -> Camera:
        fov = float(rng.uniform(*FIELDS_OF_VIEW))
        narrow = np.arctan(np.tan(fov / 2) * min(size) / max(size))
        distance = part.radius / np.sin(narrow) * np.exp(rng.uniform(*np.log(DISTANCES)))
        return camera_at(part.center + distance * random_direction(rng), part.center, fov, size)

    def _added(self, part: int, camera: Camera) -> AddedCamera:
        psnrs = self._psnrs_without(part, camera, BACKGROUNDS)
        least = int(np.argmin(psnrs))
        return AddedCamera(camera, self.parts[part].center, BACKGROUNDS[least], psnrs[least])

    def _psnrs_without(self, part: int, camera: Camera, backgrounds: Sequence[float]) -> list[float]:
        """Return the PSNR between thumbnails with and without a part, over each of these grey backgrounds."""
        others, thumbnails = self.splats.select(np.flatnonzero(self.part_of != part)), []
        with Workers(1) as single:
            for scene in (self.splats, others):
                frame = draw(scene, camera.at_most(THUMBNAIL), np.zeros(3, np.float32), single)
                thumbnails.append((frame.image, frame.transmittance[:, :, None]))
        (image, transmittance), (other_image, other_transmittance) = thumbnails
        return [
            _psnr(np.clip(image + grey * transmittance, 0, 1), np.clip(other_image + grey * other_transmittance, 0, 1))
            for grey in backgrounds
        ]


def _psnr(one: Float32[np.ndarray, "H W 3"], other: Float32[np.ndarray, "H W 3"]) -> float:
    return -10 * float(np.log10(max(float(np.mean(np.square(one - other), dtype=np.float64)), 1e-12)))
