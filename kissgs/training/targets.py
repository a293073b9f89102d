"""What a scene is fitted to: photographs, or pictures of the scene itself as it was."""

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

AROUND, REACH = 4, 4.0
"""Distances to this nearest camera that the cameras about a place extend, about."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainingTargets:
    """Cameras and what they should see.

    Attributes:
        cameras: one or more.
        pictures: for each ``(H, W, 3)``: uint8 of photographs, float16 from 0 to 1 of renderings.
        background: ``(3,)`` RGB over which to render.
        target_source: where the pictures come from; "photos" if any is one.
    """

    cameras: tuple[Camera, ...]
    pictures: tuple[Shaped[np.ndarray, "H W 3"], ...]
    background: Float32[np.ndarray, "3"]
    target_source: Literal["photos", "renderings"]

    def __len__(self) -> int:
        return len(self.cameras)

    def picture(self, n: int) -> Float32[np.ndarray, "H W 3"]:
        """What the camera ``n`` should see, from 0 to 1."""
        picture = self.pictures[n]
        return picture.astype(np.float32) / np.float32(255 if picture.dtype == np.uint8 else 1)

    def order(self, seed: Sequence[int], first: int = 0) -> Iterator[int]:
        """Which to take at step ``first`` and those after it: all once in an order of chance, all again in another.

        It depends on nothing but the seed and the step, so that work can be taken up where it was left.
        """
        count = len(self)
        while True:
            round_, begin = divmod(first, count)
            order = np.random.default_rng([*seed, round_]).permutation(count)
            yield from order[begin:].tolist()
            first += count - begin

    @property
    def extent(self) -> float:
        """Of the cameras, world units: 1.1 times the greatest distance from their middle, as 3DGS measures a scene.

        0 where all stand in one place.
        """
        places = np.array([camera.position for camera in self.cameras])
        return 1.1 * float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())

    def reach(self, means: Float32[np.ndarray, "N 3"], longest: float) -> Float32[np.ndarray, " N"]:
        """Extent of the cameras about each of these places, ``(N,)``, world units, above 0 and at most ``longest``.

        The cameras of a scene of several objects stand about each of them, so that their extent in all says nothing
        about the size of one. Where all stand about one object, most places are given ``longest``.
        """
        places = np.array([camera.position for camera in self.cameras])
        nearest = np.full((len(means), min(AROUND, len(places))), np.inf)
        for place in places:
            distance = np.linalg.norm(means - place, axis=1)
            for rank in range(nearest.shape[1]):
                nearest[:, rank], distance = (
                    np.minimum(nearest[:, rank], distance),
                    np.maximum(nearest[:, rank], distance),
                )
        return np.clip(REACH * nearest[:, -1], 1e-6 * longest, longest).astype(np.float32)


def training_targets(
    reference: Splats,
    views: Sequence[View],
    background: Float32[np.ndarray, "3"],
    *,
    threads: int = 0,
    device: Device = "cpu",
    progress: Progress = silent,
) -> TrainingTargets:
    """The photographs of ``views``, and what ``reference`` looks like from those that have none.

    Args:
        reference: finite.
        views: at the size at which to learn; one or more.
        background: RGB over which to render.
        threads: 0 means one per processor.
        device: where the pictures are taken.
        progress: receives the stage ``"targets"``.

    Raises:
        InvalidViewsError: a photograph cannot be read.
        UnsupportedError: a picture would take too much memory.
    """
    take, pictures = _camera_man(reference, threads, device), []
    for done, view in enumerate(views):
        progress("targets", done / len(views))
        if view.photo is not None:
            pictures.append(view.load_photo())
        else:
            pictures.append(np.clip(take(view.camera, background.tolist())[0], 0, 1).astype(np.float16))
    progress("targets", 1.0)
    return TrainingTargets(
        cameras=tuple(view.camera for view in views),
        pictures=tuple(pictures),
        background=background,
        target_source="photos" if any(view.photo is not None for view in views) else "renderings",
    )


def _camera_man(reference: Splats, threads: int, device: Device) -> ImageRenderer:
    if device == "cuda":
        return image_renderer(reference)
    return lambda camera, background: render(reference, camera, background=background, threads=threads)
