"""Binding of a data folder to its database: each stores the number of the other, and a wrong pair is refused.

The service removes files of jobs that have ended according to its database; with a wrong database, it would remove the
files of others.
"""

from __future__ import annotations

import contextlib
import secrets
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from ..core.models import ACTIVE
from ..core.settings import ServiceSettings, SettingsError
from .database import NewDatabaseError
from .database_health import IDENTITY, error_text
from .job_records import Store
from .job_storage import JobStorage
from .machine import IDENTITY_BITS

NEARLY_FULL_BYTES = 1 << 20
"""Free disk space below which a database may fail to open, bytes."""


def open_store(settings: ServiceSettings, storage: JobStorage, clock: Callable[[], float]) -> Store:
    """Open the database of a data folder.

    Raises:
        SettingsError: it cannot be opened, does not belong to the folder, or is in use. Nothing has been removed.
    """
    stored = storage.job_ids()
    if storage.free_bytes() < NEARLY_FULL_BYTES:
        storage.free_reserve()
    try:
        store = _open(settings, storage, clock, create=not stored)
    except NewDatabaseError as error:
        raise _unknown_jobs_error(storage, stored, "the job database is new and has none of them") from error
    try:
        with store.starting() if storage.shared else contextlib.nullcontext():
            _bind(store, storage, stored)
            if storage.shared:
                storage.replica = store.join()
            else:
                store.acquire_database()
    except BaseException as error:
        store.abandon()
        if isinstance(error, SQLAlchemyError):
            raise SettingsError(f"KISSGS_DATABASE_URL: the job database cannot be used: {error_text(error)}") from error
        raise
    return store


def _open(settings: ServiceSettings, storage: JobStorage, clock: Callable[[], float], *, create: bool) -> Store:
    try:
        return Store(settings.database, clock, create=create)
    except SettingsError:
        if storage.free_bytes() >= NEARLY_FULL_BYTES:
            raise
    storage.remove_uploads()  # this may free enough space for the database
    return Store(settings.database, clock, create=create)


def _bind(store: Store, storage: JobStorage, stored: set[str]) -> None:
    """Check that database and folder belong together; bind them if neither belongs to another one.

    A missing number is restored if the other one, or common jobs, show that they belong together.
    """
    database, its_folder = store.meta_value(IDENTITY), store.meta_value("folder")
    folder, its_database = storage.read_number("identity"), storage.read_number("database")
    share_jobs = bool(stored & store.ids())
    named = database is not None and its_database == database
    lost = folder is None and (named or share_jobs)  # only the file with the number is missing
    if its_folder not in (None, folder) and not lost:
        raise SettingsError(
            f"KISSGS_DATABASE_URL, {storage.setting}: this database belongs to another {_kind(storage)}; "
            f"use a separate database and {_kind(storage)} for each service"
        )
    if stored and not share_jobs and not named:
        if its_folder is None:
            raise _unknown_jobs_error(storage, stored, "the job database has none of them")
        if its_database is not None:
            raise _unknown_jobs_error(storage, stored, "they belong to another database")
    active = store.ids(*ACTIVE)
    if active and storage.shared:  # other replicas may have added and removed jobs meanwhile
        stored = storage.job_ids() | (active - store.ids(*ACTIVE))
    if active and not active & stored:
        raise _missing_jobs_error(storage, active)
    folder_number = next(
        (int(known) for known in (folder, its_folder) if known is not None), secrets.randbits(IDENTITY_BITS)
    )
    number = int(database) if database is not None else secrets.randbits(IDENTITY_BITS)
    if folder is None:
        storage.write_number("identity", folder_number)
    if (its_folder, database) != (folder_number, number):
        store.bind_to(folder_number, number)
    if its_database != number:
        storage.write_number("database", number)


def _unknown_jobs_error(storage: JobStorage, stored: set[str], why: str) -> SettingsError:
    return SettingsError(
        f"{storage.setting}, KISSGS_DATABASE_URL: {storage.place} has the files of {len(stored)} jobs, but {why}; "
        f"restore their database, set KISSGS_DATABASE_URL to it, choose another {_kind(storage)}, or move that "
        "folder away to start without jobs"
    )


def _missing_jobs_error(storage: JobStorage, active: set[str]) -> SettingsError:
    lost = (
        "restore them, or use another database"
        if storage.shared
        else "mount or restore that folder, or, if they are lost, create the empty folder "
        f"{storage.place}/{min(active)} and start again, so that they are recorded as failed"
    )
    return SettingsError(
        f"{storage.setting}, KISSGS_DATABASE_URL: {storage.place} has none of the {len(active)} jobs that are "
        f"queued or running in the job database; {lost}"
    )


def _kind(storage: JobStorage) -> str:
    return "storage" if storage.shared else "data folder"
