"""LDR-FLIP, a perceptual difference of images, by the package ``flip-evaluator`` (extra ``kissgs[flip]``)."""

from __future__ import annotations

import importlib

import numpy as np

from kissgs.core.array_types import Shaped
from kissgs.core.errors import UnsupportedError
from kissgs.rendering.metrics import image_pair


class Flip:
    """FLIP: from 0 for equal images to 1. Construct it once and call it often.

    It estimates the difference that an observer sees who flips between two images on a display with 67 pixels per
    degree of visual angle: a monitor of 3840 pixels and 0.7 m width, 0.7 m away.

    Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", Proceedings of the ACM on Computer Graphics
    and Interactive Techniques 3 (2020).
    """

    def __init__(self) -> None:
        """Load the package.

        Raises:
            UnsupportedError: the package is not installed.
        """
        try:
            self._package = importlib.import_module("flip_evaluator")
        except ModuleNotFoundError as error:
            raise UnsupportedError(
                f"FLIP needs a package that is not installed ({error}): pip install 'kissgs[flip]'"
            ) from error

    def __call__(self, image: Shaped[np.ndarray, "..."], reference: Shaped[np.ndarray, "..."]) -> float:
        """Return the mean over all pixels of two sRGB images ``(H, W, 3)``, floats or uint8; NaN if either has a NaN.

        Values are clamped to [0, 1].

        Raises:
            InvalidViewsError: the arrays are not two images of the same size.
        """
        first, second = (np.clip(pixels, 0, 1) for pixels in image_pair(image, reference))
        if np.isnan(first).any() or np.isnan(second).any():  # the package takes NaN for a value
            return float("nan")
        errors, *_ = self._package.evaluate(second, first, "LDR", applyMagma=False, computeMeanError=False)
        return float(errors.mean(dtype=np.float64))  # the package adds them up in float32
