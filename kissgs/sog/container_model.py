"""Description of SOG 2 for the planner: its tables, and no mask for padding."""

from __future__ import annotations

import numpy as np

from kissgs.io.activations import OPACITY_OF_BYTE
from kissgs.planning.container_model import ByteTables, ContainerModel

FIRST_DRAWN = 2
"""Smallest level of opacity that viewers draw: they leave out opacities of 1/255 and less."""

LAST_DRAWN = 254
"""Largest level to use: 255 is an opacity of 1, whose logit no decoder can give back."""

SOG = ContainerModel(
    tables=ByteTables(
        opacity_logits=OPACITY_OF_BYTE.astype(np.float64), first_drawn=FIRST_DRAWN, last_drawn=LAST_DRAWN
    ),
    padding_last=True,
    entry_bits=130,
)
