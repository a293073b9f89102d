"""LPIPS, the perceptual distance, through the ``lpips`` package (the extra ``kissgs[lpips]``)."""

from __future__ import annotations

import http.client
import importlib
import warnings

import numpy as np

from kissgs.core.array_types import Shaped
from kissgs.core.errors import UnsupportedError
from kissgs.rendering.metrics import image_pair

SMALLEST = 16  # pixels: the network halves its input four times


class Lpips:
    """LPIPS with VGG-16: from 0 for equal images up to about 1. Load it once, call it often.

    It is what papers on Gaussian splatting report: the evaluation script of 3DGS hands images in [0, 1] to the
    network, although that was calibrated on [-1, 1], and everyone after has kept to it. So does this.

    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018.
    """

    def __init__(self, device: str = "cpu") -> None:
        """Load the network, which torchvision downloads the first time: 528 MB.

        Raises:
            UnsupportedError: the packages are not installed, or the weights cannot be had.
        """
        try:
            package = importlib.import_module("lpips")
        except ModuleNotFoundError as error:
            raise UnsupportedError(
                f"LPIPS needs packages that are not installed ({error}): pip install 'kissgs[lpips]'"
            ) from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # how lpips asks torchvision for weights is out of fashion
                self._network = package.LPIPS(net="vgg", verbose=False).to(device)
        except (OSError, RuntimeError, http.client.HTTPException) as error:
            raise UnsupportedError(
                f"LPIPS could not load the weights of its network, vgg16, which torchvision downloads on first use "
                f"({error}): construct kissgs.rendering.lpips.Lpips once while online, or copy the file into the "
                f"folder checkpoints of torch.hub.get_dir()"
            ) from error
        self._device = device

    def __call__(self, image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
        """Distance of two images ``(H, W, 3)``, in [0, 1] or uint8. NaN in either makes it NaN.

        Raises:
            InvalidViewsError: the arrays are not two images of the same size.
            UnsupportedError: the images are smaller than 16x16 pixels.
        """
        import torch

        pair = image_pair(image, reference)
        height, width, _ = pair[0].shape
        if min(height, width) < SMALLEST:
            raise UnsupportedError(f"LPIPS needs images of at least {SMALLEST}x{SMALLEST} pixels, not {width}x{height}")
        first, second = (torch.from_numpy(side).to(self._device).permute(2, 0, 1)[None] for side in pair)
        with torch.no_grad():
            return float(self._network(first, second).item())
