"""A scene's parameters as torch tensors."""

from __future__ import annotations

from kissgs.core.errors import UnsupportedError
from kissgs.core.splats import ATTRIBUTES, Splats

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("tensors are torch's, which is missing: pip install 'kissgs[train]'") from error


def tensors_of(splats: Splats, device: str = "cpu") -> dict[str, Tensor]:
    """The scene's parameters by name, as :func:`kissgs.rendering.differentiable.rasterize` takes
    them; on the processor they share its memory."""
    return {name: torch.from_numpy(getattr(splats, name)).to(device) for name in ATTRIBUTES}
