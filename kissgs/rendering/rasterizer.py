"""The rasteriser: Gaussians and a camera -> a picture. On the processor by kissgs' own kernels, on CUDA by gsplat.

What a picture is stands in :mod:`kissgs.rendering.constants`. This module is for NumPy and does without torch unless
``device`` asks for CUDA; with gradients it is :func:`kissgs.rendering.differentiable.rasterize`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats
from kissgs.core.threads import Workers
from kissgs.rendering.camera import Camera

Device = Literal["cpu", "cuda"]
Colour = Sequence[float]

BLACK: Colour = (0.0, 0.0, 0.0)


def render(
    splats: Splats, camera: Camera, *, background: Colour = BLACK, threads: int = 0, device: Device = "cpu"
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Take a picture.

    Args:
        splats: finite (:func:`kissgs.clean`).
        camera: from where.
        background: RGB from 0 to 1, what is seen where no Gaussian is.
        threads: of the processor; 0 means one each. The picture does not depend on it.
        device: ``"cuda"`` needs the extra ``kissgs[cuda]``.

    Returns:
        The picture, from 0 to 1 where the scene is (some SH overshoot: clamp to show it), and its alpha.

    The first picture on a machine compiles the kernels, which takes some seconds; :func:`load_kernels` does it ahead.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: the picture would take too much memory; no CUDA here.
    """
    if device == "cuda":
        from kissgs.rendering.gsplat_backend import image_renderer

        return image_renderer(splats)(camera, background)
    from kissgs.rendering.cpu.frame import draw

    with Workers(threads) as pool:
        frame = draw(splats, camera, np.asarray(background, np.float32), pool)
    return frame.image, 1 - frame.transmittance


def removal_scores(
    splats: Splats,
    cameras: Sequence[Camera],
    *,
    background: Colour = BLACK,
    threads: int = 0,
    progress: Progress = silent,
) -> Float64[np.ndarray, " N"]:
    """For each Gaussian, the squared error over all pictures that its removal alone would cause.

    The score of GaussianPOP (section 3), exact but for what lies behind the end of a pixel's list. Summed over pixels
    and RGB in [0, 1]; 0 for what no camera sees.

    Args:
        splats: finite.
        cameras: pictures to take.
        background: of all of them.
        threads: 0 means one per processor; the scores do not depend on it.
        progress: receives the stage ``"score"``.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: a picture would take too much memory.
    """
    from kissgs.rendering.cpu.frame import draw
    from kissgs.rendering.cpu.frame import removal_scores as of_frame

    scores = np.zeros(len(splats), np.float64)
    colour = np.asarray(background, np.float32)
    with Workers(threads) as pool:
        for done, camera in enumerate(cameras):
            progress("score", done / len(cameras))
            scores += of_frame(draw(splats, camera, colour, pool), pool)
    progress("score", 1.0)
    return scores


def load_kernels(progress: Progress = silent) -> None:
    """Compile the rasteriser's kernels, or load them from numba's cache of earlier times."""
    progress("kernels", 0.0)
    from kissgs.rendering import ssim_kernels
    from kissgs.rendering.cpu import frame  # noqa: F401

    del ssim_kernels
    progress("kernels", 1.0)
