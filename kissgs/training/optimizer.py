"""``PrunableAdam``: numbers that are being learned, and what Adam remembers of each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kissgs.core.array_types import Int
from kissgs.core.errors import UnsupportedError

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("training is torch's, which is missing: pip install 'kissgs[train]'") from error

MOMENTS = ("exp_avg", "exp_avg_sq")
LARGEST = 1e15
"""Of a gradient: its square is still a float32."""


class PrunableAdam:
    """PrunableAdam of torch by name, and the Adam that moves them.

    Args:
        leaves: float32, one row for each thing that is learned about; copied.
    """

    def __init__(self, leaves: Mapping[str, Tensor]) -> None:
        own = {name: leaf.detach().clone().requires_grad_() for name, leaf in leaves.items()}
        self._adam = torch.optim.Adam(
            [{"params": [leaf], "name": name} for name, leaf in own.items()], lr=0.0, eps=1e-15, fused=True
        )

    @property
    def by_name(self) -> dict[str, Tensor]:
        """As they are now: :meth:`keep` replaces them."""
        return {group["name"]: group["params"][0] for group in self._adam.param_groups}

    def step(self, rates: Mapping[str, float]) -> None:
        """Move all against their gradients, at these learning rates, and forget the gradients.

        A gradient that is no number counts as none.
        """
        for group in self._adam.param_groups:
            group["lr"] = rates[group["name"]]
            gradient = group["params"][0].grad
            if gradient is not None:
                gradient.nan_to_num_(0.0, 0.0, 0.0).clamp_(-LARGEST, LARGEST)
        self._adam.step()
        self._adam.zero_grad()

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Leave all but the rows at ``index`` out; what Adam remembers of these stays with them."""
        for group in self._adam.param_groups:
            old = group["params"][0]
            rows = torch.from_numpy(index).to(old.device)
            state = self._adam.state.pop(old, {})
            leaf = old.detach()[rows].requires_grad_()
            group["params"] = [leaf]
            if state:
                self._adam.state[leaf] = {"step": state["step"], **{name: state[name][rows] for name in MOMENTS}}

    def state(self) -> dict[str, np.ndarray]:
        """Everything, to go on from later: see :meth:`restore`."""
        arrays = {}
        for name, leaf in self.by_name.items():
            arrays[name] = leaf.detach().cpu().numpy()
            for part, value in self._adam.state.get(leaf, {}).items():
                arrays[f"{name}.{part}"] = value.cpu().numpy()
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on exactly as those would have whose :meth:`state` this was; of the same shapes."""
        for name, leaf in self.by_name.items():
            with torch.no_grad():
                leaf.copy_(torch.from_numpy(state[name].copy()))
            parts = {part: state[f"{name}.{part}"] for part in ("step", *MOMENTS) if f"{name}.{part}" in state}
            if parts:
                self._adam.state[leaf] = {
                    part: torch.from_numpy(value.copy()).to(leaf.device) for part, value in parts.items()
                }
