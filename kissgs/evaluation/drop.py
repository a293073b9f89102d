"""How much worse a scene's pictures have become, in one figure."""

from __future__ import annotations

import math

from kissgs.evaluation.likeness import Evaluation

USUAL = 30.0
"""Decibels between a scene's pictures and photographs, where there are none to ask: about that of good captures."""

MODELLED = f"without photographs, the drop is that of a scene {USUAL:g} dB from them to which the new errors are added"


def drop_of(evaluation: Evaluation) -> float:
    """By how many decibels a scene's pictures have become worse.

    Where there are no photographs to ask, as if the scene had been :data:`USUAL` decibels from them and the new errors
    were independent of those: squared errors then add up. (Of fox it predicts 0.40 dB where 0.38 are measured.)
    """
    change = evaluation.mean.change
    if change is not None:
        return -change
    return 10 * math.log10(1 + 10 ** ((USUAL - min(evaluation.mean.between.psnr, 1e3)) / 10))
