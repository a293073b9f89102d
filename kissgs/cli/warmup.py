"""``kissgs warmup``: compile all kernels in advance."""

from __future__ import annotations

from kissgs.cli.console import progress_bar


def warmup() -> None:
    """Compile and cache all kernels now, so that later commands start without delay."""
    from kissgs.planning.planner import load_kernels as load_encoder
    from kissgs.rendering.rasterizer import load_kernels as load_rasterizer

    with progress_bar(False) as progress:  # one stage for all, so that it is reported once
        progress("kernels", 0.0)
        load_encoder()
        load_rasterizer()
        from kissgs.compaction import merging  # noqa: F401
        from kissgs.planning import table_fields  # noqa: F401

        progress("kernels", 1.0)
