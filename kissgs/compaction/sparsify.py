"""Sparsifying opacities by ADMM: as many of them as shall go are drawn to 0, while the others take over their work."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from kissgs.core.array_types import Float
from kissgs.training.loop import Parameters, TrainableScene


class Sparsity:
    """GaussianSpa: minimise the loss subject to at most ``count`` opacities that are not 0.

    Zhang et al., "GaussianSpa: An Optimizing-Sparsifying Simplification Framework for Compact and High-Quality 3D
    Gaussian Splatting" (CVPR 2025), section 4, as scaled ADMM: with opacities o from 0 to 1, their sparse copy z and
    the dual u, every ``interval`` steps

    - the loss of that step has the penalty rho/2 · ‖o - z + u‖²,
    - then z becomes o + u with all but its ``count`` largest entries set to 0, and u becomes u + o - z.
    """

    def __init__(self, opacities: Float[Tensor, " N"], count: int, rho: float, interval: int) -> None:
        """``opacities`` are logits, as stored."""
        self._count, self._rho, self._interval = count, rho, interval
        activated = _sigmoid(opacities.detach())
        self.z, self.u = sparsest(activated, count), torch.zeros_like(activated)

    def penalty(self, step: int, parameters: Parameters) -> Tensor | None:
        """Every ``interval`` steps, as in the published code; nothing at the others."""
        if (step + 1) % self._interval:
            return None
        return 0.5 * self._rho * (_sigmoid(parameters["opacities"]) - self.z + self.u).square().sum()

    def update(self, step: int, scene: TrainableScene) -> None:
        """Sparsify, and move the dual."""
        if (step + 1) % self._interval:
            return
        with torch.no_grad():
            activated = _sigmoid(scene.gaussians()["opacities"])
            self.z = sparsest(activated + self.u, self._count)
            self.u += activated - self.z

    def state(self) -> dict[str, np.ndarray]:
        """To go on from later."""
        return {"z": self.z.cpu().numpy(), "u": self.u.cpu().numpy()}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from there."""
        self.z, self.u = (torch.from_numpy(state[name].copy()).to(self.z.device) for name in ("z", "u"))


def sparsest(values: Float[Tensor, " N"], count: int) -> Float[Tensor, " N"]:
    """The ``count`` largest entries, exactly so many, and 0 for all others; of equal ones the first are kept."""
    order = torch.argsort(values, descending=True, stable=True)[:count]
    sparse = torch.zeros_like(values)
    sparse[order] = values[order]
    return sparse


def _sigmoid(logits: Float[Tensor, " N"]) -> Float[Tensor, " N"]:
    """torch's own differs in the last bit where threads share it."""
    return 1 / (1 + torch.exp(-logits))
