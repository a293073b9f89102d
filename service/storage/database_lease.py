"""One service at a time uses a job database: the one whose number stands in it, as long as that shows signs of life.

Its own row of ``meta`` has the number; two more tell which process of which machine it is; and the row with the time,
which it writes again every few seconds, is the sign. No two machines need to agree about the time: what counts is
that the row changes.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import secrets
import time
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from service.core.models import Meta
from service.core.settings import SettingsError
from service.storage.database import Sessions
from service.storage.database_health import IDENTITY, IDENTITY_BITS, OWNER

log = logging.getLogger("kissgs.service")

HEARTBEAT_SECONDS = 5.0
"""Between two signs of life."""

TAKEOVER_SECONDS = 20.0
"""How long a start waits for a sign of life of a service that may have crashed."""

POLL_SECONDS = 0.25
"""Between two looks for one."""

TIME, PROCESS, MACHINE = "time", "owner-process", "owner-machine"

Rows = dict[str, float]


def acquire(writing: Sessions, reading: Sessions) -> float:
    """Write down that the database is this service's, and by which number.

    A service that stopped in order has left no row, and one that crashed on this machine is known not to run: after
    both, nothing is waited for.

    Raises:
        SettingsError: it is another's.
    """
    with reading() as session:
        seen = _rows(session)
    if not _is_free(seen):
        seen = _wait_for_heartbeat(seen, reading)
    number = secrets.randbits(IDENTITY_BITS)
    with writing.begin() as session:
        session.get(Meta, IDENTITY, with_for_update=True)  # two that start at once come one after the other
        if _rows(session) != seen:
            raise _taken(seen)
        for name, value in {OWNER: number, PROCESS: os.getpid(), MACHINE: _machine()}.items():
            session.merge(Meta(name=name, value=value))
    return number


def release(session: Session) -> None:
    """Let the next service have the database at once."""
    session.execute(sa.delete(Meta).where(Meta.name.in_((OWNER, PROCESS, MACHINE))))


def _rows(session: Session) -> Rows:
    wanted = sa.select(Meta).where(Meta.name.in_((OWNER, PROCESS, MACHINE, TIME)))
    return {fact.name: fact.value for fact in session.scalars(wanted)}


def _wait_for_heartbeat(seen: Rows, reading: Sessions) -> Rows:
    """Wait for a sign of life of the owner.

    Returns:
        What stands in the database when there was none, or when the owner has stopped.
    """
    log.warning("the job database is that of another service; waiting %g s for a sign of its life", TAKEOVER_SECONDS)
    end = time.monotonic() + TAKEOVER_SECONDS
    while time.monotonic() < end:
        time.sleep(POLL_SECONDS)
        with reading() as session:
            now = _rows(session)
        if OWNER not in now:
            return now
        if now != seen:
            raise _taken(now)
    log.warning("there was none; this service takes its place")
    return seen


def _is_free(rows: Rows) -> bool:
    """Whether it is certain that the owner does not run."""
    return OWNER not in rows or (rows.get(MACHINE) == _machine() and not _runs(int(rows.get(PROCESS, 0))))


def _runs(process: int) -> bool:
    """Whether it may be that another process of this machine has this number."""
    if process < 1 or process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def _machine() -> int:
    """A number of this machine, or container, that changes when it is started."""
    try:
        started = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii")
        inside = Path("/proc/self/ns/pid").readlink()
    except OSError:
        started, inside = platform.node(), Path()
    digest = hashlib.sha256(f"{started} {inside}".encode()).digest()
    return int.from_bytes(digest[: IDENTITY_BITS // 8], "big")


def _taken(rows: Rows) -> SettingsError:
    here = rows.get(MACHINE) == _machine()
    which = f"process {rows.get(PROCESS, 0):.0f}" if here else "on another machine or in another container"
    return SettingsError(
        f"KISSGS_DATABASE_URL: another service ({which}) is using the job database; stop that one, or give this one "
        "a database and a data folder of its own"
    )
