"""The trained parameters of a scene, and their optimiser."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numba import njit

from kissgs.core.array_types import Float32, Int, Int32
from kissgs.core.context import TORCH_MISSING, Device, Workers
from kissgs.core.errors import UnsupportedError
from kissgs.core.numba_kernels import compiled
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
from kissgs.rendering.cpu.frame import Gradients
from kissgs.rendering.rasterizer import tensors_of

try:
    import torch
    from torch import Tensor
    from torch.optim.adam import adam as torch_adam
except ModuleNotFoundError as error:
    raise UnsupportedError(f"training needs {TORCH_MISSING}") from error

# Numba kernel of Adam: gradients of some rows, of all or both, in one pass over parameters and moments.
#
# Kingma and Ba, "Adam: A Method for Stochastic Optimization" (ICLR 2015), algorithm 1, with beta1 = 0.9, beta2 = 0.999
# and epsilon = 1e-15. A row without a gradient has the gradient 0: its moments decay, and it moves by what is left of
# them.

_FAST = {"contract", "nsz"}


@njit(nogil=True, error_model="numpy")
def _fill(
    rows: np.ndarray, gradient: np.ndarray, everywhere: np.ndarray, first: int, last: int, width: int, out: np.ndarray
) -> None:
    """Write the gradient of the parameter's rows ``first`` to ``last`` (exclusive) to ``out``."""
    if len(everywhere):
        out[: (last - first) * width] = everywhere[first * width : last * width]
    else:
        out[: (last - first) * width] = np.float32(0)
    for i in range(np.searchsorted(rows, first), np.searchsorted(rows, last)):
        start = (rows[i] - first) * width
        for c in range(width):
            out[start + c] += gradient[i * width + c]


@compiled(
    "void(float32[::1], float32[::1], float32[::1], int32[::1], float32[::1], float32[::1], float32[::1],"
    " int64, int64, int64, float32[::1])",
    fastmath=_FAST,
)
def adam(
    values: np.ndarray,
    mean: np.ndarray,
    square: np.ndarray,
    rows: np.ndarray,
    gradient: np.ndarray,
    everywhere: np.ndarray,
    factors: np.ndarray,
    width: int,
    first: int,
    last: int,
    constants: np.ndarray,
) -> None:
    """Make a step with the rows ``first`` to ``last`` (exclusive) of a parameter of ``width`` numbers; all are flat.
    ``gradient`` is that of ``rows``, which ascend; ``everywhere``, if not empty, is added for all rows; ``factors`` of
    the learning rate may be empty for 1. ``constants``: learning rate / (1 - beta1^t); 1 / sqrt(1 - beta2^t); the
    absolute value to which gradients are clamped; the smallest and the largest value that a step may reach."""
    rate, correction, most, smallest, largest = constants[0], constants[1], constants[2], constants[3], constants[4]
    zero, finite = np.float32(0), np.float32(3.4028234e38)
    keep1, keep2, add1, add2 = np.float32(0.9), np.float32(0.999), np.float32(0.1), np.float32(0.001)
    epsilon, fastest = np.float32(1e-15), np.float32(1e30)
    speed = np.float32(1) if len(factors) else rate
    block = max(1, 4096 // max(width, 1))  # the gradients of a block stay in the first cache
    slopes = np.empty(block * width, np.float32)
    for begin in range(first, last, block):
        end = min(begin + block, last)
        _fill(rows, gradient, everywhere, begin, end, width, slopes)
        whole = slice(begin * width, end * width)
        here, m, v = values[whole], mean[whole], square[whole]  # slices: indices from 0 are never negative
        for i in range(len(here)):
            g = slopes[i]
            g = g if abs(g) <= finite else zero
            g = min(max(g, -most), most)
            mi, vi = keep1 * m[i] + add1 * g, keep2 * v[i] + add2 * (g * g)
            m[i], v[i] = mi, vi
            slopes[i] = speed * (mi / (np.sqrt(vi) * correction + epsilon))
        if len(factors):
            scale = factors[whole]
            for i in range(len(here)):
                slopes[i] *= min(rate * scale[i], fastest)
        for i in range(len(here)):
            here[i] = min(max(here[i] - slopes[i], smallest), largest)


BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15  # constants of Adam; the kernel has the same
MAX_GRADIENT = 1e15  # largest absolute value of a gradient: its square is still a finite float32
MAX_RATE = 1e30  # largest learning rate: the product with a step of Adam is still a finite float32
PART = 1 << 19  # approximate number of numbers that a thread updates at a time

NONE = np.empty(0, np.float32)

RowGradients = tuple[Int32[np.ndarray, " R"], Mapping[str, Float32[np.ndarray, "R ..."]]]  # rows ascend


@dataclass(slots=True, eq=False)
class _Leaf:
    """A parameter, its moments, and the number of steps made; ``factors``: of the learning rate of each number."""

    value: Tensor
    mean: Tensor
    square: Tensor
    steps: int
    factors: Tensor | None


class PrunableAdam:
    """Named parameters and the Adam that optimises them."""

    def __init__(
        self,
        values: Mapping[str, Tensor],
        bounds: Mapping[str, tuple[float, float]] | None = None,
        factors: Mapping[str, Tensor] | None = None,
    ) -> None:
        self._bounds, factors = bounds or {}, factors or {}
        self._leaves = {name: _leaf(value.detach().clone(), factors.get(name)) for name, value in values.items()}

    def replace(self, name: str, value: Tensor, factors: Tensor | None) -> None:
        """Replace a parameter and the factors of its learning rate; its moments start anew."""
        self._leaves[name] = _leaf(value.detach().clone(), factors)

    @property
    def parameters(self) -> dict[str, Tensor]:
        """Current parameters by name; :meth:`keep` replaces them."""
        return {name: leaf.value for name, leaf in self._leaves.items()}

    def step(self, rates: Mapping[str, float], rows: RowGradients | None = None) -> None:
        """Make an Adam step at these learning rates, and clear the gradients. Parameters without any gradient stay. NaN
        and infinite gradients count as 0, others are clamped to :data:`MAX_GRADIENT`. On the CPU, torch's number of
        threads is used; the result does not depend on it."""
        index, of_rows = (np.empty(0, np.int32), {}) if rows is None else rows
        parts: list[Callable[[], None]] = []
        for name, leaf in self._leaves.items():
            if leaf.value.grad is None and name not in of_rows:
                continue
            leaf.steps += 1
            smallest, largest = self._bounds.get(name, (-math.inf, math.inf))
            if leaf.value.device.type == "cpu":
                parts += _parts(leaf, rates[name], index, of_rows.get(name, NONE), smallest, largest)
            else:
                _step_by_torch(leaf, rates[name], smallest, largest)
        with Workers(torch.get_num_threads()) as pool:
            pool.map(lambda part: part(), parts)
        for leaf in self._leaves.values():
            leaf.value.grad = None

    def keep(self, index: Int[np.ndarray, " M"]) -> None:
        """Keep only the rows at ``index``, with their moments."""
        for leaf in self._leaves.values():
            rows = torch.from_numpy(index).to(leaf.value.device)
            leaf.value = leaf.value.detach()[rows].requires_grad_()
            leaf.mean, leaf.square = leaf.mean[rows], leaf.square[rows]
            leaf.factors = None if leaf.factors is None else leaf.factors[rows]

    def state(self) -> dict[str, np.ndarray]:
        """Return parameters and moments as arrays, see :meth:`restore`."""
        arrays = {}
        for name, leaf in self._leaves.items():
            arrays[name] = leaf.value.detach().cpu().numpy()
            if leaf.steps:
                arrays[f"{name}.step"] = np.asarray(leaf.steps)
                arrays[f"{name}.exp_avg"] = leaf.mean.cpu().numpy()
                arrays[f"{name}.exp_avg_sq"] = leaf.square.cpu().numpy()
        return arrays

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Continue from a :meth:`state` of parameters of equal shapes."""
        for name, leaf in self._leaves.items():
            parts = [(leaf.value, name), (leaf.mean, f"{name}.exp_avg"), (leaf.square, f"{name}.exp_avg_sq")]
            leaf.steps = int(state.get(f"{name}.step", 0))
            with torch.no_grad():
                for tensor, key in parts[: 3 if leaf.steps else 1]:
                    tensor.copy_(torch.from_numpy(state[key]))


def _leaf(value: Tensor, factors: Tensor | None) -> _Leaf:
    if factors is not None:
        of_rows = factors.shape + (1,) * (value.ndim - factors.ndim)
        factors = factors.to(value.device).reshape(of_rows).expand_as(value).contiguous()
    value = value.contiguous()
    return _Leaf(value.requires_grad_(), torch.zeros_like(value), torch.zeros_like(value), 0, factors)


def _parts(
    leaf: _Leaf,
    rate: float,
    rows: Int32[np.ndarray, " R"],
    of_rows: Float32[np.ndarray, "R ..."],
    smallest: float,
    largest: float,
) -> list[Callable[[], None]]:
    """Return the parts of a step on the CPU. They do not depend on the number of threads, nor does their rounding."""
    count, everywhere = len(leaf.value), leaf.value.grad
    values, mean, square = (tensor.detach().numpy().reshape(-1) for tensor in (leaf.value, leaf.mean, leaf.square))
    slopes = NONE if everywhere is None else everywhere.contiguous().numpy().reshape(-1)
    factors = NONE if leaf.factors is None else leaf.factors.numpy().reshape(-1)
    corrections = min(rate / (1 - BETA1**leaf.steps), MAX_RATE), 1 / math.sqrt(1 - BETA2**leaf.steps)
    constants = np.array([*corrections, MAX_GRADIENT, smallest, largest], np.float32)
    rows, of_rows = rows if len(of_rows) else rows[:0], of_rows.reshape(-1)
    width = len(values) // max(count, 1)
    step = max(1, PART // max(width, 1))
    arrays = values, mean, square, rows, of_rows, slopes, factors, width
    return [partial(adam, *arrays, first, min(first + step, count), constants) for first in range(0, count, step)]


@torch.no_grad()
def _step_by_torch(leaf: _Leaf, rate: float, smallest: float, largest: float) -> None:
    """Make a step by torch, on any device."""
    gradient = leaf.value.grad
    if gradient is None:
        return
    gradient.nan_to_num_(0.0, 0.0, 0.0).clamp_(-MAX_GRADIENT, MAX_GRADIENT)
    most = 1.0 if leaf.factors is None or not len(leaf.factors) else float(leaf.factors.max())
    before = None if leaf.factors is None else leaf.value.detach().clone()
    steps = torch.tensor(leaf.steps - 1.0, device=leaf.value.device)
    torch_adam(
        [leaf.value],
        [gradient],
        [leaf.mean],
        [leaf.square],
        [],
        [steps],
        fused=True,
        amsgrad=False,
        beta1=BETA1,
        beta2=BETA2,
        lr=rate * most,
        weight_decay=0.0,
        eps=EPSILON,
        maximize=False,
    )
    if before is not None and leaf.factors is not None:
        leaf.value.sub_(before).mul_(leaf.factors / most).add_(before)
    leaf.value.clamp_(smallest, largest)


# ``GaussianModel``: a scene with trainable parameters.

BOUNDS = {
    "means": (-0.999 * MEAN_LIMIT, 0.999 * MEAN_LIMIT),  # float32 could round up
    "scales": (-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT),
    "opacities": (OPACITY_LOGIT_MIN, OPACITY_LOGIT_MAX),
    "sh0": (-SH_LIMIT, SH_LIMIT),
    "shN": (-SH_LIMIT, SH_LIMIT),
}  # smallest and largest values that kissgs.core.splats.clean leaves unchanged


class GaussianModel:
    """The stored parameters of a scene as torch tensors, optimised by Adam."""

    def __init__(
        self, splats: Splats, device: Device = "cpu", extents: Float32[np.ndarray, " N"] | None = None
    ) -> None:
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

    def add_gradients(self, gradients: Gradients) -> None:
        """Add gradients of an image to those of the next :meth:`step`, on the CPU."""
        self._received.append(gradients)

    @property
    def antialiased(self) -> bool:
        """See :class:`kissgs.Splats`."""
        return self._rest.antialiased

    def gaussians(self) -> dict[str, Tensor]:
        """Return the parameters themselves."""
        return self.parameters

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def step(self, rates: Mapping[str, float]) -> None:
        """Make an Adam step at these learning rates, and clear the gradients. Values are clamped to :data:`BOUNDS`; NaN
        and infinite gradients count as 0."""
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
