"""``with_time_left``: progress events of the work items of a streamed scene, with an estimate of the time left."""

from __future__ import annotations

import itertools
import math
import time

from kissgs.core.progress import Progress

SHARES = {
    False: {"partition": 0.06, "merge": 0.4, "images": 0.54},
    True: {"partition": 0.03, "merge": 0.18, "cameras": 0.02, "images": 0.77},
}
"""Share of each stage in the CPU seconds of a million Gaussians of degree 3, without and with rate-distortion planning,
that is, with the presets ``fast`` and ``balanced``."""

LEAST_SECONDS = 5.0
"""Time after which the pace of the work is known well enough."""


def with_time_left(progress: Progress, rate_distortion: bool) -> Progress:
    """Return a receiver that adds the time left to notes, by the pace since its first event.

    Until more of the work is done, the clock counts it down; once that is at zero, nothing is added.
    """
    shares = SHARES[rate_distortion]
    before = dict(zip(shares, itertools.accumulate(shares.values(), initial=0.0), strict=False))
    first: tuple[float, float] | None = None
    latest, end = 0.0, math.inf  # the work done, and the estimated time of its end

    def receive(stage: str, fraction: float, note: str = "") -> None:
        nonlocal first, latest, end
        now, done = time.monotonic(), before[stage] + fraction * shares[stage]
        first = first or (now, done)
        elapsed, gained = now - first[0], done - first[1]
        if gained > 0 and elapsed > LEAST_SECONDS and (done > latest or end == math.inf):
            latest, end = done, now + elapsed * (1 - done) / gained
        left = [f"{duration(end - now)} left"] if now <= end < math.inf else []
        progress(stage, fraction, ", ".join([*filter(None, [note]), *left]))

    return receive


def duration(seconds: float) -> str:
    """Format a time: "40 s", "12 min", "3.5 h"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
