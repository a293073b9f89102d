"""Real spherical harmonics in the order and with the signs of 3DGS."""

from __future__ import annotations

import numpy as np

from kissgs.core.array_types import Float
from kissgs.core.splats import SH_C0


def sh_basis(directions: Float[np.ndarray, "M 3"], degree: int) -> Float[np.ndarray, "M K"]:
    """Return the (degree + 1)² real spherical harmonics with the signs of 3DGS, at unit vectors. A Gaussian's colour
    from direction d (from the camera to it) is 0.5 + basis(d) · (sh0, shN)."""
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    band0 = [np.full_like(x, SH_C0)]
    band1 = [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    band2 = [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
    ]
    band3 = [
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack([*band0, *band1, *band2, *band3][: (degree + 1) ** 2], axis=1)
