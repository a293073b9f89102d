"""``open_runner``: a runner by name. Ray is imported only if it is asked for."""

from __future__ import annotations

import math
from typing import Literal

from kissgs.runners.contract import Resources, Runner


def open_runner(kind: Literal["local", "ray"], address: str = "auto", *, unlimited: bool = False) -> Runner:
    """Open a runner.

    Args:
        kind: "local" for processes on this machine, "ray" for a Ray cluster.
        address: of the cluster: HOST:PORT, or "auto" for that of ``RAY_ADDRESS`` or of this machine, and if there is
            none, a new one on this machine until the runner is closed.
        unlimited: whether the local runner starts every item at once, because the caller limits their number.

    Raises:
        RunnerError: Ray is not installed or the cluster cannot be reached.
    """
    if kind == "ray":
        from kissgs.runners.ray_runner import RayRunner

        return RayRunner(address)
    from kissgs.runners.local import LocalRunner

    return LocalRunner(Resources(math.inf, 1 << 62, math.inf) if unlimited else None)
