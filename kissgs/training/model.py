"""``GaussianModel``: a scene whose parameters are being fitted."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from kissgs.core.array_types import Float32, Int
from kissgs.core.splats import (
    ATTRIBUTES,
    LOG_SCALE_LIMIT,
    MEAN_LIMIT,
    OPACITY_LOGIT_MAX,
    OPACITY_LOGIT_MIN,
    SH_LIMIT,
    Splats,
    clean,
)
from kissgs.rendering.rasterizer import Device
from kissgs.rendering.tensors import tensors_of
from kissgs.training.optimizer import PrunableAdam

BOUNDS = {
    "means": (-0.999 * MEAN_LIMIT, 0.999 * MEAN_LIMIT),  # float32 could round up
    "scales": (-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT),
    "opacities": (OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX),
    "sh0": (-SH_LIMIT, SH_LIMIT),
    "shN": (-SH_LIMIT, SH_LIMIT),
}
"""What :func:`kissgs.core.splats.clean` would change or remove."""


class GaussianModel:
    """The stored parameters of a scene as leaves of torch, and the Adam that moves them."""

    def __init__(self, splats: Splats, device: Device = "cpu", reach: Float32[np.ndarray, " N"] | None = None) -> None:
        """``splats`` is copied; it must be clean.

        ``reach`` is ``(N,)``, the length in which the learning rate of each Gaussian's position is given; by default 1.
        """
        self._leaves = PrunableAdam(tensors_of(splats, device))
        self._reach = torch.from_numpy(np.ones(len(splats), np.float32) if reach is None else reach)[:, None].to(device)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """By their names in :class:`kissgs.core.splats.Splats`, float32, with gradients; :meth:`keep` replaces them."""
        return self._leaves.by_name

    def gaussians(self) -> dict[str, Tensor]:
        """The parameters themselves."""
        return self.parameters

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self, rates: Mapping[str, float]) -> None:
        """Move all parameters against their gradients, at these learning rates, and forget the gradients.

        Values stay within the bounds of :func:`kissgs.core.splats.clean`; a gradient that is no number counts as none.
        """
        before = self.parameters["means"].detach().clone()
        longest = float(self._reach.max()) if len(self) else 1.0
        self._leaves.step({**rates, "means": rates["means"] * longest})
        with torch.no_grad():
            self.parameters["means"].sub_(before).mul_(self._reach / longest).add_(before)
            for name, (least, most) in BOUNDS.items():
                self.parameters[name].clamp_(least, most)

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Leave all but the Gaussians at ``index`` out; what Adam remembers of these stays with them."""
        self._leaves.keep(index)
        self._reach = self._reach[torch.from_numpy(index).to(self._reach.device)]

    def splats(self) -> Splats:
        """A clean copy of the scene as it is now."""
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.parameters.items()}
        return clean(Splats(**arrays))[0]

    def state(self) -> dict[str, np.ndarray]:
        """Everything, to go on from later: see :meth:`restored`."""
        return self._leaves.state()

    @classmethod
    def restored(
        cls, state: Mapping[str, np.ndarray], device: Device = "cpu", reach: Float32[np.ndarray, " N"] | None = None
    ) -> GaussianModel:
        """One that goes on exactly as the one whose :meth:`state` this was, if its ``reach`` was the same."""
        model = cls(Splats(**{name: state[name] for name in ATTRIBUTES}), device, reach)
        model._leaves.restore(state)
        return model
