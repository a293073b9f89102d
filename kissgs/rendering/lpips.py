"""LPIPS, a perceptual distance of images, by the package ``lpips`` (extra ``kissgs[lpips]``)."""

from __future__ import annotations

import http.client
import importlib
import warnings

import numpy as np

from kissgs.core.array_types import Shaped
from kissgs.core.errors import UnsupportedError
from kissgs.rendering.metrics import image_pair

MIN_SIDE = 16
"""Smallest side of an image, pixels: the network halves its input four times."""


class Lpips:
    """LPIPS with VGG-16: from 0 for equal images up to about 1. Construct it once and call it often.

    This is the LPIPS of papers on Gaussian splatting: like the evaluation script of 3DGS, it passes images in [0, 1] to
    the network, which was calibrated on [-1, 1].

    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.
    """

    def __init__(self, device: str = "cpu") -> None:
        """Load the network, whose weights (528 MB) torchvision downloads on first use.

        Raises:
            UnsupportedError: the packages are not installed, or the weights cannot be loaded.
        """
        try:
            package = importlib.import_module("lpips")
        except ModuleNotFoundError as error:
            raise UnsupportedError(
                f"LPIPS needs packages that are not installed ({error}): pip install 'kissgs[lpips]'"
            ) from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # lpips loads weights by a deprecated function of torchvision
                self._network = package.LPIPS(net="vgg", verbose=False).to(device)
        except (OSError, RuntimeError, http.client.HTTPException) as error:
            raise UnsupportedError(
                f"LPIPS could not load the weights of its network, vgg16, which torchvision downloads on first use "
                f"({error}): construct kissgs.rendering.lpips.Lpips once while online, or copy the file into the "
                f"folder checkpoints of torch.hub.get_dir()"
            ) from error
        self._device = device

    def __call__(self, image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
        """Return the distance of two images ``(H, W, 3)``, floats in [0, 1] or uint8; NaN if either has a NaN.

        Raises:
            InvalidViewsError: the arrays are not two images of the same size.
            UnsupportedError: a side is below :data:`MIN_SIDE`.
        """
        import torch

        pair = image_pair(image, reference)
        height, width, _ = pair[0].shape
        if min(height, width) < MIN_SIDE:
            raise UnsupportedError(f"LPIPS needs images of at least {MIN_SIDE}x{MIN_SIDE} pixels, not {width}x{height}")
        first, second = (torch.from_numpy(array).to(self._device).permute(2, 0, 1)[None] for array in pair)
        with torch.no_grad():
            return float(self._network(first, second).item())
