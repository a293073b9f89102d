"""Opening of the job database: an SQLite file in the data folder, or the database of a SQLAlchemy URL."""

from __future__ import annotations

import math
import re
import secrets
import sqlite3
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, NoSuchModuleError
from sqlalchemy.orm import Session, sessionmaker

from ..core.models import SCHEMA_VERSION, Base, Job, Meta
from ..core.settings import SettingsError
from .database_health import (
    IDENTITY,
    check_pages,
    check_rows,
    check_writable,
    error_text,
    keep_open,
    sqlite_file,
)
from .machine import IDENTITY_BITS
from .replicas import JOIN_LOCK, lock

Sessions = sessionmaker[Session]

START_SECONDS = 5.0
"""Maximum wait for a lock at the start, seconds."""

LOCK_SECONDS = 30.0
"""Maximum wait for a lock after the start, seconds."""

IDLE_TRANSACTION_SECONDS = 30.0
"""Seconds after which a transaction that does nothing is ended by PostgreSQL."""

_HINTS = {
    "locked": "another program has locked it; stop that program and start again",
    "lock timeout": "another program has locked it; stop that program and start again",
    "not a database": "restore it from a backup, or set KISSGS_DATABASE_URL to another database",
    "malformed": "restore it from a backup",
    "readonly": "give the service write permission",
    "read-only": "give the service write permission",
}
"""Remedies by parts of the messages of database drivers."""


class NewDatabaseError(SettingsError):
    """The database does not exist or is empty, although the data folder has jobs."""


def connect(url: str, *, create: bool = True) -> tuple[sa.Engine, Sessions, Sessions]:
    """Open the database, check that it is intact, and create its tables if there are none.

    Args:
        url: SQLAlchemy URL.
        create: whether a new database may be created.

    Returns:
        The engine; sessions for writing, each with exclusive access to an SQLite database from its first statement; and
        sessions for reading, which wait for no lock.

    Raises:
        NewDatabaseError: the database is new, and ``create`` is false. Nothing has been created.
        SettingsError: it cannot be opened, is damaged, or has another schema version. It is unchanged.
    """
    opened: list[Any] = []
    first = _engine(url, START_SECONDS, opened)
    file = sqlite_file(first.url)
    if file is None and first.dialect.name == "sqlite":
        raise SettingsError("KISSGS_DATABASE_URL: a database in memory would lose all jobs; use a file")
    try:
        if not create and file is not None and not (file.exists() and file.stat().st_size):
            raise NewDatabaseError("the job database is new")
        with _writing(first).begin() as session:
            _check(session, create=create)
        engine = _engine(url, LOCK_SECONDS)
        engine.connect().close()  # before the first engine closes, which would remove the journal
    except Exception as error:
        for connection in opened:
            if isinstance(connection, sqlite3.Connection):
                keep_open(connection)  # so that an existing journal stays unchanged
        if file is None:
            first.dispose()
        if isinstance(error, SettingsError):
            raise
        reason = error_text(error)
        hint = next((hint for words, hint in _HINTS.items() if words in reason.lower()), "")
        raise SettingsError(
            f"KISSGS_DATABASE_URL: the job database cannot be opened: {reason}" + (f"; {hint}" if hint else "")
        ) from error
    first.dispose()
    return engine, _writing(engine), sessionmaker(engine, expire_on_commit=False)


def _writing(engine: sa.Engine) -> Sessions:
    return sessionmaker(engine.execution_options(kissgs_writes=True), expire_on_commit=False)


def _engine(url: str, wait: float, opened: list[Any] | None = None) -> sa.Engine:
    if re.match(r"postgres(ql)?://", url):
        url = f"postgresql+psycopg://{url.partition('://')[2]}"
    try:  # keep data of clients out of messages and logs
        engine = sa.create_engine(url, pool_pre_ping=not url.startswith("sqlite"), hide_parameters=True)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"KISSGS_DATABASE_URL: the package {error.name} is missing; "
            "for PostgreSQL: pip install 'kissgs[postgresql]'"
        ) from error
    except (ArgumentError, NoSuchModuleError, ValueError) as error:
        raise SettingsError(f"KISSGS_DATABASE_URL: {error_text(error)}; set it to a SQLAlchemy URL") from error
    if engine.dialect.name == "sqlite":
        _tune_sqlite(engine, wait, opened)
    elif engine.dialect.name == "postgresql":
        _tune_postgresql(engine)
    return engine


def _tune_postgresql(engine: sa.Engine) -> None:
    """Refuse encodings that lack characters; end the transactions of a suspended service, which others wait for."""

    @sa.event.listens_for(engine, "connect", insert=True)  # before SQLAlchemy reads texts, which it cannot in SQL_ASCII
    def tune(connection: Any, record: object) -> None:  # noqa: ANN401
        with connection.cursor() as cursor:
            cursor.execute("SHOW server_encoding")
            (found,) = cursor.fetchone()
            encoding = found if isinstance(found, str) else found.decode("ascii")  # bytes in SQL_ASCII
            if encoding != "UTF8":
                raise SettingsError(
                    f"KISSGS_DATABASE_URL: the database has the encoding {encoding}, but jobs need UTF8; create "
                    "another with CREATE DATABASE … ENCODING 'UTF8' TEMPLATE template0"
                )
            cursor.execute(f"SET idle_in_transaction_session_timeout = {int(1000 * IDLE_TRANSACTION_SECONDS)}")
        connection.commit()


def _tune_sqlite(engine: sa.Engine, wait: float, opened: list[Any] | None) -> None:
    """Set up SQLite for one writer and many readers, with commits that survive crashes and power failures."""

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


def _check(session: Session, *, create: bool) -> None:
    """Check that all tables exist and can be read; create them if none exists."""
    connection = session.connection()
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {int(1000 * START_SECONDS)}")
        lock(session, JOIN_LOCK)  # of simultaneous first starts, one creates the tables
    required = set(Base.metadata.tables)
    existing = required & set(sa.inspect(connection).get_table_names())
    values = _meta_values(session) if "meta" in existing else {}
    version = values.get("schema")
    if version is None and not _has_rows(session, existing - {"meta"}):
        if not create:
            raise NewDatabaseError("the job database is empty")
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
            "use another data folder or database, or the version of the service that created it"
        )
    if missing := sorted(required - existing):
        raise _damaged(f"it has no table {missing[0]}")
    if connection.dialect.name == "sqlite" and (damage := check_pages(connection)):
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
        if not usable or (name in (IDENTITY, "folder") and not (value >= 0 and float(value).is_integer())):
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
