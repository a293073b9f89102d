"""Seeing whether the job database is still the one that was opened: there, whole, and open to writing."""

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

from service.core.models import Base, Meta

WAIT_SECONDS = 2.0
"""How long to wait for another's lock, when looking whether the database can be written to."""

SHARE = 0.01
"""The part of the time, at most, that goes into reading the whole of an SQLite database in search of damage."""

IDENTITY = "identity"
"""The row of ``meta`` with a number that no other database has."""

OWNER = "owner"
"""The row with the number of the service that uses it."""

IDENTITY_BITS = 48
"""How large that number is: a column of floats holds it exactly."""


class DatabaseReplacedError(SQLAlchemyError):
    """The database was removed or replaced, or became another service's, while this one had it open."""


def file_of(url: sa.URL) -> Path | None:
    """The file of an SQLite database; None for a server, or for memory."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    return Path(str(url.database).removeprefix("file:")).absolute()


def error_text(error: BaseException) -> str:
    """What a driver says, in one line."""
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__


def read_a_row(connection: sa.Connection) -> None:
    """Read the last row of every table, with all columns.

    Raises:
        SQLAlchemyError: a table or a column is missing, or damaged.
    """
    for table in Base.metadata.sorted_tables:
        last = [column.desc() for column in table.primary_key]
        connection.execute(sa.select(table).order_by(*last).limit(1)).all()


def change_nothing(connection: sa.Connection) -> None:
    """Write what is there already: SQLite refuses a read-only database no earlier.

    Raises:
        SQLAlchemyError: the database cannot be written to.
    """
    connection.execute(sa.update(Meta).where(Meta.name == IDENTITY).values(value=Meta.value))


def read_every_page(connection: sa.Connection) -> str | None:
    """What is wrong with the structure of an SQLite database; None if nothing is."""
    found = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar()
    return None if found == "ok" else " ".join(str(found).split())


def leave_open(connection: sqlite3.Connection) -> None:
    """Keep a connection open up to the very end of the process.

    Closing the last one of a database removes the file of its journal by name; once the database has been replaced,
    that name is another's.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(connection))


class DatabaseMonitor:
    """Checks an open database.

    Args:
        engine: what the service works with.
    """

    def __init__(self, engine: sa.Engine) -> None:
        self.identity: float | None = None
        self.owner: float | None = None
        self._turn = threading.Lock()
        self._begun, self._found = 0.0, ""
        self._read, self._cost = time.monotonic(), 0.0
        self._files: dict[Path, tuple[int, int] | None] = {}
        self._file, self._probe = file_of(engine.url), engine
        if self._file is not None:
            self._keep(self._file)

    def close(self) -> None:
        """Let go of the database; if it is no longer there, without touching what stands in its place."""
        if self._file is not None:
            with contextlib.suppress(DatabaseReplacedError):
                self.require()
                self._keeper.close()
                return
            leave_open(self._keeper)

    def leave(self) -> None:
        """Let go of the database as it is, its journal included."""
        if self._file is not None:
            leave_open(self._keeper)

    def require(self) -> None:
        """See that the database's files are those that were opened: a matter of microseconds.

        Raises:
            DatabaseReplacedError: they are not.
        """
        for path, known in self._files.items():
            found = _inode(path)
            if found != known:
                done = "removed" if found is None else "replaced"
                raise DatabaseReplacedError(
                    f"{path.name} was {done} while the service runs; put it back and restart the service"
                )

    def ownership_problem(self, connection: sa.Connection | Session) -> str | None:
        """Why an open database is not, or no longer, this service's; None if it is."""
        wanted = sa.select(Meta.name, Meta.value).where(Meta.name.in_((IDENTITY, OWNER)))
        found = {name: value for name, value in connection.execute(wanted)}  # noqa: C416  dict() takes it for a mapping
        if found.get(IDENTITY) != self.identity:
            return "it was replaced by another"
        if self.owner is not None and found.get(OWNER) != self.owner:
            return "another service has taken it over; stop one of them, and restart the other"
        return None

    def health_problem(self) -> str | None:
        """Why the database cannot be relied on; None if it can. Takes a millisecond or two, and may wait for a lock.

        Those who ask at the same time share an answer, but none gets one that is older than the question.
        """
        asked = time.monotonic()
        with self._turn:
            if self._begun < asked:
                self._begun = time.monotonic()
                self._found = self._look()
            return self._found or None

    def _keep(self, file: Path) -> None:
        """Hold the database open, so that its journal stays the same file from now on."""
        self._keeper = sqlite3.connect(file, timeout=WAIT_SECONDS, check_same_thread=False)
        self._keeper.execute("SELECT count(*) FROM meta").fetchall()
        real = os.path.realpath(file)
        self._files = {path: _inode(path) for path in (file, Path(f"{real}-wal"), Path(f"{real}-shm"))}
        self._probe = sa.create_engine("sqlite://", creator=lambda: _open(file), poolclass=sa.NullPool)

    def _look(self) -> str:
        try:
            self.require()
            if self._file is not None and not self._file.stat().st_size:  # SQLite would remove its journal
                return "its file is empty"
            with self._probe.connect() as connection:
                return self._inspect(connection)
        except (SQLAlchemyError, sqlite3.Error, OSError, ValueError) as error:
            return error_text(error)

    def _inspect(self, connection: sa.Connection) -> str:
        mine = sa.select(Meta.value).where(Meta.name == IDENTITY)
        with _short_transaction(connection):
            connection.scalar(mine.with_for_update())
            if why := self.ownership_problem(connection):
                return why
            change_nothing(connection)
            read_a_row(connection)
        begun = time.monotonic()
        if self._file is None or begun - self._read < self._cost / SHARE:
            return ""
        damage = read_every_page(connection)
        self._read = time.monotonic()
        self._cost = self._read - begun
        return f"it is damaged: {damage}" if damage else ""


@contextlib.contextmanager
def _short_transaction(connection: sa.Connection) -> Iterator[None]:
    """Begin a transaction that could write and does not wait long for others; undo it."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    elif connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {int(1000 * WAIT_SECONDS)}")
    try:
        yield
    finally:
        connection.rollback()


def _open(file: Path) -> sqlite3.Connection:
    """Open a database that is there; none is made."""
    address = f"file:{quote(str(file))}?mode=rw"
    return sqlite3.connect(address, uri=True, timeout=WAIT_SECONDS, isolation_level=None, check_same_thread=False)


def _inode(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino
