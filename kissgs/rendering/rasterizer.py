"""The rasteriser for NumPy: an image of a scene, on the CPU by kissgs' own kernels, on CUDA by gsplat.

:mod:`kissgs.rendering.constants` defines the image. Torch is needed on CUDA only. With gradients, the rasteriser is
:func:`kissgs.rendering.differentiable.rasterize`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from kissgs.core.array_types import Float32, Float64
from kissgs.core.progress import Progress, silent
from kissgs.core.resources import Workers
from kissgs.core.splats import Splats
from kissgs.rendering.camera import Camera

Device = Literal["cpu", "cuda"]
Colour = Sequence[float]

BLACK: Colour = (0.0, 0.0, 0.0)


def render(
    splats: Splats, camera: Camera, *, background: Colour = BLACK, threads: int = 0, device: Device = "cpu"
) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Render an image of a scene.

    The first image on a computer compiles the kernels, which takes some seconds; :func:`load_kernels` does it in
    advance.

    Args:
        splats: a finite scene (:func:`kissgs.clean`).
        camera: the camera, with the size of the image.
        background: RGB from 0 to 1.
        threads: number of CPU threads; 0 means one per processor. The image does not depend on it.
        device: "cpu" or "cuda", which needs the extra ``kissgs[cuda]``.

    Returns:
        The image ``(H, W, 3)``, RGB, 0 and up, not clamped to 1 (SH may overshoot), and its alpha ``(H, W)``, 0 to 1.

    Raises:
        InvalidViewsError: the background is not three finite numbers.
        UnsupportedError: the image would take too much memory, or CUDA cannot be used.
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
    """Return, for each Gaussian, the squared image error that its removal alone would cause.

    The score of GaussianPOP, section 3, exact except for Gaussians behind the end of a pixel's list. A sum over images,
    pixels and RGB in [0, 1]; 0 for a Gaussian that no camera sees.
    """
    from kissgs.rendering.cpu.frame import draw
    from kissgs.rendering.cpu.frame import removal_scores as frame_scores

    scores = np.zeros(len(splats), np.float64)
    colour = np.asarray(background, np.float32)
    with Workers(threads) as pool:
        for done, camera in enumerate(cameras):
            progress("score", done / len(cameras))
            scores += frame_scores(draw(splats, camera, colour, pool), pool)
    progress("score", 1.0)
    return scores
