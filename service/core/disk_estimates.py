"""What the files of a job take at most, from what is known of its scene."""

from __future__ import annotations

BYTES_PER_GAUSSIAN = (68, 104, 164, 248)
"""Of a ``.ply``, by SH degree."""

STEPS_BYTES = 300_000
"""What a checkpoint tells of the steps done, if there are as many as settings allow."""

TUNED_BYTES, ENTRY_BYTES, MOST_ENTRIES = 12 * 14, 12 * 45, 1 << 16
"""What fine-tuning keeps of a Gaussian and of an entry, and how many entries there are at most, or nearly."""


def checkpoint_bytes(gaussians: int, sh_degree: int, *, compact: bool = True, finetune: bool = False) -> int:
    """What the checkpoints of a scene's trainings take at most.

    That of compaction holds each parameter and the two moments of Adam, of no more Gaussians than the scene has; that
    of fine-tuning, beside it, the same of levels and of the codebook's entries. While one is written anew, the former
    one is still there.
    """
    first = compact * (STEPS_BYTES + 3 * BYTES_PER_GAUSSIAN[sh_degree] * gaussians)
    second = finetune * (STEPS_BYTES + TUNED_BYTES * gaussians + ENTRY_BYTES * min(max(gaussians, 64), MOST_ENTRIES))
    return first + second + max(first, second)
