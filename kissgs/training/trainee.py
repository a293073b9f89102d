"""``Trainee``: a scene whose parameters are being fitted, and what Adam remembers of each Gaussian."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kissgs._typing import Int
from kissgs.errors import UnsupportedError
from kissgs.rendering.differentiable import tensors_of
from kissgs.rendering.rasterizer import Device
from kissgs.splats import (
    ATTRIBUTES,
    LOG_SCALE_LIMIT,
    MEAN_LIMIT,
    OPACITY_LOGIT_MAX,
    OPACITY_LOGIT_MIN,
    SH_LIMIT,
    Splats,
    clean,
)

try:
    import torch
    from torch import Tensor
except ImportError as error:
    raise UnsupportedError("training is torch's, which is missing: pip install 'kissgs[train]'") from error

MOMENTS = ("exp_avg", "exp_avg_sq")
BOUNDS = {
    "means": (-0.999 * MEAN_LIMIT, 0.999 * MEAN_LIMIT),  # float32 could round up
    "scales": (-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT),
    "opacities": (OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX),
    "sh0": (-SH_LIMIT, SH_LIMIT),
    "shN": (-SH_LIMIT, SH_LIMIT),
}
"""What :func:`kissgs.splats.clean` would change or remove."""
LARGEST = 1e15
"""Of a gradient: its square is still a float32."""


class Trainee:
    """The stored parameters of a scene as leaves of torch, and the Adam that moves them.

    Attributes:
        parameters: by their names in :class:`kissgs.splats.Splats`, float32, with gradients.
    """

    def __init__(self, splats: Splats, device: Device = "cpu") -> None:
        """``splats`` is copied; it must be clean."""
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in tensors_of(splats, device).items()}
        self._adam = torch.optim.Adam(
            [{"params": [leaves[name]], "name": name} for name in ATTRIBUTES], lr=0.0, eps=1e-15, fused=True
        )

    @property
    def parameters(self) -> dict[str, Tensor]:
        """By name, the leaves as they are now: :meth:`keep` replaces them."""
        return {group["name"]: group["params"][0] for group in self._adam.param_groups}

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self, rates: Mapping[str, float]) -> None:
        """Move all parameters against their gradients, at these learning rates, and forget the gradients.

        What a stored scene cannot hold is kept out: values stay within the bounds of :func:`kissgs.splats.clean`, and
        a gradient that is no number counts as none.
        """
        for group in self._adam.param_groups:
            group["lr"] = rates[group["name"]]
            gradient = group["params"][0].grad
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0).clamp_(-LARGEST, LARGEST)
        self._adam.step()
        self._adam.zero_grad()
        with torch.no_grad():
            for name, (least, most) in BOUNDS.items():
                self.parameters[name].clamp_(least, most)

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Leave all but the Gaussians at ``index`` out; what Adam remembers of these stays with them."""
        for group in self._adam.param_groups:
            old = group["params"][0]
            rows = torch.from_numpy(index).to(old.device)
            state = self._adam.state.pop(old, {})
            leaf = old.detach()[rows].requires_grad_()
            group["params"] = [leaf]
            if state:
                self._adam.state[leaf] = {"step": state["step"], **{name: state[name][rows] for name in MOMENTS}}

    def splats(self) -> Splats:
        """A clean copy of the scene as it is now."""
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in self.parameters.items()}
        return clean(Splats(**arrays))[0]

    def state(self) -> dict[str, np.ndarray]:
        """Everything, to go on from later: see :meth:`restored`."""
        arrays = {}
        for name, tensor in self.parameters.items():
            arrays[name] = tensor.detach().cpu().numpy()
            for part, value in self._adam.state.get(tensor, {}).items():
                arrays[f"{name}.{part}"] = value.cpu().numpy()
        return arrays

    @classmethod
    def restored(cls, state: Mapping[str, np.ndarray], device: Device = "cpu") -> Trainee:
        """One that goes on exactly as the one whose :meth:`state` this was."""
        trainee = cls(Splats(**{name: state[name] for name in ATTRIBUTES}), device)
        for name, leaf in trainee.parameters.items():
            parts = {part: state[f"{name}.{part}"] for part in ("step", *MOMENTS) if f"{name}.{part}" in state}
            if parts:
                trainee._adam.state[leaf] = {
                    part: torch.from_numpy(value.copy()).to(device) for part, value in parts.items()
                }
        return trainee
