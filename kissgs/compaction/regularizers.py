"""Regularization of the shapes of Gaussians during training: neither needles nor balls."""

from __future__ import annotations

import torch
from torch import Tensor

from kissgs.core.array_types import Float
from kissgs.training.loop import Parameters, TrainableScene

EPSILON = 1e-7
"""Added to effective rank - 1: the loss of a perfect needle is 16.1."""


def erank_loss(scales: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Return the effective-rank loss max(-ln(erank - 1 + EPSILON), 0): 0 for discs and balls, 16.1 for needles.

    Hyung et al., "Effective Rank Analysis and Regularization for Enhanced 3D Gaussian Splatting" (NeurIPS 2024),
    equation 9. The effective rank is e^H, from 1 to 3, with the entropy H of the shares s² / Σ s². It is computed from
    logarithms relative to the largest scale: nothing under- or overflows whatever the scales, and erank - 1 = expm1(H)
    keeps its digits for needles.

    Args:
        scales: ``(N, 3)`` natural logarithms of standard deviations, any finite values. Each component of the gradient
            is at most 2 in absolute value.

    Returns:
        ``(N,)`` losses, 0 or more.
    """
    descending = scales.sort(dim=1, descending=True).values
    log_ratios = 2 * (descending[:, 1:] - descending[:, :1])  # logarithms of the other two s², the largest being 1
    log_total = torch.log1p(log_ratios.exp().sum(dim=1))
    # all terms are positive, so that no digit is lost
    entropy = log_total - ((log_ratios - log_total[:, None]).exp() * log_ratios).sum(dim=1)
    return (-torch.log(torch.expm1(entropy) + EPSILON)).clamp_min(0)


class ShapeRegularizer:
    """Regularizer: weighted mean of :func:`erank_loss`, plus weighted mean of each Gaussian's smallest scale.

    The second term flattens Gaussians. It is in units of ``extent``, so that the loss does not depend on the size of
    the scene.
    """

    def __init__(self, erank_weight: float, min_scale_weight: float, extent: float) -> None:
        """Set the weights, 0 or more; ``extent`` is that of the cameras, world units, above 0."""
        self._erank_weight, self._min_scale_weight = erank_weight, min_scale_weight / extent

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the loss over all Gaussians, visible or not; None for an empty scene."""
        scales = parameters["scales"]
        if len(scales) == 0:
            return None
        loss = self._erank_weight * erank_loss(scales).mean()
        return loss + self._min_scale_weight * scales.amin(dim=1).exp().mean()

    def update(self, step: int, scene: TrainableScene) -> None:
        """Do nothing: the loss has no state."""
