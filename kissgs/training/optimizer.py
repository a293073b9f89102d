"""``PrunableAdam``: Adam over named tensors whose rows can be removed during training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.errors import UnsupportedError

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("training needs torch, which is missing: pip install 'kissgs[train]'") from error

MOMENTS = ("exp_avg", "exp_avg_sq")
"""Names of the moments in the state of ``torch.optim.Adam``."""

MAX_GRADIENT = 1e15
"""Largest absolute value of a gradient: its square is still a finite float32."""


class PrunableAdam:
    """Named parameters and the Adam that optimises them.

    Args:
        values: initial float32 values by name; copied. Rows are what :meth:`keep` selects.
    """

    def __init__(self, values: Mapping[str, Tensor]) -> None:
        parameters = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
        self._adam = torch.optim.Adam(
            [{"params": [parameter], "name": name} for name, parameter in parameters.items()],
            lr=0.0,
            eps=1e-15,
            fused=True,
        )

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Current parameters by name; :meth:`keep` replaces them."""
        return {group["name"]: group["params"][0] for group in self._adam.param_groups}

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an Adam step at these learning rates, and clear the gradients.

        NaN and infinite gradients count as 0, others are clamped to :data:`MAX_GRADIENT`.
        """
        for group in self._adam.param_groups:
            group["lr"] = rates[group["name"]]
            gradient = group["params"][0].grad
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0).clamp_(-MAX_GRADIENT, MAX_GRADIENT)
        self._adam.step()
        self._adam.zero_grad()

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Keep only the rows at ``index``, with their moments."""
        for group in self._adam.param_groups:
            old = group["params"][0]
            rows = torch.from_numpy(index).to(old.device)
            state = self._adam.state.pop(old, {})
            parameter = old.detach()[rows].requires_grad_()
            group["params"] = [parameter]
            if state:
                self._adam.state[parameter] = {"step": state["step"], **{name: state[name][rows] for name in MOMENTS}}

    def state(self) -> dict[str, np.ndarray]:
        """Return parameters and Adam's state as arrays, see :meth:`restore`."""
        arrays = {}
        for name, parameter in self.parameters.items():
            arrays[name] = parameter.detach().cpu().numpy()
            for part, value in self._adam.state.get(parameter, {}).items():
                arrays[f"{name}.{part}"] = value.cpu().numpy()
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state` of parameters of equal shapes."""
        for name, parameter in self.parameters.items():
            with torch.no_grad():
                parameter.copy_(torch.from_numpy(state[name].copy()))
            parts = {part: state[f"{name}.{part}"] for part in ("step", *MOMENTS) if f"{name}.{part}" in state}
            if parts:
                self._adam.state[parameter] = {
                    part: torch.from_numpy(value.copy()).to(parameter.device) for part, value in parts.items()
                }
