"""Training targets: cameras with photographs, or with renderings of the original scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kissgs.core.array_types import Float32, Shaped
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera
from kissgs.rendering.gsplat_backend import ImageRenderer, image_renderer
from kissgs.rendering.rasterizer import Device, render
from kissgs.training.supervision import SupervisionViews

NEAREST_CAMERAS, EXTENT_RATIO = 4, 4.0
"""The local extent of the cameras is estimated as 4 times the distance to the 4th nearest camera."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingTargets:
    """Cameras and their target images.

    Attributes:
        cameras: one or more cameras.
        images: ``(H, W, 3)`` target of each camera: a photograph in uint8, or a rendering in float16 from 0 to 1.
        backgrounds: ``(3,)`` RGB from 0 to 1 of each camera.
        target_source: "photos" if any target is a photograph, else "renderings".
        synthetic: number of the last cameras, virtual ones beside a capture, which take turns.
        synthetic_per_epoch: number of these that have a step in each epoch, at most ``synthetic``.
    """

    cameras: tuple[Camera, ...]
    images: tuple[Shaped[np.ndarray, "H W 3"], ...]
    backgrounds: tuple[Float32[np.ndarray, "3"], ...]
    target_source: Literal["photos", "renderings"]
    synthetic: int = 0
    synthetic_per_epoch: int = 0

    def __len__(self) -> int:
        return len(self.cameras)

    def image(self, n: int) -> Float32[np.ndarray, "H W 3"]:
        """Return the target image of camera ``n``, values from 0 to 1."""
        image = self.images[n]
        return image.astype(np.float32) / np.float32(255 if image.dtype == np.uint8 else 1)

    def order(self, seed: Sequence[int], first: int = 0) -> Iterator[int]:
        """Yield the index of the target for step ``first`` and each later one.

        Each epoch has all targets but the synthetic ones, and the next few of these, in random order.
        The order depends on the seed and the step only, so that training can be resumed at any step.
        """
        always, some = len(self) - self.synthetic, self.synthetic_per_epoch
        turns = np.random.default_rng(seed).permutation(self.synthetic)
        count = always + some
        while True:
            epoch, begin = divmod(first, count)
            turn = turns.take(range(epoch * some, (epoch + 1) * some), mode="wrap")
            targets = np.concatenate([np.arange(always), always + turn])
            yield from np.random.default_rng([*seed, epoch]).permutation(targets)[begin:].tolist()
            first += count - begin

    @property
    def extent(self) -> float:
        """Extent of the cameras, world units: 1.1 times the largest distance to their mean position, as in 3DGS.

        0 if all cameras are at one position. Synthetic ones do not count.
        """
        cameras = self.cameras[: len(self) - self.synthetic]
        positions = np.array([camera.position for camera in cameras])
        return 1.1 * float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())

    def local_extents(self, means: Float32[np.ndarray, "N 3"], largest: float) -> Float32[np.ndarray, " N"]:
        """Return the extent of the cameras around each of these points, world units, above 0 and at most ``largest``.

        If a scene has several objects with cameras around each, the extent of all cameras does not represent the size
        of one object. For a scene of one object, most points get ``largest``. Synthetic cameras count: an object that
        was not photographed has no others.

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
    supervision: SupervisionViews,
    *,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> TrainingTargets:
    """Load the photographs of the training views, and render ``reference`` for those that have none.

    Args:
        reference: the original scene, finite.
        supervision: one or more training views.
        threads: number of threads; 0 means one per processor.
        device: device that renders.
        progress: receives the stage ``"targets"``.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: an image would take too much memory.
    """
    views, background = supervision.train, supervision.background
    renderer, images = _renderer(reference, threads, device), []
    backgrounds = tuple(background if view.background is None else view.background for view in views)
    for done, view in enumerate(views):
        progress("targets", done / len(views))
        if view.photo is not None:
            images.append(view.load_photo())
        else:
            images.append(np.clip(renderer(view.camera, backgrounds[done].tolist())[0], 0, 1).astype(np.float16))
    progress("targets", 1.0)
    return TrainingTargets(
        cameras=tuple(view.camera for view in views),
        images=tuple(images),
        backgrounds=backgrounds,
        target_source="photos" if any(view.photo is not None for view in views) else "renderings",
        synthetic=supervision.synthetic,
        synthetic_per_epoch=supervision.synthetic_per_epoch,
    )


def _renderer(reference: Splats, threads: int, device: Device) -> ImageRenderer:
    if device == "cuda":
        return image_renderer(reference)
    return lambda camera, background: render(reference, camera, background=background, threads=threads)
