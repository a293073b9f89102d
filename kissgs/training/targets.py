"""Training targets: cameras with photographs, or with renderings of the original scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kissgs.cameras.views import View
from kissgs.core.array_types import Float32, Shaped
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.gsplat_backend import ImageRenderer, image_renderer
from kissgs.rendering.rasterizer import Device, render

NEAREST_CAMERAS, EXTENT_RATIO = 4, 4.0
"""The local extent of the cameras is estimated as 4 times the distance to the 4th nearest camera."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingTargets:
    """Cameras and their target images.

    Attributes:
        cameras: one or more cameras.
        images: ``(H, W, 3)`` target of each camera: a photograph in uint8, or a rendering in float16 from 0 to 1.
        background: ``(3,)`` RGB from 0 to 1.
        target_source: "photos" if any target is a photograph, else "renderings".
    """

    cameras: tuple[Camera, ...]
    images: tuple[Shaped[np.ndarray, "H W 3"], ...]
    background: Float32[np.ndarray, "3"]
    target_source: Literal["photos", "renderings"]

    def __len__(self) -> int:
        return len(self.cameras)

    def image(self, n: int) -> Float32[np.ndarray, "H W 3"]:
        """Return the target image of camera ``n``, values from 0 to 1."""
        image = self.images[n]
        return image.astype(np.float32) / np.float32(255 if image.dtype == np.uint8 else 1)

    def order(self, seed: Sequence[int], first: int = 0) -> Iterator[int]:
        """Yield the index of the target for step ``first`` and each later one: a new random permutation per epoch.

        The order depends on the seed and the step only, so that training can be resumed at any step.
        """
        count = len(self)
        while True:
            epoch, begin = divmod(first, count)
            order = np.random.default_rng([*seed, epoch]).permutation(count)
            yield from order[begin:].tolist()
            first += count - begin

    @property
    def extent(self) -> float:
        """Extent of the cameras, world units: 1.1 times the largest distance to their mean position, as in 3DGS.

        0 if all cameras are at one position.
        """
        positions = np.array([camera.position for camera in self.cameras])
        return 1.1 * float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())

    def local_extents(self, means: Float32[np.ndarray, "N 3"], largest: float) -> Float32[np.ndarray, " N"]:
        """Return the extent of the cameras around each of these points, world units, above 0 and at most ``largest``.

        If a scene has several objects with cameras around each, the extent of all cameras does not represent the size
        of one object. For a scene of one object, most points get ``largest``.

        Args:
            means: ``(N, 3)`` points, world units.
            largest: upper limit, world units.
        """
        positions = np.array([camera.position for camera in self.cameras])
        nearest = np.full((len(means), min(NEAREST_CAMERAS, len(positions))), np.inf)
        for position in positions:
            distance = np.linalg.norm(means - position, axis=1)
            for rank in range(nearest.shape[1]):
                nearest[:, rank], distance = (
                    np.minimum(nearest[:, rank], distance),
                    np.maximum(nearest[:, rank], distance),
                )
        return np.clip(EXTENT_RATIO * nearest[:, -1], 1e-6 * largest, largest).astype(np.float32)


def training_targets(
    reference: Splats,
    views: Sequence[View],
    background: Float32[np.ndarray, "3"],
    *,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> TrainingTargets:
    """Load the photographs of ``views``, and render ``reference`` from those that have none.

    Args:
        reference: the original scene, finite.
        views: one or more views at the training resolution.
        background: ``(3,)`` RGB from 0 to 1.
        threads: number of threads; 0 means one per processor.
        device: device that renders.
        progress: receives the stage ``"targets"``.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: an image would take too much memory.
    """
    renderer, images = _renderer(reference, threads, device), []
    for done, view in enumerate(views):
        progress("targets", done / len(views))
        if view.photo is not None:
            images.append(view.load_photo())
        else:
            images.append(np.clip(renderer(view.camera, background.tolist())[0], 0, 1).astype(np.float16))
    progress("targets", 1.0)
    return TrainingTargets(
        cameras=tuple(view.camera for view in views),
        images=tuple(images),
        background=background,
        target_source="photos" if any(view.photo is not None for view in views) else "renderings",
    )


def _renderer(reference: Splats, threads: int, device: Device) -> ImageRenderer:
    if device == "cuda":
        return image_renderer(reference)
    return lambda camera, background: render(reference, camera, background=background, threads=threads)
