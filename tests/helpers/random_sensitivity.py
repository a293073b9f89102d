"""Random sensitivities."""

import numpy as np

from kissgs import Settings
from kissgs.core.sensitivity import Sensitivity
from kissgs.sogxt.encode import encode


def random_sensitivity(splats, seed=0, spread=2.0):
    """Return a sensitivity of random size, with random positive semidefinite shape Hessians."""
    rng = np.random.default_rng(seed)
    count = len(splats)
    roots = rng.normal(size=(count, 7, 7))
    size = np.exp(rng.normal(-12, spread, count))
    forms = np.einsum("nij,nkj->nik", roots, roots) * size[:, None, None]
    rows, columns = np.triu_indices(7)
    return Sensitivity(
        position_hessian=(np.ones(3) * size[:, None]).astype(np.float32),
        shape_hessian=forms[:, rows, columns].astype(np.float32),
        color_weight=size.astype(np.float32),
        mean_sh_basis=rng.normal(0, 0.2, (count, splats.shN.shape[1])).astype(np.float32),
        prior=np.zeros(count, np.float32),
        coverage=np.ones(count, np.float32),
        captured=np.zeros(count, np.float32),
    )


def encode_rd(splats, sensitivity, **changes):
    return encode(splats, Settings.from_preset("balanced", **changes).encode, sensitivity=sensitivity)
