"""The extremes: input, promised behaviour, a small scene, a camera that sees it, and error bounds of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from helpers import extreme_scenes
from helpers.extreme_scenes import Arrays
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
    """One row of the table.

    Attributes:
        name: of the row, and of its tests.
        given: what is extreme.
        promise: what happens to it.
        arrays: makes the scene, as float64 before anything is cleaned.
        camera: makes a camera that sees it.
        changes: what cleaning has to report.
        bounds: where they are not those of ``BOUNDS``; the promise says why.
        as_ply: the scene is read from a ``.ply`` of float64 properties.
    """

    name: str
    given: str
    promise: str
    arrays: Callable[[], Arrays]
    camera: Callable[[], Camera] = extreme_scenes.camera
    changes: Mapping[str, int] = field(default_factory=dict)
    bounds: Mapping[str, float] = field(default_factory=dict)
    as_ply: bool = False

    def bound(self, stage: str) -> float:
        """Return the error bound of a stage."""
        return {**BOUNDS, **self.bounds}[stage]


KEPT = "kept as it is"

EXTREMES = [
    Extreme("ordinary", "a cloud of 12 Gaussians of SH degree 1", KEPT, extreme_scenes.cloud),
    # Positions
    Extreme("micrometre", "a world 1e-6 across", KEPT, extreme_scenes.micrometre, extreme_scenes.microscope),
    Extreme("megametre", "a world 1e6 across", KEPT, extreme_scenes.megametre, extreme_scenes.from_afar),
    Extreme(
        "far-away",
        "a world of 1, 1e6 from the origin",
        "kept, but float32 has no more than 16 places in 1 there",
        extreme_scenes.displaced,
        extreme_scenes.displaced_camera,
        bounds={"step": 5e-2},  # positions cannot move, so the next images differ a little
    ),
    Extreme(
        "two-axes-away",
        "a world of 1, 1000 from the origin along two axes",
        "kept; a container's steps are 0.13 there, which the report says: origin=auto keeps positions",
        extreme_scenes.offset_of_two_axes,
        extreme_scenes.offset_camera,
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
        extreme_scenes.beyond_1e15,
        changes={"far_away": 3},
    ),
    Extreme(
        *("outlier", "one position of 1e6", "kept; a position's step grows as 1 + abs(x): the others hardly suffer"),
        extreme_scenes.outlier,
    ),
    Extreme("line", "all on a line", "kept; the two constant coordinates within the common step", extreme_scenes.line),
    Extreme("one-place", "all in one place", KEPT, extreme_scenes.one_place),
    # Shapes
    Extreme(
        "points",
        "log-scales of -30",
        "kept; drawn as the 0.3 px² dot that the dilation makes of them",
        extreme_scenes.points,
    ),
    Extreme("fog", "log-scales of 30", "kept; drawn as fog of one colour", extreme_scenes.fog),
    Extreme(
        *(
            "scales-beyond",
            "log-scales beyond ±30, ±inf too (logarithm of 0)",
            "clamped to ±30",
            extreme_scenes.scales_beyond,
        ),
        changes={"clamped_scales": 6},
    ),
    Extreme(
        *("needles", "needles, 1e13 to 1e26 times longer than wide", "kept; drawn from sums of squares: no digit lost"),
        extreme_scenes.needles,
    ),
    Extreme("discs", "discs of no thickness", KEPT, extreme_scenes.discs),
    Extreme("balls", "all scales alike", "exact", extreme_scenes.balls),
    # Opacities
    Extreme(
        *(
            "infinite-logits",
            "opacity logits of ±inf",
            "set to those of 1e-6 and 1 - 1e-6",
            extreme_scenes.infinite_logits,
        ),
        changes={"infinite_opacities": 8},
    ),
    Extreme(
        *("saturated", "opacity logits of ±14 to ±3e38", "set to the same two", extreme_scenes.saturated),
        changes={"saturated_opacities": 8},
    ),
    Extreme(
        *("transparent", "all transparent"),
        "left out of the container, not drawn, gradient and score 0",
        extreme_scenes.transparent,
    ),
    Extreme("opaque", "all opaque", "drawn with alpha 0.99 at most; what is behind scores 0", extreme_scenes.opaque),
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
            extreme_scenes.short_quaternions,
        ),
        changes={"unnormalised_quats": 12},
    ),
    Extreme(
        *("long-quaternions", "quaternions of length 1e38", "normalised, in float64", extreme_scenes.long_quaternions),
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
        extreme_scenes.denormal,
        changes={"unnormalised_quats": 12},
    ),
    # Colours
    Extreme("loud", "SH coefficients of 1e6", "kept; errors are of the brightest", extreme_scenes.loud),
    Extreme("too-loud", "SH coefficients beyond ±1e6", "clamped", extreme_scenes.too_loud, changes={"clamped_sh": 4}),
    Extreme("denormal-sh", "SH coefficients of 1e-42", KEPT, extreme_scenes.denormal_sh),
    # Statistics
    Extreme("constant", "channels that are constant", "exact", extreme_scenes.constant),
    Extreme("alike", "all Gaussians alike", "one entry of the codebook; exact but for positions", extreme_scenes.alike),
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
            "kept, with its degree",
            lambda degree=degree: extreme_scenes.cloud(9, degree),
        )
        for degree in (0, 1, 2, 3)
    ),
    # In images
    Extreme("ties", "equal depths", "drawn in the scene's order", extreme_scenes.ties, extreme_scenes.straight),
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
    Extreme("beside", "none in the image", "not drawn, gradient and score 0", extreme_scenes.beside),
]
