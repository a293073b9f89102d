"""The extremes: input, promised behaviour, a small scene, a camera that sees it, and error bounds of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from helpers import extreme_scenes
from helpers.extreme_scenes import Arrays, changed, cloud, seen_from, sized, with_values
from kissgs.rendering.camera import Camera

BOUNDS = {
    "clean": 1.1e-6,
    "fast": 1.0,
    "balanced": 1.0,
    "decode": 2e-7,
    "image": 5e-6,
    "gradient": 2e-5,
    "score": 2e-5,
    "rank": 2e-6,
    "step": 1e-2,
    "levels": 0.0,
    "browser": 1.0,
}
"""Error bound of each stage, unless a row has its own."""


@dataclass(frozen=True, slots=True)
class Extreme:
    """One row of the table; ``changes`` is what cleaning has to report, the promise explains own ``bounds``."""

    name: str
    given: str
    promise: str
    arrays: Callable[[], Arrays]
    camera: Callable[[], Camera] = extreme_scenes.camera
    changes: Mapping[str, int] = field(default_factory=dict)
    bounds: Mapping[str, float] = field(default_factory=dict)
    as_ply: bool = False

    def bound(self, stage):
        """Return the error bound of a stage."""
        return {**BOUNDS, **self.bounds}[stage]


KEPT = "kept as it is"

EXTREMES = [
    Extreme("ordinary", "a cloud of 12 Gaussians of SH degree 1", KEPT, extreme_scenes.cloud),
    # Positions
    Extreme("micrometre", "a world 1e-6 across", KEPT, lambda: sized(1e-6), extreme_scenes.microscope),
    Extreme(
        "megametre",
        "a world 1e6 across",
        KEPT,
        lambda: sized(1e6),
        lambda: seen_from([3e5, -4e5, -3e6], [0, 0, 0], 0.8),
    ),
    Extreme(
        "far-away",
        "a world of 1, 1e6 from the origin",
        "kept, with float32's 16 places in 1",
        lambda: changed(means=cloud()["means"] + [1e6, -1e6, 1e6]),
        lambda: seen_from([1e6 + 0.3, -1e6 - 0.4, 1e6 - 3], [1e6, -1e6, 1e6], 0.8),
        bounds={"step": 5e-2},  # positions cannot move, so the next images differ a little
    ),
    Extreme(
        "two-axes-away",
        "a world of 1, 1000 from the origin along two axes",
        "kept; a container's steps are 0.13 there, which the report says: origin=auto keeps positions",
        lambda: changed(means=cloud()["means"] + [1000, 1000, 0]),
        lambda: seen_from([1000.3, 999.6, -3], [1000, 1000, 0], 0.8),
    ),
    Extreme(
        "long-scan",
        "3 km along one axis",
        "kept; a container's steps grow to 0.4 at its end, which the report says",
        extreme_scenes.long_scan,
    ),
    Extreme("1e15", "positions from 1e-6 to 1e15", "kept; nothing beyond 1e10 is drawn", extreme_scenes.up_to_1e15),
    Extreme(
        *("beyond-1e15", "positions beyond ±1e15", "removed: renderers' float32 squares overflow soon after"),
        lambda: with_values("means", 1.1e15, -1e20, 3.4e38),
        changes={"far_away": 3},
    ),
    Extreme(
        *("outlier", "one position of 1e6", "kept; a position's step grows as 1 + abs(x): the others hardly suffer"),
        lambda: with_values("means", 1e6),
    ),
    Extreme(
        "line",
        "all on a line",
        "kept; the two constant coordinates within the common step",
        lambda: changed(means=cloud()["means"] * [1, 0, 0] + [0, 0.25, 0.5]),
    ),
    Extreme("one-place", "all in one place", KEPT, lambda: changed(means=[0.1, -0.2, 0.3])),
    # Shapes
    Extreme(
        "points",
        "log-scales of -30",
        "kept; drawn as the 0.3 px² dot that the dilation makes of them",
        lambda: changed(scales=-30),
    ),
    Extreme("fog", "log-scales of 30", "kept; drawn as fog of one colour", lambda: changed(scales=30, opacities=-1)),
    Extreme(
        *(
            "scales-beyond",
            "log-scales beyond ±30, ±inf too (logarithm of 0)",
            "clamped to ±30",
            lambda: with_values("scales", 100, -100, np.inf, -np.inf, 30.001, -3e38),
        ),
        changes={"clamped_scales": 6},
    ),
    Extreme(
        *("needles", "needles, 1e13 to 1e26 times longer than wide", "kept; drawn from sums of squares: no digit lost"),
        extreme_scenes.needles,
    ),
    Extreme("discs", "discs of no thickness", KEPT, lambda: changed(scales=[-1.5, -1.5, -30])),
    Extreme("balls", "all scales alike", "exact", lambda: changed(scales=-1.75)),
    # Opacities
    Extreme(
        *(
            "infinite-logits",
            "opacity logits of ±inf",
            "set to those of 1e-6 and 1 - 1e-6",
            lambda: with_values("opacities", *[np.inf, -np.inf] * 4),
        ),
        changes={"infinite_opacities": 8},
    ),
    Extreme(
        *(
            "saturated",
            "opacity logits of ±14 to ±3e38",
            "set to the same two",
            lambda: with_values("opacities", 14, -14, 40, -40, 1000, -1000, 3e38, -3e38),
        ),
        changes={"saturated_opacities": 8},
    ),
    Extreme(
        *("transparent", "all transparent"),
        "left out of the container, not drawn, gradient and score 0",
        lambda: changed(opacities=-13),
    ),
    Extreme(
        "opaque",
        "all opaque",
        "drawn with alpha 0.99 at most; what is behind scores 0",
        lambda: changed(opacities=13.5, scales=cloud()["scales"] + 0.8),
    ),
    # Rotations
    Extreme(
        *("no-rotation", "quaternions of length 0", "replaced by no rotation", extreme_scenes.no_rotation),
        changes={"zero_quats": 2},
    ),
    Extreme(
        *(
            "short-quaternions",
            "quaternions of length 1e-38",
            "normalised, in float64",
            lambda: changed(quats=cloud()["quats"] * 1e-38),
        ),
        changes={"unnormalised_quats": 12},
    ),
    Extreme(
        *(
            "long-quaternions",
            "quaternions of length 1e38",
            "normalised, in float64",
            lambda: changed(quats=cloud()["quats"] * 1e38),
        ),
        changes={"unnormalised_quats": 12},
    ),
    # No numbers
    Extreme(
        *("no-numbers", "NaN in any attribute; position, rotation or colour of ±inf", "the Gaussian is removed"),
        extreme_scenes.no_numbers,
        changes={"non_finite": 14},
    ),
    Extreme(
        *("float64", "a .ply of float64 properties beyond float32", "become ±inf, then as above"),
        extreme_scenes.beyond_float32,
        changes={"non_finite": 2, "infinite_opacities": 1, "clamped_scales": 1},
        as_ply=True,
    ),
    Extreme(
        "denormal",
        "all values denormal",
        "kept; rotations normalised",
        lambda: {name: values * 1e-42 for name, values in cloud().items()},
        changes={"unnormalised_quats": 12},
    ),
    # Colours
    Extreme("loud", "SH coefficients of 1e6", "kept; errors are of the brightest", extreme_scenes.loud),
    Extreme(
        "too-loud",
        "SH coefficients beyond ±1e6",
        "clamped",
        lambda: with_values("sh0", 1.1e6, -3e38, 1e9) | {"shN": with_values("shN", *[0.1] * 3, -2e6)["shN"]},
        changes={"clamped_sh": 4},
    ),
    Extreme("denormal-sh", "SH coefficients of 1e-42", KEPT, extreme_scenes.denormal_sh),
    # Statistics
    Extreme(
        "constant",
        "channels that are constant",
        "exact",
        lambda: changed(quats=[1, 0, 0, 0], scales=[-1.5, -2, -2.5], opacities=0.25, sh0=0.75, shN=-0.125),
    ),
    Extreme(
        "alike",
        "all Gaussians alike",
        "one entry of the codebook; exact but for positions",
        lambda: {name: values[np.full(12, 2)] for name, values in cloud().items()},
    ),
    Extreme(
        "cauchy", "heavy tails: every attribute Cauchy", "kept within the bounds of cleaning", extreme_scenes.cauchy
    ),
    Extreme(
        "outliers",
        "one outlier in each attribute",
        "kept; base colours far outside are clipped",
        extreme_scenes.outliers,
    ),
    Extreme("two-heaps", "two heaps in every attribute, 1e-6 apart", KEPT, extreme_scenes.two_heaps),
    # Counts and degrees
    *(
        Extreme(f"count-{count}", f"N = {count}", promise, lambda count=count: extreme_scenes.cloud(count))
        for count, promise in (
            (0, "an empty container, which decodes to an empty scene"),
            (1, KEPT),
            (7, KEPT),
            (8, KEPT),
            (9, KEPT),
            (67, "kept; cells left over are padding"),
        )
    ),
    *(
        Extreme(
            f"degree-{degree}",
            f"SH degree {degree}",
            KEPT,
            lambda degree=degree: extreme_scenes.cloud(9, degree),
        )
        for degree in (0, 1, 2, 3)
    ),
    # In images
    Extreme(
        "ties",
        "equal depths",
        "drawn in the scene's order",
        lambda: changed(means=cloud()["means"] * [1, 1, 0]),
        extreme_scenes.straight,
    ),
    Extreme(
        *("near-ties", "depths that float32 cannot tell apart", "drawn in the scene's order"),
        extreme_scenes.near_ties,
        extreme_scenes.straight,
    ),
    Extreme(
        *("layers", "300 layers, one behind the other", "a pixel ends before its transmittance reaches 1e-4"),
        extreme_scenes.layers,
        extreme_scenes.small,
    ),
    Extreme(
        *("near-plane", "on the camera plane, behind it, and about 0.01 before it", "nearer than 0.01: not drawn"),
        extreme_scenes.near_plane,
    ),
    Extreme(
        "beside",
        "none in the image",
        "not drawn, gradient and score 0",
        lambda: changed(means=cloud()["means"] + [0, 500, 0]),
    ),
]
