"""Database lease: the guarantee that one service at a time uses a job database.

The owner's rows in ``meta`` are its number, its process and its machine; the row with the time is its heartbeat,
written every few seconds. Only a change of that row counts, so the clocks of machines need not agree.
"""

from __future__ import annotations

import logging
import os
import secrets
import time

import sqlalchemy as sa
from sqlalchemy.orm import Session

from ..core.models import Meta
from ..core.settings import SettingsError
from .database import Sessions
from .database_health import IDENTITY, OWNER
from .machine import IDENTITY_BITS, machine_number, may_run

log = logging.getLogger("kissgs.service")

HEARTBEAT_SECONDS = 5.0
"""Seconds between heartbeats."""

TAKEOVER_SECONDS = 20.0
"""Seconds that a start waits for a heartbeat of an owner that may have crashed."""

POLL_SECONDS = 0.25
"""Seconds between checks for a heartbeat."""

TIME, PROCESS, MACHINE = "time", "owner-process", "owner-machine"

Rows = dict[str, float]


def acquire(writing: Sessions, reading: Sessions) -> float:
    """Take the lease and return the number of this owner.

    There is no wait if the previous owner has released the lease, or has crashed on this machine.

    Raises:
        SettingsError: another service holds the lease.
    """
    with reading() as session:
        seen = _rows(session)
    if not _is_free(seen):
        seen = _wait_for_heartbeat(seen, reading)
    number = secrets.randbits(IDENTITY_BITS)
    with writing.begin() as session:
        session.get(Meta, IDENTITY, with_for_update=True)  # serialises simultaneous starts
        if _rows(session) != seen:
            raise _in_use_error(seen)
        for name, value in {OWNER: number, PROCESS: os.getpid(), MACHINE: machine_number()}.items():
            session.merge(Meta(name=name, value=value))
    return number


def release(session: Session) -> None:
    """Release the lease, so that the next service need not wait."""
    session.execute(sa.delete(Meta).where(Meta.name.in_((OWNER, PROCESS, MACHINE))))


def _rows(session: Session) -> Rows:
    query = sa.select(Meta).where(Meta.name.in_((OWNER, PROCESS, MACHINE, TIME)))
    return {row.name: row.value for row in session.scalars(query)}


def _wait_for_heartbeat(seen: Rows, reading: Sessions) -> Rows:
    """Wait for a heartbeat of the owner.

    Returns:
        The rows after the wait: those of the crashed owner, or none of an owner that has released the lease.

    Raises:
        SettingsError: there was a heartbeat.
    """
    log.warning("another service holds the job database's lease; waiting %g s for its heartbeat", TAKEOVER_SECONDS)
    end = time.monotonic() + TAKEOVER_SECONDS
    while time.monotonic() < end:
        time.sleep(POLL_SECONDS)
        with reading() as session:
            now = _rows(session)
        if OWNER not in now:
            return now
        if now != seen:
            raise _in_use_error(now)
    log.warning("there was no heartbeat; this service takes the lease over")
    return seen


def _is_free(rows: Rows) -> bool:
    """Whether the owner certainly does not run."""
    return OWNER not in rows or (rows.get(MACHINE) == machine_number() and not may_run(int(rows.get(PROCESS, 0))))


def _in_use_error(rows: Rows) -> SettingsError:
    here = rows.get(MACHINE) == machine_number()
    which = f"process {rows.get(PROCESS, 0):.0f}" if here else "on another machine or in another container"
    return SettingsError(
        f"KISSGS_DATABASE_URL: another service ({which}) is using the job database; stop that one, or use "
        "a separate database and data folder"
    )
