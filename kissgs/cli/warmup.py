"""``kissgs warmup``: compile all kernels in advance, and measure the speed of the machine."""

from __future__ import annotations

import sys
import time
from importlib.util import find_spec

from kissgs.cli.console import progress_bar
from kissgs.core.errors import OutputError

SAMPLE_COUNT = 20_000
"""Gaussians of the synthetic scene that is encoded to measure the speed."""


def warmup() -> None:
    """Compile and cache all kernels, and measure the speed of this machine, by which --time chooses what to do."""
    from kissgs.compaction import covariance_kernels, merging  # noqa: F401
    from kissgs.core import numba_kernels
    from kissgs.finetuning import kernels as finetuning_kernels  # noqa: F401
    from kissgs.planning import form_kernels, kmeans_kernels, order_kernels, rdo_kernels, tour_kernels  # noqa: F401
    from kissgs.planning import kernels as planning_kernels  # noqa: F401
    from kissgs.rendering import ssim_kernels  # noqa: F401
    from kissgs.rendering.cpu import backward, coverage, neighbours, sensitivity  # noqa: F401

    if find_spec("torch"):  # without it nothing is trained
        from kissgs.training import optimizer  # noqa: F401

    with progress_bar(False) as progress:
        for number, kernel in enumerate(numba_kernels.kernels):
            progress("kernels", number / len(numba_kernels.kernels))
            kernel.load()
        try:
            _measure_speed()
        except OutputError as error:
            sys.stderr.write(f"kissgs: the speed of this machine is not saved, --time assumes the usual one: {error}\n")


def _measure_speed() -> None:
    """Encode a synthetic scene twice, the first time to load what is needed, and save the time of the second."""
    from kissgs.pipeline.pipeline import compress
    from kissgs.pipeline.search_time import save_speed
    from kissgs.settings import Preset, Settings
    from kissgs.synthetic import sample_scene

    scene, settings = sample_scene(SAMPLE_COUNT), Settings(preset=Preset.BALANCED)
    compress(scene, settings=settings)
    started = time.perf_counter()
    compress(scene, settings=settings)
    save_speed(time.perf_counter() - started, settings.preset, SAMPLE_COUNT)
