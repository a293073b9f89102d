"""Conversion of a scene to torch tensors."""

from __future__ import annotations

from collections.abc import Mapping

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("tensors need torch, which is not installed: pip install 'kissgs[train]'") from error

Parameters = Mapping[str, Tensor]
"""Stored parameters of a scene, by the names in :class:`kissgs.core.splats.Splats`."""


def tensors_of(splats: Splats, device: str = "cpu") -> dict[str, Tensor]:
    """Return the parameters by name, for :func:`kissgs.rendering.differentiable.rasterize`;
    on the CPU they share memory with ``splats``."""
    return {name: torch.from_numpy(getattr(splats, name)).to(device) for name in ATTRIBUTES}
