"""Regularization in training: of the shapes of Gaussians, and of opacities, by ADMM."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from kissgs.core.array_types import Float
from kissgs.rendering.differentiable import Parameters
from kissgs.training.loop import Regularizer

# Regularization of the shapes of Gaussians during training: neither needles nor balls.

EPSILON = 1e-7  # added to effective rank - 1: the loss of a perfect needle is 16.1


def erank_loss(scales: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
    """Return the effective-rank loss max(-ln(erank - 1 + EPSILON), 0): 0 for discs and balls, 16.1 for needles. Hyung
    et al., "Effective Rank Analysis and Regularization for Enhanced 3D Gaussian Splatting" (NeurIPS 2024), equation 9.
    The effective rank is e^H, from 1 to 3, with the entropy H of the shares s² / Σ s². It is computed from logarithms
    relative to the largest scale: nothing under- or overflows whatever the scales, and erank - 1 = expm1(H) keeps its
    digits for needles."""
    descending = scales.sort(dim=1, descending=True).values
    log_ratios = 2 * (descending[:, 1:] - descending[:, :1])  # logarithms of the other two s², the largest being 1
    log_total = torch.log1p(log_ratios.exp().sum(dim=1))
    # all terms are positive, so that no digit is lost
    entropy = log_total - ((log_ratios - log_total[:, None]).exp() * log_ratios).sum(dim=1)
    return (-torch.log(torch.expm1(entropy) + EPSILON)).clamp_min(0)


class ShapeRegularizer(Regularizer):
    """Regularizer: weighted mean of :func:`erank_loss`, plus weighted mean of each Gaussian's smallest scale, world
    units, which flattens Gaussians. Means as in the published code; the paper (equation 1) writes sums."""

    def __init__(self, erank_weight: float, min_scale_weight: float) -> None:
        self._erank_weight, self._min_scale_weight = erank_weight, min_scale_weight

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the loss over all Gaussians, visible or not; None for an empty scene."""
        scales = parameters["scales"]
        if len(scales) == 0:
            return None
        loss = self._erank_weight * erank_loss(scales).mean()
        return loss + self._min_scale_weight * scales.amin(dim=1).exp().mean()


# Sparsification of opacities by ADMM: opacities of the candidates for pruning are pulled to 0 during training.


class AdmmSparsifier(Regularizer):
    """Regularizer: minimise the loss subject to at most ``count`` opacities other than 0.

    Zhang et al., "GaussianSpa: An Optimizing-Sparsifying Simplification Framework for Compact and High-Quality 3D
    Gaussian Splatting" (CVPR 2025), section 4, as scaled ADMM: with the opacities o, 0 to 1, their sparse copy z and
    the dual variable u, every ``interval`` steps, before the optimiser's, as in the published code,

    - the loss of the step has the penalty rho/2 · ‖o - z + u‖²,
    - z becomes o + u with all but its ``count`` largest entries set to 0, and u becomes u + o - z.
    """

    def __init__(self, opacities: Float[Tensor, " N"], count: int, rho: float, interval: int) -> None:
        """Start with z from the current opacities and u = 0."""
        self._count, self._rho, self._interval = count, rho, interval
        activated = _sigmoid(opacities.detach())
        self.z, self.u = keep_largest(activated, count), torch.zeros_like(activated)

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Return the penalty in every ``interval``-th step, and update z and u; None in the others."""
        if (step + 1) % self._interval:
            return None
        activated = _sigmoid(parameters["opacities"])
        penalty = 0.5 * self._rho * (activated - self.z + self.u).square().sum()
        known = activated.detach()
        self.z = keep_largest(known + self.u, self._count)
        self.u = self.u + known - self.z
        return penalty

    def state(self) -> dict[str, np.ndarray]:
        """Return z and u for a checkpoint, see :meth:`restore`."""
        return {"z": self.z.cpu().numpy(), "u": self.u.cpu().numpy()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state`."""
        self.z, self.u = (torch.from_numpy(state[name].copy()).to(self.z.device) for name in ("z", "u"))


def keep_largest(values: Float[Tensor, " N"], count: int) -> Float[Tensor, " N"]:
    """Return a copy with all but the ``count`` largest entries set to 0; of equal entries the first are kept."""
    largest = torch.argsort(values, descending=True, stable=True)[:count]
    sparse = torch.zeros_like(values)
    sparse[largest] = values[largest]
    return sparse


def _sigmoid(logits: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """Return the sigmoid; the last bit of torch's own depends on the number of threads."""
    return 1 / (1 + torch.exp(-logits))
