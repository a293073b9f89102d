"""Random sensitivities."""

import numpy as np

from kissgs import Settings
from kissgs.core.sensitivity import Sensitivity
from kissgs.sogxt.encode import encode


def packed_hessian(form):
    """Return the entries of a 7x7 Hessian that a sensitivity holds, ``(10,)``."""
    return np.concatenate([form[0, :4], np.diag(form)[1:]]).astype(np.float32)


def random_sensitivity(splats, seed=0, spread=2.0):
    """Return a sensitivity of random size, with shape Hessians from random positive semidefinite ones."""
    rng = np.random.default_rng(seed)
    count = len(splats)
    roots = rng.normal(size=(count, 7, 7))
    size = np.exp(rng.normal(-12, spread, count))
    forms = np.einsum("nij,nkj->nik", roots, roots) * size[:, None, None]
    return Sensitivity(
        position_hessian=(np.ones(3) * size[:, None]).astype(np.float32),
        shape_hessian=np.stack([packed_hessian(form) for form in forms]) if count else np.zeros((0, 10), np.float32),
        color_weight=size.astype(np.float32),
        mean_harmonics=rng.normal(0, 0.05, (count, splats.shN.shape[1])).astype(np.float32),
        higher_harmonics=np.zeros((count, 0), np.float32),
        prior=np.zeros(count, np.float32),
        coverage=np.ones(count, np.float32),
        captured=np.zeros(count, np.float32),
    )


def encode_rd(splats, sensitivity, **changes):
    return encode(splats, Settings.research("balanced", **changes).encode, sensitivity=sensitivity)
