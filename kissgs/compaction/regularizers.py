"""What keeps Gaussians in shape while they are fitted to pictures: neither needles nor blobs."""

from __future__ import annotations

import torch
from torch import Tensor

from kissgs.core.array_types import Float
from kissgs.training.loop import Parameters, TrainableScene

EPSILON = 1e-7
"""Added to effective rank - 1: the loss of a perfect needle is 16.1."""


def needle_loss(scales: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """How far each Gaussian is from a disc towards a needle: max(-ln(erank - 1), 0); 0 for discs and rounder ones.

    Hyung et al., "Effective Rank Analysis and Regularization for Enhanced 3D Gaussian Splatting" (NeurIPS 2024),
    equation 9. The effective rank e^H, from 1 to 3, has the entropy H of the shares s² / Σ s². All is computed from
    logarithms, relative to the widest: nothing under- or overflows whatever the scales, and erank - 1 = expm1(H) keeps
    its digits at needles.

    Args:
        scales: natural logarithms, any finite values. The gradient is bounded by 2.
    """
    widest_first = scales.sort(dim=1, descending=True).values
    below = 2 * (widest_first[:, 1:] - widest_first[:, :1])  # logarithms of the other two s², the widest being 1
    total = torch.log1p(below.exp().sum(dim=1))
    entropy = total - ((below - total[:, None]).exp() * below).sum(dim=1)  # all terms positive: no digit is lost
    return (-torch.log(torch.expm1(entropy) + EPSILON)).clamp_min(0)


class Shape:
    """The loss of effective-rank regularisation: the mean of :func:`needle_loss`, and that of the smallest scale.

    The second flattens what is round. It is measured in units of ``extent``, so that a scene's size does not matter.
    """

    def __init__(self, erank_weight: float, min_scale_weight: float, extent: float) -> None:
        self._needle_weight, self._flat_weight = erank_weight, min_scale_weight / extent

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Of all Gaussians, seen or not."""
        scales = parameters["scales"]
        if len(scales) == 0:
            return None
        loss = self._needle_weight * needle_loss(scales).mean()
        return loss + self._flat_weight * scales.amin(dim=1).exp().mean()

    def update(self, step: int, scene: TrainableScene) -> None:
        """Nothing is remembered."""
