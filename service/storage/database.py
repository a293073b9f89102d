"""The job database, the file ``jobs.sqlite`` of the data folder: opening, and checks while it is open."""

from __future__ import annotations

import ctypes
import math
import os
import secrets
import shutil
import sqlite3
import threading
import time
from pathlib import Path
from typing import Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from ..core.models import SCHEMA_VERSION, Base, Job, Meta
from ..core.settings import SettingsError
from .job_files import RESERVE_BYTES

WAIT_SECONDS = 2.0  # maximum wait for a lock during a check, seconds
MAX_SCAN_SHARE = 0.01  # maximum share of time spent on reading all pages of the database in search of damage
IDENTITY = "identity"  # row of meta with a random number that identifies the database

DISK_FULL = f"database or disk is full; free {RESERVE_BYTES:,} bytes there"
"""SQLite's words for a full disk, and the remedy."""


class DatabaseReplacedError(SQLAlchemyError):
    """The database was removed or replaced while this service had it open."""


def error_text(error: BaseException) -> str:
    """Return the first line of a database driver's message, and for a full disk what to do."""
    lines = str(getattr(error, "orig", None) or error).strip().splitlines()
    reason = lines[0].strip() if lines else type(error).__name__
    return DISK_FULL if DISK_FULL.startswith(f"{reason};") else reason


def is_full(error: BaseException) -> bool:
    """Return whether a database failed because its disk is full."""
    reason = error_text(error).lower()
    return "is full" in reason or "no space left" in reason


def check_rows(connection: sa.Connection) -> None:
    """Read the last row of each table, with all columns, as a quick check."""
    for table in Base.metadata.sorted_tables:
        last = [column.desc() for column in table.primary_key]
        connection.execute(sa.select(table).order_by(*last).limit(1)).all()


def check_writable(connection: sa.Connection) -> None:
    """Overwrite a value with itself, because SQLite reports a read-only database only on a write."""
    connection.execute(sa.update(Meta).where(Meta.name == IDENTITY).values(value=Meta.value))


def check_pages(connection: sa.Connection) -> str | None:
    """Check the structure of the database; return a description of the damage, None if there is none."""
    found = connection.exec_driver_sql("PRAGMA quick_check(1)").scalar()
    return None if found == "ok" else " ".join(str(found).split())


def keep_open(connection: sqlite3.Connection) -> None:
    """Keep a connection open until the process ends. Closing the last connection to a database removes its journal by
    name; if the database has been replaced, that would be the journal of the new one."""
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(connection))


class DatabaseMonitor:
    """Monitor of an open database, which must have the number ``identity`` in ``meta``."""

    def __init__(self, file: Path, identity: float | None) -> None:
        self.identity = identity
        self._lock = threading.Lock()
        self._check_started, self._last_problem = 0.0, ""
        self._last_scan, self._scan_seconds = time.monotonic(), 0.0
        self._file = file
        # Kept open, so that the journal stays the same file.
        self._connection = sqlite3.connect(file, timeout=WAIT_SECONDS, check_same_thread=False)
        self._connection.execute("SELECT count(*) FROM meta").fetchall()
        real = os.path.realpath(file)
        self._files = {path: _inode(path) for path in (file, Path(f"{real}-wal"), Path(f"{real}-shm"))}
        self._probe = sa.create_engine("sqlite://", creator=lambda: _open(file), poolclass=sa.NullPool)

    def close(self) -> None:
        """Close the database; if it was removed or replaced, leave the new files untouched."""
        try:
            self.check_files()
        except DatabaseReplacedError:
            keep_open(self._connection)
        else:
            self._connection.close()

    def abandon(self) -> None:
        """Stop using the database without closing it, so that its files, including the journal, stay unchanged."""
        keep_open(self._connection)

    def check_files(self) -> None:
        """Check that the database's files are those that were opened; takes microseconds."""
        for path, known in self._files.items():
            found = _inode(path)
            if found != known:
                change = "removed" if found is None else "replaced"
                raise DatabaseReplacedError(
                    f"{path.name} was {change} while the service runs; put it back and restart the service"
                )

    def check_identity(self, connection: sa.Connection | Session) -> None:
        """Check that the file has not got the content of another database."""
        if connection.scalar(sa.select(Meta.value).where(Meta.name == IDENTITY)) != self.identity:
            raise DatabaseReplacedError("it was replaced by another database")

    def health_problem(self) -> str | None:
        """Check the database; return the problem, None if there is none. Takes 2 ms, or longer to wait for a lock.
        Concurrent calls share one check, which never started before the call."""
        called = time.monotonic()
        with self._lock:
            if self._check_started < called:
                self._check_started = time.monotonic()
                self._last_problem = self._run_checks()
            return self._last_problem or None

    def _run_checks(self) -> str:
        try:
            self.check_files()
            if not self._file.stat().st_size:  # opening it would remove the journal
                return "its file is empty"
            with self._probe.connect() as connection:
                return self._inspect(connection)
        except (SQLAlchemyError, sqlite3.Error, OSError, ValueError) as error:
            return error_text(error)

    def _inspect(self, connection: sa.Connection) -> str:
        connection.exec_driver_sql("BEGIN IMMEDIATE")
        try:
            self.check_identity(connection)
            check_writable(connection)
            check_rows(connection)
        finally:
            connection.rollback()
        begun = time.monotonic()
        if begun - self._last_scan < self._scan_seconds / MAX_SCAN_SHARE:
            return ""
        damage = check_pages(connection)
        self._last_scan = time.monotonic()
        self._scan_seconds = self._last_scan - begun
        return f"it is damaged: {damage}" if damage else ""


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


Sessions = sessionmaker[Session]

START_SECONDS = 5.0  # maximum wait for a lock at the start, seconds
LOCK_SECONDS = 30.0  # maximum wait for a lock after the start, seconds
IDENTITY_BITS = 48  # bits of the number of a database, which a float column holds exactly

_HINTS = {
    "locked": "another program has locked it; stop that program and start again",
    "not a database": "restore it from a backup",
    "malformed": "restore it from a backup",
    "readonly": "give the service write permission",
}
"""Remedies by parts of SQLite's messages."""


class NewDatabaseError(SettingsError):
    """The database does not exist or is empty, although the data folder has jobs."""


def connect(file: Path, *, jobs: int = 0) -> tuple[sa.Engine, Sessions, Sessions]:
    """Open the database, check that it is intact, and create it and its tables if there are none, unless the data
    folder has ``jobs``. Return the engine, sessions for writing, each with exclusive access, and sessions for reading,
    which wait for none."""
    refusal = NewDatabaseError(
        f"KISSGS_DATA_DIR: {file.parent / 'jobs'} has the files of {jobs} jobs, but the job database {file} is new and "
        "has none of them; restore it, choose another folder, or move the folder of jobs away to start without jobs"
    )
    opened: list[Any] = []
    first = _engine(file, START_SECONDS, opened)
    try:
        if jobs and not (file.exists() and file.stat().st_size):
            raise refusal
        with _writing(first).begin() as session:
            _check(session, refusal if jobs else None)
        engine = _engine(file, LOCK_SECONDS)
        engine.connect().close()  # before the first engine closes, which would remove the journal
    except Exception as error:
        for connection in opened:
            keep_open(connection)  # so that an existing journal stays unchanged
        if isinstance(error, SettingsError):
            raise
        reason = error_text(error)
        if reason == "disk I/O error" and shutil.disk_usage(file.parent).free < RESERVE_BYTES:
            reason = DISK_FULL  # the index of the journal does not fit
        hint = next((hint for words, hint in _HINTS.items() if words in reason.lower()), "")
        raise SettingsError(
            f"KISSGS_DATA_DIR: the job database {file} cannot be opened: {reason}" + (f"; {hint}" if hint else "")
        ) from error
    first.dispose()
    return engine, _writing(engine), sessionmaker(engine, expire_on_commit=False)


def _writing(engine: sa.Engine) -> Sessions:
    return sessionmaker(engine.execution_options(kissgs_writes=True), expire_on_commit=False)


def _engine(file: Path, wait: float, opened: list[Any] | None = None) -> sa.Engine:
    """Return an engine for one writer and many readers, with commits that survive crashes and power failures."""
    engine = sa.create_engine(sa.URL.create("sqlite", database=str(file)), hide_parameters=True)  # not data of clients

    @sa.event.listens_for(engine, "connect")
    def tune(connection: Any, record: object) -> None:  # noqa: ANN401
        if opened is not None:
            opened.append(connection)
        connection.isolation_level = None  # transactions begin explicitly, not at the first write
        cursor = connection.cursor()
        for pragma in (f"busy_timeout={int(1000 * wait)}", "synchronous=FULL", "foreign_keys=ON"):
            cursor.execute(f"PRAGMA {pragma}")
        if opened is None:  # else the database may belong to another program
            cursor.execute("PRAGMA journal_mode=WAL")
        cursor.close()

    @sa.event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        writes = connection.get_execution_options().get("kissgs_writes")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")

    return engine


def _check(session: Session, refusal: NewDatabaseError | None) -> None:
    """Check that all tables exist and can be read; if none exists, create them, or raise ``refusal``."""
    connection = session.connection()
    required = set(Base.metadata.tables)
    existing = required & set(sa.inspect(connection).get_table_names())
    values = _meta_values(session) if "meta" in existing else {}
    version = values.get("schema")
    if version is None and not _has_rows(session, existing - {"meta"}):
        if refusal is not None:
            raise refusal
        Base.metadata.create_all(connection)
        session.add_all(
            [Meta(name="schema", value=SCHEMA_VERSION), Meta(name=IDENTITY, value=secrets.randbits(IDENTITY_BITS))]
        )
        session.flush()
        existing = required
    elif version is None:
        raise _damaged("the schema version of its tables is missing")
    elif version != SCHEMA_VERSION:
        raise SettingsError(
            f"the job database has schema version {version:g}, but this service needs {SCHEMA_VERSION}; "
            "use another data folder, or the version of the service that created this one"
        )
    if missing := sorted(required - existing):
        raise _damaged(f"it has no table {missing[0]}")
    if damage := check_pages(connection):
        raise _damaged(damage)
    check_rows(connection)
    with connection.begin_nested() as trial:
        check_writable(connection)
        trial.rollback()
    try:
        for _ in connection.execute(sa.select(Job.__table__), execution_options={"yield_per": 100}):
            pass
    except (ValueError, LookupError) as error:
        raise _damaged(error_text(error)) from error


def _meta_values(session: Session) -> dict[str, float]:
    """Return the rows of ``meta``, checked to be valid numbers: SQLite stores any type in any column."""
    values: dict[str, Any] = {row.name: row.value for row in session.scalars(sa.select(Meta))}
    for name, value in values.items():
        usable = isinstance(value, int | float) and math.isfinite(value)
        if not usable or (name == IDENTITY and not (value >= 0 and float(value).is_integer())):
            raise _damaged(f"its table meta has no valid {name[:32]}")
    return values


def _has_rows(session: Session, tables: set[str]) -> bool:
    """Whether any of these existing tables has a row."""
    found = (sa.select(sa.literal(1)).select_from(Base.metadata.tables[name]).limit(1) for name in sorted(tables))
    return any(session.execute(query).first() for query in found)


def _damaged(how: str) -> SettingsError:
    return SettingsError(
        f"the job database is damaged: {how}; restore it from a backup, "
        "or move it and the folder of jobs away to start without jobs"
    )
