"""``kissgs warmup``: compile kernels ahead."""

from __future__ import annotations

from kissgs.cli.console import progress_bar


def warmup() -> None:
    """Compile the encoder's and the rasteriser's kernels now, so that no command has to wait for them later."""
    from kissgs.planning.planner import load_kernels as load_encoder
    from kissgs.rendering.rasterizer import load_kernels as load_rasterizer

    with progress_bar(False) as progress:  # one stage for both: it is announced once
        progress("kernels", 0.0)
        load_encoder()
        load_rasterizer()
        progress("kernels", 1.0)
