"""What the labels of a codebook cost to tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kissgs._typing import Float32, Int, Int32

UNUSED = 0.02
"""Times that a label is taken to occur which does not: its bits are then many, not infinitely many."""


@dataclass(frozen=True, slots=True, eq=False)
class Thrift:
    """Makes a codebook whose labels are cheap to tell: entropy-constrained vector quantisation.

    Chou, Lookabaugh, Gray, "Entropy-constrained vector quantization", IEEE Trans. ASSP 37 (1989).

    Attributes:
        price: ``(N,)`` of a bit, for each vector, in units of its squared distance.
        groups: ``(N,)`` from 0; labels are told apart from those of the same group alone.
    """

    price: Float32[np.ndarray, " N"]
    groups: Int[np.ndarray, " N"]

    def ordered(self, order: Int[np.ndarray, " N"]) -> Thrift:
        """For vectors in another order."""
        return Thrift(self.price[order], self.groups[order])

    def bits(self, labels: Int32[np.ndarray, " N"], size: int) -> Float32[np.ndarray, "G K"]:
        """Of each label, in each group, if they are chosen as they were."""
        counts = np.zeros((int(self.groups.max(initial=0)) + 1, size))
        np.add.at(counts, (self.groups, labels), 1)
        counts += UNUSED
        return (np.log2(counts.sum(axis=1, keepdims=True)) - np.log2(counts)).astype(np.float32)
