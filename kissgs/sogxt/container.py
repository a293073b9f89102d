"""Files of a SOG-XT container: their names, and writing them to a zip or a folder."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path

from kissgs.core.errors import OutputError
from kissgs.formats import ENDINGS
from kissgs.io.containers import open_source
from kissgs.io.files import atomic_file, check_writable, move_into_place, path_state, reason_of, refuse_existing, umask

# Names of a container's files, and of the metadata's checksum.

YAML_NAME, JSON_NAME, SCENE_NAME = "container_meta.yaml", "meta.json", "scene.json"

FORMAT = "sog-xt"  # name of the format in meta.json
CHECKSUM = "kissgs_crc32"  # key of the metadata's checksum, outside kissgs, so that it shows a loss of that block

PLANES = (
    *("active_mask.webp", "means_bytes_0.webp", "means_bytes_1.webp", "opacities.webp", "scales.webp"),
    *("quaternions.webp", "f_dc.webp", "f_rest_labels.webp", "f_rest_centroids.webp"),
)

FILES = (YAML_NAME, JSON_NAME, SCENE_NAME, *PLANES)


# Writing of a container: a folder or a zip, atomically and with the same bytes every time.


def zip_bytes(files: Mapping[str, bytes]) -> bytes:
    """Return a zip of the files, images stored and text deflated; equal files give equal bytes (no time, no system)."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, data in files.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_STORED if name.endswith(".webp") else zipfile.ZIP_DEFLATED
            entry.create_system = 3
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data, compresslevel=9)
    return buffer.getvalue()


def stored_sizes(files: Mapping[str, bytes], *, packed: bool) -> tuple[int, dict[str, int]]:
    """Return the total size in bytes, and that of each file: as a zip if ``packed``, else as a folder."""
    if not packed:
        sizes = {name: len(data) for name, data in files.items()}
        return sum(sizes.values()), sizes
    archive = zip_bytes(files)
    with open_source(archive) as stored:
        return len(archive), {name: stored.size(name) for name in files}


def is_packed(path: Path) -> bool:
    """Whether a container of that name is a zip, not a folder."""
    return path.suffix.lower() in ENDINGS


def write_container(
    files: Mapping[str, bytes], path: Path, *, overwrite: bool = False, names: Collection[str] = ()
) -> int:
    """Write a container atomically: a zip if the name ends in ``.zip`` or ``.sog``, else a folder; return its bytes. A
    folder is replaced only if it holds the files of a container, or those of ``names``, and nothing else."""
    check_destination(path, overwrite=overwrite, names={*files, *names})
    if not is_packed(path):
        _write_directory(files, path)
        return sum(map(len, files.values()))
    data = zip_bytes(files)
    with atomic_file(path, overwrite=overwrite) as file:
        file.write(data)
    return len(data)


def check_destination(path: Path, *, overwrite: bool, names: Collection[str] = FILES) -> None:
    """Raise OutputError if a container may not be written to ``path``; called before the work starts. ``names`` are the
    only files that a folder may hold to be replaced."""
    if is_packed(path):
        refuse_existing(path, overwrite=overwrite)
        return
    present, folder = path_state(path)
    if present and not overwrite:
        raise OutputError(f"{path} exists already; choose another name or allow overwriting (--force)")
    try:
        found = {entry.name for entry in path.iterdir()} if folder else set()
    except OSError as error:
        raise OutputError(f"cannot list {path}: {reason_of(error)}") from error
    if present and (not folder or found - set(names)):
        raise OutputError(f"{path} holds more than a container; name an empty or a new folder, or a .zip file")
    check_writable(path)


def _write_directory(files: Mapping[str, bytes], path: Path) -> None:
    temporary: Path | None = None
    try:
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=".kissgs.", suffix=".part"))
        for name, data in files.items():
            with (temporary / name).open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
        temporary.chmod(0o777 & ~umask())
        move_into_place(temporary, path)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {reason_of(error)}") from error
    finally:
        if temporary is not None and temporary.exists():
            shutil.rmtree(temporary)
