"""Opening the job database: SQLite as a file beside the jobs, or whatever SQLAlchemy's URL names."""

from __future__ import annotations

import re
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from service.models import SCHEMA_VERSION, Base, Meta
from service.settings import SettingsError

Sessions = sessionmaker[Session]


def connect(url: str) -> tuple[sa.Engine, Sessions, Sessions]:
    """Open the database and make its tables if they are not there.

    Returns:
        The engine; sessions that write, each a transaction that has an SQLite database to itself from its first
        statement; and sessions that only read and wait for nobody.

    Raises:
        SettingsError: it cannot be opened, or is of another version.
    """
    if re.match(r"postgres(ql)?://", url):
        url = f"postgresql+psycopg://{url.partition('://')[2]}"
    try:  # what clients have sent stays out of messages and logs
        engine = sa.create_engine(url, pool_pre_ping=not url.startswith("sqlite"), hide_parameters=True)
    except ModuleNotFoundError as error:
        raise SettingsError(
            f"KISSGS_DATABASE_URL: the package {error.name} is missing; for PostgreSQL install kissgs[postgresql]"
        ) from error
    except (ArgumentError, NoSuchModuleError) as error:
        raise SettingsError(f"KISSGS_DATABASE_URL: {error}; write a URL of SQLAlchemy") from error
    if engine.dialect.name == "sqlite":
        _tune_sqlite(engine)
    writing = sessionmaker(engine.execution_options(kissgs_writes=True), expire_on_commit=False)
    try:
        with writing.begin() as session:
            Base.metadata.create_all(session.connection())
            version = session.get(Meta, "schema")
            if version is None:
                session.add(Meta(name="schema", value=SCHEMA_VERSION))
            elif version.value != SCHEMA_VERSION:
                raise SettingsError(
                    f"the job database has tables of version {version.value:g}, this service of {SCHEMA_VERSION}; "
                    "name another data folder or database, or run the service that made it"
                )
    except SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).splitlines()[0]
        raise SettingsError(f"the job database cannot be opened: {reason}") from error
    return engine, writing, sessionmaker(engine, expire_on_commit=False)


def _tune_sqlite(engine: sa.Engine) -> None:
    """One writer and any number of readers; what is committed survives a killed process and a power cut."""

    @sa.event.listens_for(engine, "connect")
    def opened(connection: Any, record: object) -> None:  # noqa: ANN401
        connection.isolation_level = None  # transactions begin where we say, not at the first write
        cursor = connection.cursor()
        for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"):
            cursor.execute(f"PRAGMA {pragma}")
        cursor.close()

    @sa.event.listens_for(engine, "begin")
    def begun(connection: sa.Connection) -> None:
        writes = connection.get_execution_options().get("kissgs_writes")
        connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
