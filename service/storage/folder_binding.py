"""A data folder and its database belong together: each keeps the other's number, and neither works with a stranger.

The service removes the files of jobs that its database says are over. With another database, those would be files of
somebody else.
"""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable
from pathlib import Path

from sqlalchemy.exc import SQLAlchemyError

from service.core.models import ACTIVE
from service.core.settings import ServiceSettings, SettingsError
from service.storage.database import NewDatabaseError
from service.storage.database_health import IDENTITY, IDENTITY_BITS, error_text
from service.storage.job_storage import JobStorage, sync_folder
from service.storage.job_store import Store

NEARLY_FULL = 1 << 20
"""The free bytes of a disk below which a database may not open."""


def open_store(settings: ServiceSettings, storage: JobStorage, clock: Callable[[], float]) -> Store:
    """Open the database of a data folder.

    Raises:
        SettingsError: it cannot be opened, does not belong to the folder, or is in use. Nothing has been removed.
    """
    held = storage.held()
    try:
        store = _open(settings, storage, clock, may_be_new=not held)
    except NewDatabaseError as error:
        raise _unknown(storage, held, "the job database is new and knows none of them") from error
    try:
        _pair(store, storage, held)
        store.acquire_database()
    except BaseException as error:
        store.leave()
        if isinstance(error, SQLAlchemyError):
            raise SettingsError(f"KISSGS_DATABASE_URL: the job database cannot be used: {error_text(error)}") from error
        raise
    return store


def _open(settings: ServiceSettings, storage: JobStorage, clock: Callable[[], float], *, may_be_new: bool) -> Store:
    try:
        return Store(settings.database, clock, may_be_new=may_be_new)
    except SettingsError:
        if storage.free_bytes() >= NEARLY_FULL:
            raise
    storage.remove_uploads()  # this may make the room that the database needs
    return Store(settings.database, clock, may_be_new=may_be_new)


def _pair(store: Store, storage: JobStorage, held: set[str]) -> None:
    """See that database and folder know each other; if neither knows another one, introduce them.

    What was made before both numbers existed is recognised by its jobs.
    """
    database, its_folder = store.fact(IDENTITY), store.fact("folder")
    folder, its_database = read_mark(storage.root, "identity"), read_mark(storage.root, "database")
    share_jobs = bool(held & store.ids())
    named = database is not None and its_database == database
    lost = folder is None and (named or share_jobs)  # the file alone
    if its_folder not in (None, folder) and not lost:
        raise SettingsError(
            "KISSGS_DATABASE_URL, KISSGS_DATA_DIR: this database is that of another data folder; "
            "each service needs its own of both"
        )
    if held and not share_jobs and not named:
        if its_folder is None:
            raise _unknown(storage, held, "the job database knows none of them")
        if its_database is not None:
            raise _unknown(storage, held, "they came with another database than this")
    active = store.ids(*ACTIVE)
    if active and not active & held:
        raise _lost(storage, active)
    mine = next((int(mark) for mark in (folder, its_folder) if mark is not None), secrets.randbits(IDENTITY_BITS))
    number = int(database) if database is not None else secrets.randbits(IDENTITY_BITS)
    if folder is None:
        write_mark(storage.root, "identity", mine)
    if (its_folder, database) != (mine, number):
        store.belong_to(mine, number)
    if its_database != number:
        write_mark(storage.root, "database", number)


def _unknown(storage: JobStorage, held: set[str], why: str) -> SettingsError:
    return SettingsError(
        f"KISSGS_DATA_DIR, KISSGS_DATABASE_URL: {storage.jobs} holds the files of {len(held)} jobs, but {why}; restore "
        "the database that they came with, name it in KISSGS_DATABASE_URL, choose another data folder, or move that "
        "folder away to begin anew"
    )


def _lost(storage: JobStorage, active: set[str]) -> SettingsError:
    return SettingsError(
        f"KISSGS_DATA_DIR, KISSGS_DATABASE_URL: {storage.jobs} holds none of the jobs that wait or run, of which there "
        f"are {len(active)} in the job database; mount or restore that folder, or, if they are lost, make the empty "
        f"folder {storage.jobs / min(active)} and start again to have them reported as failed"
    )


# Marks ---------------------------------------------------------------------------------------------------------------


def read_mark(root: Path, name: str) -> int | None:
    """A number that a data folder keeps: ``identity``, its own, or ``database``, that of its database.

    Raises:
        SettingsError: its file holds something else.
    """
    path = root / name
    try:
        text = path.read_bytes().strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot read {path}: {(error.strerror or '').lower()}") from error
    if text and not re.fullmatch(rb"[0-9]{1,18}", text):
        raise SettingsError(f"KISSGS_DATA_DIR: {path} does not hold a number; restore it, or choose another folder")
    return int(text) if text else None


def write_mark(root: Path, name: str, number: int) -> None:
    """Write such a number, all at once.

    Raises:
        SettingsError: it cannot be written.
    """
    path = root / name
    part = path.with_name(f"{name}.part")
    try:
        part.write_text(f"{number}\n", encoding="ascii")
        part.replace(path)
        sync_folder(root)
    except OSError as error:
        raise SettingsError(f"KISSGS_DATA_DIR: cannot write {path}: {(error.strerror or '').lower()}") from error
