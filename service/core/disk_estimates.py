"""Upper bounds for the disk space of a job's files, from the size of its scene."""

from __future__ import annotations

BYTES_PER_GAUSSIAN = (68, 104, 164, 248)
"""Bytes per Gaussian of a ``.ply``, by SH degree."""

RESULT_BYTES_PER_GAUSSIAN, RESULT_BYTES = 64, 32 << 20
"""Upper bound for a result, which has every file of its container twice: per Gaussian, and for codebooks and report."""

STEPS_BYTES = 300_000
"""Upper bound for a checkpoint's record of completed steps, at the largest step count that the settings allow."""

FINETUNE_BYTES, ENTRY_BYTES, MAX_ENTRIES = 12 * 14, 12 * 45, 1 << 16
"""Fine-tuning state in bytes per Gaussian and per codebook entry, and the approximate maximum number of entries."""


def checkpoint_bytes(gaussians: int, sh_degree: int, *, compact: bool = True, finetune: bool = False) -> int:
    """Return an upper bound in bytes for the checkpoints of a scene's compaction and fine-tuning.

    A compaction checkpoint holds each parameter and its two Adam moments, for at most all Gaussians of the scene. A
    fine-tuning checkpoint holds the levels and the codebook entries, also with their moments. The larger of the two is
    counted twice, because the previous checkpoint exists until the next one is complete.
    """
    first = compact * (STEPS_BYTES + 3 * BYTES_PER_GAUSSIAN[sh_degree] * gaussians)
    second = finetune * (STEPS_BYTES + FINETUNE_BYTES * gaussians + ENTRY_BYTES * min(max(gaussians, 64), MAX_ENTRIES))
    return first + second + max(first, second)
