"""Numbers of processes and machines, to tell whether another service has certainly ended."""

from __future__ import annotations

import hashlib
import os
import platform
from pathlib import Path

IDENTITY_BITS = 48
"""Bits of numbers in the database, which a float column holds exactly."""


def may_run(process: int) -> bool:
    """Whether another process of this machine may have this number."""
    if process < 1 or process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def machine_number() -> int:
    """Return a number of this machine or container that changes with each start of it."""
    try:
        boot_id = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        namespace = Path("/proc/self/ns/pid").readlink()
    except OSError:
        boot_id, namespace = platform.node(), Path()
    digest = hashlib.sha256(f"{boot_id} {namespace}".encode()).digest()
    return int.from_bytes(digest[: IDENTITY_BITS // 8], "big")
