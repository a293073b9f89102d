"""``DatabaseMonitor``: checks that the job database is the one that was opened, intact and writable."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from ..core.models import Base, Meta
from .data_folder import RESERVE_BYTES
from .replicas import hold

WAIT_SECONDS = 2.0
"""Maximum wait for a lock during a check, seconds."""

MAX_SCAN_SHARE = 0.01
"""Maximum share of time spent on reading all pages of an SQLite database in search of damage."""

IDENTITY = "identity"
"""Row of ``meta`` with a random number that identifies the database."""

OWNER = "owner"
"""Row of ``meta`` with the number of the service that holds the lease."""


class DatabaseReplacedError(SQLAlchemyError):
    """The database was removed or replaced, or another service took it over, while this one had it open."""


def sqlite_file(url: sa.URL) -> Path | None:
    """Return the file of an SQLite database; None for a database server or a database in memory."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    return Path(str(url.database).removeprefix("file:")).absolute()


def error_text(error: BaseException) -> str:
    """Return the first line of a database driver's message, and for a full disk what to do."""
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    reason = lines[0].strip() if lines else type(error).__name__
    return f"{reason}; free {RESERVE_BYTES:,} bytes there" if reason == "database or disk is full" else reason


def is_full(error: BaseException) -> bool:
    """Return whether a database failed because its disk is full."""
    reason = error_text(error).lower()
    return "is full" in reason or "no space left" in reason


def check_rows(connection: sa.Connection) -> None:
    """Read the last row of each table, with all columns, as a quick check.

    Raises:
        SQLAlchemyError: a table or a column is missing or damaged.
    """
    for table in Base.metadata.sorted_tables:
        last = [column.desc() for column in table.primary_key]
        connection.execute(sa.select(table).order_by(*last).limit(1)).all()


def check_writable(connection: sa.Connection) -> None:
    """Overwrite a value with itself, because SQLite reports a read-only database only on a write.

    Raises:
        SQLAlchemyError: the database cannot be written to.
    """
    connection.execute(sa.update(Meta).where(Meta.name == IDENTITY).values(value=Meta.value))


def check_pages(connection: sa.Connection) -> str | None:
    """Check the structure of an SQLite database; return a description of the damage, None if there is none."""
    found = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar()
    return None if found == "ok" else " ".join(str(found).split())


def keep_open(connection: sqlite3.Connection) -> None:
    """Keep a connection open until the process ends.

    Closing the last connection to a database removes its journal by name; if the database has been replaced, that would
    be the journal of the new one.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(connection))


class DatabaseMonitor:
    """Monitor of an open database.

    Args:
        engine: engine of the service.

    Attributes:
        identity: number that the database must have in ``meta``.
        owner: number of this service's lease; None without a lease.
        replica: id of this replica; None if the database belongs to one service.
    """

    def __init__(self, engine: sa.Engine) -> None:
        self.identity: float | None = None
        self.owner: float | None = None
        self.replica: str | None = None
        self._lock = threading.Lock()
        self._check_started, self._last_problem = 0.0, ""
        self._last_scan, self._scan_seconds = time.monotonic(), 0.0
        self._files: dict[Path, tuple[int, int] | None] = {}
        self._file, self._probe = sqlite_file(engine.url), engine
        if self._file is not None:
            self._hold_open(self._file)

    def close(self) -> None:
        """Close the database; if it was removed or replaced, leave the new files untouched."""
        if self._file is not None:
            with contextlib.suppress(DatabaseReplacedError):
                self.check_files()
                self._connection.close()
                return
            keep_open(self._connection)

    def abandon(self) -> None:
        """Stop using the database without closing it, so that its files, including the journal, stay unchanged."""
        if self._file is not None:
            keep_open(self._connection)

    def check_files(self) -> None:
        """Check that the database's files are those that were opened; takes microseconds.

        Raises:
            DatabaseReplacedError: a file was removed or replaced.
        """
        for path, known in self._files.items():
            found = _inode(path)
            if found != known:
                change = "removed" if found is None else "replaced"
                raise DatabaseReplacedError(
                    f"{path.name} was {change} while the service runs; put it back and restart the service"
                )

    def ownership_problem(self, connection: sa.Connection | Session) -> str | None:
        """Return why the open database does not belong to this service any more; None if it does."""
        query = sa.select(Meta.name, Meta.value).where(Meta.name.in_((IDENTITY, OWNER)))
        found = {name: value for name, value in connection.execute(query)}  # noqa: C416  dict() takes it for a mapping
        if found.get(IDENTITY) != self.identity:
            return "it was replaced by another database"
        if self.owner is not None and found.get(OWNER) != self.owner:
            return "another service has taken it over; stop one of the two and restart the other"
        if self.replica is not None and not hold(connection, self.replica):
            return "another replica took this one for dead; it will join again"
        return None

    def health_problem(self) -> str | None:
        """Check the database; return the problem, None if there is none. Takes 2 ms, or longer to wait for a lock.

        Concurrent calls share one check, which never started before the call.
        """
        called = time.monotonic()
        with self._lock:
            if self._check_started < called:
                self._check_started = time.monotonic()
                self._last_problem = self._run_checks()
            return self._last_problem or None

    def _hold_open(self, file: Path) -> None:
        """Keep a connection open, so that the journal stays the same file."""
        self._connection = sqlite3.connect(file, timeout=WAIT_SECONDS, check_same_thread=False)
        self._connection.execute("SELECT count(*) FROM meta").fetchall()
        real = os.path.realpath(file)
        self._files = {path: _inode(path) for path in (file, Path(f"{real}-wal"), Path(f"{real}-shm"))}
        self._probe = sa.create_engine("sqlite://", creator=lambda: _open(file), poolclass=sa.NullPool)

    def _run_checks(self) -> str:
        try:
            self.check_files()
            if self._file is not None and not self._file.stat().st_size:  # opening it would remove the journal
                return "its file is empty"
            with self._probe.connect() as connection:
                return self._inspect(connection)
        except (SQLAlchemyError, sqlite3.Error, OSError, ValueError) as error:
            return error_text(error)

    def _inspect(self, connection: sa.Connection) -> str:
        query = sa.select(Meta.value).where(Meta.name == IDENTITY)
        with _short_transaction(connection):
            connection.scalar(query.with_for_update())
            if problem := self.ownership_problem(connection):
                return problem
            check_writable(connection)
            check_rows(connection)
        begun = time.monotonic()
        if self._file is None or begun - self._last_scan < self._scan_seconds / MAX_SCAN_SHARE:
            return ""
        damage = check_pages(connection)
        self._last_scan = time.monotonic()
        self._scan_seconds = self._last_scan - begun
        return f"it is damaged: {damage}" if damage else ""


@contextlib.contextmanager
def _short_transaction(connection: sa.Connection) -> Iterator[None]:
    """Begin a write transaction that waits for a lock at most :data:`WAIT_SECONDS`; roll it back at the end."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    elif connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {int(1000 * WAIT_SECONDS)}")
    try:
        yield
    finally:
        connection.rollback()


def _open(file: Path) -> sqlite3.Connection:
    """Open an existing database; never create one."""
    address = f"file:{quote(str(file))}?mode=rw"
    return sqlite3.connect(address, uri=True, timeout=WAIT_SECONDS, isolation_level=None, check_same_thread=False)


def _inode(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
