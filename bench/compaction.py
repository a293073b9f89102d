"""Strategies of compaction at equal numbers of Gaussians and of training steps: quality, bytes and seconds.

    python bench/compaction.py fox.ply --views fox --ratios 0.2 0.1

The last six strategies are trained along the way, those with "refine" in their name are trained too. With ``-p paper``
"POP + train + POP + refine", "POP + sparsify + POP + refine" and "POPSpa" are those of KISS-GS, table 4.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from bench.common import arguments, fraction, head, row, run, training_views
from kissgs import Splats, load
from kissgs.cli.options import chosen
from kissgs.compaction.merging import merge_gaussians
from kissgs.compaction.popspa import Popspa
from kissgs.compaction.scoring import highest_indices
from kissgs.training.supervision import SCORING_STRIDE, supervision_views, training_targets


def random_subset(splats: Splats, count: int) -> Splats:
    """Return ``count`` random Gaussians, in their order, with a fixed seed."""
    return splats.select(np.sort(np.random.default_rng(0).permutation(len(splats))[:count]))


def most_opaque(splats: Splats, count: int) -> Splats:
    """Return the ``count`` most opaque Gaussians, in their order."""
    return splats.select(highest_indices(splats.opacities, count))


def merged(splats: Splats, count: int) -> Splats:
    """Return ``count`` Gaussians by merging."""
    return merge_gaussians(splats, count)[0]


Start = Callable[[Splats, int], Splats]

AT_ONCE, IN_ROUNDS = {"min_keep_per_scoring": 0.0}, {"min_keep_per_scoring": 0.8}
ALONE = {"admm_rho": 0.0, "erank_weight": 0.0, "min_scale_weight": 0.0}
ONE, FIVE = {**ALONE, **AT_ONCE, "prune_rounds": 1}, {**ALONE, **IN_ROUNDS, "prune_rounds": 5}
ADMM, ERANK = {"admm_rho": 5e-4}, {"erank_weight": 0.01, "min_scale_weight": 1.0}
"""Weights in the published code of GaussianSpa and of the effective-rank loss."""

STRATEGIES: dict[str, tuple[str, Start | None, dict[str, Any]]] = {
    "random": ("none", random_subset, {}),
    "opacity": ("none", most_opaque, {}),
    "POP": ("none", None, AT_ONCE),
    "POP in rounds": ("none", None, IN_ROUNDS),
    "merge": ("none", merged, {}),
    "opacity + refine": ("after", most_opaque, {}),
    "POP + refine": ("after", None, AT_ONCE),
    "POP in rounds + refine": ("after", None, IN_ROUNDS),
    "merge + refine": ("after", merged, {}),
    "POP + train + POP + refine": ("along", None, ONE),
    "POP + sparsify + POP + refine": ("along", None, {**ONE, **ADMM}),
    "POPSpa": ("along", None, {**ONE, **ADMM, **ERANK}),
    "prunings along the way": ("along", None, FIVE),
    "prunings along the way + sparsify": ("along", None, {**FIVE, **ADMM}),
    "prunings along the way + erank": ("along", None, {**FIVE, **ERANK}),
}
"""When it is trained, what reduces the scene first (None: the highest scores stay), and its compaction settings."""


def main() -> None:
    """Print a row for the scene as it is, and one for each strategy and share; all train as many steps in total."""
    parser = arguments(__doc__)
    parser.add_argument("-p", "--preset", default="balanced")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="compaction setting")
    parser.add_argument("--ratios", nargs="+", type=fraction, default=[0.7, 0.5, 0.3, 0.2, 0.1, 0.05])
    parser.add_argument("--strategies", nargs="+", default=list(STRATEGIES), choices=list(STRATEGIES))
    parser.add_argument("--supervision", default="photos", choices=["photos", "cameras", "scene"])
    given = parser.parse_args()
    settings = chosen(given.preset, given.set, group="compact").compact
    scene = load(given.scene)
    training = None if given.views is None else training_views(given.views, given.supervision)
    stride = SCORING_STRIDE if settings.trains else 1
    supervised = supervision_views(scene, training, settings, scoring_stride=stride)
    strategies = [name for name in given.strategies if settings.trains or STRATEGIES[name][0] == "none"]
    trained = any(STRATEGIES[name][0] != "none" for name in strategies)
    targets = training_targets(scene, supervised) if trained else None
    original = Popspa(scene, settings, supervised)
    head("strategy", "Gaussians", "PSNR", "SSIM", "bytes by `fast`", "seconds", "CPU s")

    def report(name: str, found: Splats, seconds: float, cpu_seconds: float) -> None:
        metrics, size = original.evaluate(found)
        quality = f"{metrics.psnr:.2f}", f"{metrics.ssim:.4f}"
        row(name, len(found), *quality, size, f"{seconds:.1f}", f"{cpu_seconds:.1f}")

    report("none", scene, 0.0, 0.0)
    for name in strategies:
        when, start, changes = STRATEGIES[name]
        steps = {"sparsify_steps": 0, "refine_steps": settings.steps if when == "after" else 0}
        own = settings.model_copy(update={**({} if when == "along" else steps), **changes})
        for ratio in given.ratios:
            count = max(1, round(len(scene) * ratio))
            wall, cpu = time.perf_counter(), time.process_time()
            reduced = scene if start is None else start(scene, count)
            found = Popspa(reduced, own, supervised, targets=targets)(count)
            report(name, found.splats, time.perf_counter() - wall, time.process_time() - cpu)


if __name__ == "__main__":
    run(main)
