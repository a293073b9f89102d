"""Numba kernel of Adam: gradients of some rows, of all or both, in one pass over parameters and moments.

Kingma and Ba, "Adam: A Method for Stochastic Optimization" (ICLR 2015), algorithm 1, with beta1 = 0.9, beta2 = 0.999
and epsilon = 1e-15. A row without a gradient has the gradient 0: its moments decay, and it moves by what is left of
them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from kissgs.core.numba_kernels import compiled

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
    """Make a step with the rows ``first`` to ``last`` (exclusive) of a parameter; arrays are flat.

    Args:
        values: the parameter, of ``width`` numbers per row; changed.
        mean: first moments; changed.
        square: second moments; changed.
        rows: ``(R,)`` rows that have a gradient of their own, ascending.
        gradient: the gradient of each of these.
        everywhere: a gradient of all rows, which is added; empty for none.
        factors: factor of the learning rate of each number; empty for 1.
        width: number of numbers in a row.
        first: first row.
        last: end of the rows, exclusive.
        constants: learning rate / (1 - beta1^t); 1 / sqrt(1 - beta2^t); the absolute value to which gradients are
            clamped, NaN and infinite ones being 0; the smallest and the largest value that a step may reach.
    """
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
