"""``GaussianModel``: a scene with trainable parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from kissgs.core.array_types import Float32, Int
from kissgs.core.errors import UnsupportedError
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
from kissgs.rendering.cpu.backward import Gradients
from kissgs.rendering.rasterizer import Device
from kissgs.rendering.tensors import tensors_of
from kissgs.training.optimizer import PrunableAdam

try:
    import torch
    from torch import Tensor
except ModuleNotFoundError as error:
    raise UnsupportedError("training needs torch, which is missing: pip install 'kissgs[train]'") from error

BOUNDS = {
    "means": (-0.999 * MEAN_LIMIT, 0.999 * MEAN_LIMIT),  # float32 could round up
    "scales": (-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT),
    "opacities": (OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX),
    "sh0": (-SH_LIMIT, SH_LIMIT),
    "shN": (-SH_LIMIT, SH_LIMIT),
}
"""Smallest and largest values that :func:`kissgs.core.splats.clean` leaves unchanged."""


class GaussianModel:
    """The stored parameters of a scene as torch tensors, optimised by Adam."""

    def __init__(
        self, splats: Splats, device: Device = "cpu", extents: Float32[np.ndarray, " N"] | None = None
    ) -> None:
        """Copy a scene."""
        extents = np.ones(len(splats), np.float32) if extents is None else extents
        self._adam = PrunableAdam(tensors_of(splats, device), BOUNDS, {"means": torch.from_numpy(extents)})
        self._rest = splats.select(slice(0))
        self._received: list[Gradients] = []
        self._on_cpu = device == "cpu"

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Float32 parameters by their names in :class:`kissgs.core.splats.Splats`; :meth:`keep` replaces them."""
        return self._adam.parameters

    @property
    def receive(self) -> Callable[[Gradients], None] | None:
        """Receiver of gradients of images, for :meth:`step`, on the CPU; elsewhere autograd provides them."""
        return self.add_gradients if self._on_cpu else None

    @property
    def antialiased(self) -> bool:
        """See :class:`kissgs.Splats`."""
        return self._rest.antialiased

    def add_gradients(self, gradients: Gradients) -> None:
        """Add gradients of an image to those of the next :meth:`step`, on the CPU."""
        self._received.append(gradients)

    def gaussians(self) -> dict[str, Tensor]:
        """Return the parameters themselves."""
        return self.parameters

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an Adam step at these learning rates, and clear the gradients.

        Values are clamped to :data:`BOUNDS`; NaN and infinite gradients count as 0.
        """
        if self._received:
            found = Gradients.sum(self._received)
            of_rows = {name: getattr(found, name) for name in ATTRIBUTES}
            self._adam.step(rates, (found.gaussians, of_rows))
            self._received.clear()
        else:
            self._adam.step(rates)

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Keep only the Gaussians at ``index``, with their Adam moments."""
        self._adam.keep(index)

    def splats(self) -> Splats:
        """Return a clean copy of the current scene."""
        arrays: dict[str, Any] = {
            name: tensor.detach().cpu().numpy().copy() for name, tensor in self.parameters.items()
        }
        return clean(replace(self._rest, **arrays))[0]

    def state(self) -> dict[str, np.ndarray]:
        """Return the full state as arrays, see :meth:`restored`."""
        return self._adam.state()

    @classmethod
    def restored(
        cls,
        state: Mapping[str, np.ndarray],
        scene: Splats,
        device: Device = "cpu",
        extents: Float32[np.ndarray, " N"] | None = None,
    ) -> GaussianModel:
        """Return a model that continues exactly from a :meth:`state`."""
        arrays: dict[str, Any] = {name: state[name] for name in ATTRIBUTES}
        model = cls(replace(scene, **arrays), device, extents)
        model._adam.restore(state)
        return model
