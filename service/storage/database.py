"""Opening the job database: SQLite as a file beside the jobs, or whatever SQLAlchemy's URL names."""

from __future__ import annotations

import math
import re
import secrets
import sqlite3
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, NoSuchModuleError
from sqlalchemy.orm import Session, sessionmaker

from service.core.models import SCHEMA_VERSION, Base, Job, Meta
from service.core.settings import SettingsError
from service.storage.database_health import (
    IDENTITY,
    IDENTITY_BITS,
    change_nothing,
    error_text,
    file_of,
    leave_open,
    read_a_row,
    read_every_page,
)

Sessions = sessionmaker[Session]

START_SECONDS = 5.0
"""How long to wait for another's lock at the start."""

LOCK_SECONDS = 30.0
"""How long to wait for another's lock from then on."""

_HINTS = {
    "locked": "another program holds it; end that, and start again",
    "lock timeout": "another program holds it; end that, and start again",
    "not a database": "restore it from a backup, or name another in KISSGS_DATABASE_URL",
    "malformed": "restore it from a backup",
    "readonly": "let the service write to it",
    "read-only": "let the service write to it",
}
"""What to do about it, by what drivers say."""


class NewDatabaseError(SettingsError):
    """There is no database yet, or it is empty, where one with jobs was expected."""


def connect(url: str, *, may_be_new: bool = True) -> tuple[sa.Engine, Sessions, Sessions]:
    """Open the database, see that it is whole, and make its tables if there are none.

    Args:
        url: of SQLAlchemy.
        may_be_new: whether tables may be made.

    Returns:
        The engine; sessions that write, each a transaction that has an SQLite database to itself from its first
        statement; and sessions that only read and wait for nobody.

    Raises:
        NewDatabaseError: it would be a new one, which it may not be. Nothing has been made.
        SettingsError: it cannot be opened, is damaged, or is of another version. Nothing in it has changed.
    """
    opened: list[Any] = []
    first = _engine(url, START_SECONDS, opened)
    file = file_of(first.url)
    if file is None and first.dialect.name == "sqlite":
        raise SettingsError("KISSGS_DATABASE_URL: a database in memory loses all jobs; name a file")
    try:
        if not may_be_new and file is not None and not (file.exists() and file.stat().st_size):
            raise NewDatabaseError("the job database is new")
        with _writing(first).begin() as session:
            _check(session, may_be_new=may_be_new)
        engine = _engine(url, LOCK_SECONDS)
        engine.connect().close()  # before the first lets go, which would put the journal away
    except Exception as error:
        for connection in opened:
            if isinstance(connection, sqlite3.Connection):
                leave_open(connection)  # a journal that is there stays as it is
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
    try:  # what clients have sent stays out of messages and logs
        engine = sa.create_engine(url, pool_pre_ping=not url.startswith("sqlite"), hide_parameters=True)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"KISSGS_DATABASE_URL: the package {error.name} is missing; for PostgreSQL install kissgs[postgresql]"
        ) from error
    except (ArgumentError, NoSuchModuleError, ValueError) as error:
        raise SettingsError(f"KISSGS_DATABASE_URL: {error_text(error)}; write a URL of SQLAlchemy") from error
    if engine.dialect.name == "sqlite":
        _tune_sqlite(engine, wait, opened)
    return engine


def _tune_sqlite(engine: sa.Engine, wait: float, opened: list[Any] | None) -> None:
    """One writer and any number of readers; what is committed survives a killed process and a power cut."""

    @sa.event.listens_for(engine, "connect")
    def tune(connection: Any, record: object) -> None:  # noqa: ANN401
        if opened is not None:
            opened.append(connection)
        connection.isolation_level = None  # transactions begin where we say, not at the first write
        cursor = connection.cursor()
        for pragma in (f"busy_timeout={int(1000 * wait)}", "synchronous=FULL", "foreign_keys=ON"):
            cursor.execute(f"PRAGMA {pragma}")
        if opened is None:  # else it may be another program's yet
            cursor.execute("PRAGMA journal_mode=WAL")
        cursor.close()

    @sa.event.listens_for(engine, "begin")
    def begin(connection: sa.Connection) -> None:
        writes = connection.get_execution_options().get("kissgs_writes")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")


def _check(session: Session, *, may_be_new: bool) -> None:
    """See that all tables are there and can be read, or that none is; then make them."""
    connection = session.connection()
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {int(1000 * START_SECONDS)}")
    wanted = set(Base.metadata.tables)
    there = wanted & set(sa.inspect(connection).get_table_names())
    facts = _facts(session) if "meta" in there else {}
    version = facts.get("schema")
    if version is None and not _has_rows(session, there - {"meta"}):
        if not may_be_new:
            raise NewDatabaseError("the job database is empty")
        Base.metadata.create_all(connection)
        session.add_all(
            [Meta(name="schema", value=SCHEMA_VERSION), Meta(name=IDENTITY, value=secrets.randbits(IDENTITY_BITS))]
        )
        session.flush()
        there = wanted
    elif version is None:
        raise _damaged("it does not say which version its tables have")
    elif version != SCHEMA_VERSION:
        raise SettingsError(
            f"the job database has tables of version {version:g}, this service of {SCHEMA_VERSION}; "
            "name another data folder or database, or run the service that made it"
        )
    if missing := sorted(wanted - there):
        raise _damaged(f"it has no table {missing[0]}")
    if connection.dialect.name == "sqlite" and (damage := read_every_page(connection)):
        raise _damaged(damage)
    read_a_row(connection)
    with connection.begin_nested() as trial:
        change_nothing(connection)
        trial.rollback()
    try:
        for _ in connection.execute(sa.select(Job.__table__), execution_options={"yield_per": 100}):
            pass
    except (ValueError, LookupError) as error:
        raise _damaged(error_text(error)) from error


def _facts(session: Session) -> dict[str, float]:
    """What the database says of itself; SQLite keeps anything in a column of numbers."""
    facts: dict[str, Any] = {fact.name: fact.value for fact in session.scalars(sa.select(Meta))}
    for name, value in facts.items():
        usable = isinstance(value, int | float) and math.isfinite(value)
        if not usable or (name in (IDENTITY, "folder") and not (value >= 0 and float(value).is_integer())):
            raise _damaged(f"its table meta holds no usable {name[:32]}")
    return facts


def _has_rows(session: Session, tables: set[str]) -> bool:
    """Whether there is anything in tables that are there."""
    found = (sa.select(sa.literal(1)).select_from(Base.metadata.tables[name]).limit(1) for name in sorted(tables))
    return any(session.execute(query).first() for query in found)


def _damaged(how: str) -> SettingsError:
    return SettingsError(
        f"the job database is damaged: {how}; restore it from a backup, "
        "or move it and the data folder's jobs away to begin anew"
    )
