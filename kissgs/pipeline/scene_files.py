"""Scenes in files: recognise, describe, read and decode every format, write those that are no containers."""

from __future__ import annotations

import io
import shlex
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kissgs.core.context import JobProgress, Progress, silent
from kissgs.core.errors import InvalidContainerError, OutputError, UnsupportedError
from kissgs.core.positions import WORLD, centred, in_world, origin_for, relative_to, world_positions
from kissgs.core.splats import ATTRIBUTES, Cleaned, Splats, clean
from kissgs.formats import ENDINGS, FORMATS, LEVELS_NAME, LOD_NAME, SCENE_ENDINGS, output_format
from kissgs.io.checkpoint import ranks
from kissgs.io.containers import (
    MAX_METADATA_BYTES,
    META_NAME,
    ZIP_MAGICS,
    MemorySource,
    Source,
    is_packed,
    open_source,
    sniff_format,
    zip_names,
)
from kissgs.io.files import BinaryWriter, atomic_file, listed, parse_json, reason_of, refuse_existing, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Facts, Match, ReadOptions
from kissgs.sogxt import YAML_NAME

# Recognition of scene formats: by content where a format has a mark, else by the ending of the name.

HEAD_BYTES = 512  # bytes at the beginning of a file that recognition needs
_STREAMED = {each.manifest: name for name, each in FORMATS.items() if each.manifest}  # by manifest


def recognise(source: Path | bytes | Mapping[str, bytes], *, name: str | None = None, size: int | None = None) -> str:
    """Return the format of a scene: a file, a folder, the bytes of a file, or a container's files in memory.

    The metadata file of a container and the manifest of a streamed scene stand for their folder, the folder of INRIA's
    trainer for the scene in it. ``.splat`` is recognised by its name only, checkpoints too.

    Args:
        source: the scene, or the first 512 bytes of a file, of which every zip then counts as "sogxt".
        name: name of the file, if ``source`` has none or another one.
        size: bytes of the whole file, if ``source`` is only its beginning.

    Raises:
        InvalidContainerError: a folder holds no container and no streamed scene.
    """
    if isinstance(source, Mapping):
        return _container_format(MemorySource(source), "sogxt")
    name = ("" if isinstance(source, bytes) else source.name) if name is None else name
    name = name.lower()
    if isinstance(source, Path):
        root = scene_root(source)
        if _is_folder(root):
            _check_folder(root)
            return _STREAMED.get(name) or _packed_format(root, "sogxt")
        if _is_folder(source):
            source, name = root, root.name
    head, found_size = _beginning(source)
    match, by_content = _by_content(head, found_size if size is None else size)
    if match == Match.SURE:
        return by_content
    ending = Path(name).suffix
    of_ending = next((kind for kind, each in FORMATS.items() if ending in each.endings), "ply")
    if FORMATS[of_ending].by_ending and (FORMATS[of_ending].is_pickle or head[:4] not in ZIP_MAGICS):
        return of_ending
    if is_container(source):
        return _packed_format(source, "sog" if of_ending == "sog" else "sogxt")
    if match == Match.LIKELY or (match == Match.POSSIBLE and of_ending == "ply"):
        return by_content
    return of_ending


def _by_content(head: bytes, size: int) -> tuple[Match, str]:
    """Return the format that the beginning of a file of ``size`` bytes matches best; none for a zip."""
    best = Match.NO, "ply"
    if head[:4] in ZIP_MAGICS:  # the modules of other formats need not be loaded
        return best
    for name, each in FORMATS.items():
        if not each.is_container:
            best = max(best, (each.codec.sniff(head, size), name), key=lambda found: found[0])
            if best[0] == Match.SURE:
                return best
    return best


def scene_root(path: Path) -> Path:
    """Return what a path stands for: the folder of a container or streamed scene for its metadata or manifest, the last
    scene in a folder that INRIA's trainer has written; else the path itself."""
    if path.name in (META_NAME, *_STREAMED) and path.is_file():
        return path.parent
    if not _is_folder(path) or _has_metadata(path):
        return path
    scenes = path.glob("point_cloud/iteration_[0-9]*/point_cloud.ply")
    in_order = sorted(scenes, key=lambda scene: (len(scene.parent.name), scene))  # of the numbers
    return next((scene for scene in reversed(in_order) if scene.is_file()), path)


def unused_cameras_note(scene: Path) -> str:
    """Return a note that the cameras beside a scene of INRIA's trainer were not used; empty where there are none."""
    above = scene.parents if len(scene.parents) > 2 else scene.absolute().parents
    with suppress(OSError, ValueError):
        for folder in (scene, *above[2:3]):
            files = folder / "cfg_args", folder / "cameras.json"
            if all(file.is_file() for file in files) and scene_root(folder) != folder:
                return f"its cameras were not used: with --views {shlex.quote(str(folder))} it takes fewer bytes"
    return ""


def _has_metadata(folder: Path) -> bool:
    with suppress(OSError, ValueError):
        return any((folder / name).is_file() for name in (YAML_NAME, META_NAME, *_STREAMED))
    return False


def is_container(source: Path | bytes) -> bool:
    """Whether a source that is no folder is a zip. A zip may have any name, and a prefix such as a self-extractor. If
    the file cannot be opened, the ending ``.zip`` decides."""
    if isinstance(source, bytes):
        return sniff_format(io.BytesIO(source)) == "zip"
    with suppress(OSError, ValueError):
        if source.is_file():  # opening a named pipe would block
            with source.open("rb") as file:
                return sniff_format(file) == "zip"
    return is_packed(source)


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def _check_folder(folder: Path) -> None:
    """Refuse a folder that is no container, and name the scenes in it, or below it where INRIA's trainer puts them."""
    if _has_metadata(folder):
        return
    try:
        found = [path for pattern in ("*", "point_cloud/iteration_*/*") for path in sorted(folder.glob(pattern))]
        scenes = [path for path in found if path.suffix.lower() in (*ENDINGS, *SCENE_ENDINGS) and path.is_file()]
    except (OSError, ValueError):
        return  # the reader says why
    if scenes:
        names = listed([str(path.relative_to(folder)) for path in scenes])
        raise InvalidContainerError(f"{folder!s:.200} is a folder, not a scene; name a file in it: {names}")
    raise InvalidContainerError(
        f"{folder!s:.200} is a folder without a scene: it has neither {YAML_NAME} nor {META_NAME}, {LOD_NAME} or "
        f"{LEVELS_NAME}; name the file of a scene, or the folder of a container"
    )


def _beginning(source: Path | bytes) -> tuple[bytes, int]:
    """Return the first bytes and the size of a file; nothing of what cannot be read."""
    if isinstance(source, bytes):
        return source[:HEAD_BYTES], len(source)
    with suppress(OSError, ValueError):
        if source.is_file():  # opening a named pipe would block
            with source.open("rb") as file:
                return file.read(HEAD_BYTES), source.stat().st_size
    return b"", 0


def _packed_format(source: Path | bytes, damaged: str) -> str:
    """Return the format of a folder or a zip; ``damaged`` if it cannot be read, whose reader then says why."""
    try:
        if isinstance(source, bytes) or not _is_folder(source):
            with io.BytesIO(source) if isinstance(source, bytes) else source.open("rb") as file:
                names = {name.replace("\\", "/").rsplit("/", 1)[-1] for name in zip_names(file)}
            if found := _streamed_format(names):
                return found
        with open_source(source) as files:
            return _container_format(files, damaged)
    except (InvalidContainerError, OSError, ValueError):
        return damaged


def _streamed_format(names: Collection[str]) -> str | None:
    return next((kind for manifest, kind in _STREAMED.items() if manifest in names), None)


def _container_format(files: Source, unknown: str) -> str:
    """Tell the containers apart: only SOG-XT has a YAML file, and a mask in ``meta.json``."""
    names = files.names()
    if found := _streamed_format(names):
        return found
    if YAML_NAME in names or META_NAME not in names:
        return "sogxt" if YAML_NAME in names else unknown
    try:
        document = parse_json(files.read(META_NAME, MAX_METADATA_BYTES), META_NAME)
    except InvalidContainerError:
        return unknown
    plain = isinstance(document, dict) and "means" in document and document.keys().isdisjoint({"mask", "gridSide"})
    return "sog" if plain else unknown


# Writing of scenes. Containers are written by ``compress``.


def write_scene(
    file: BinaryWriter, splats: Splats, kind: str, *, raw_axes: bool = False, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a scene in a format, which all but ``ply`` need cleaned; return what the format cannot hold. Each loss
    beyond the steps that the format always has is one phrase."""
    ending = f".{kind}"
    codec = next(each.codec for each in FORMATS.values() if ending in each.written)
    if kind == "ply":
        return codec.write[ending](file, splats, raw_axes, progress)
    splats = clean(splats)[0]
    notes = codec.write[ending](file, splats, raw_axes, progress)
    if splats.origin != WORLD:
        kept = "records it as a translation" if codec.records_origin else "does not record it"
        rounded = origin_for(world_positions(splats), splats.scales) != WORLD
        reason = ", because float32 would round those of the world" if rounded else ""
        notes = (*notes, f"{relative_to(splats.origin)}{reason}; {ending} {kept}")
    return notes


# Scenes in files.

AnyPath = str | PathLike[str]


def load(
    path: AnyPath,
    *,
    max_gaussians: int | None = None,
    level: int = 0,
    raw_axes: bool = False,
    origin: Literal["auto"] | None = None,
    antialiased: bool | None = None,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Read and clean a scene of any format: see docs/reference/formats.md.

    Args:
        path: ``.ply``, ``.spz``, ``.splat``, ``.ksplat``, ``.glb`` or ``.gltf``; a SOG-XT or SOG container (zip,
            folder, or its ``meta.json``); a streamed scene (zip, folder, or its ``lod-meta.json`` or ``levels.json``);
            a checkpoint of gsplat (``.pt``) or splatfacto (``.ckpt``); the folder of INRIA's trainer.
        max_gaussians: see :class:`kissgs.ReadOptions`, as for ``level`` and ``raw_axes``.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so.
        origin: see :class:`kissgs.ReadOptions`. By default, positions are those of the world wherever float32 can hold
            them; else they are relative to ``origin`` of the scene.
        antialiased: whether the scene was trained with antialiasing (:class:`kissgs.Splats`); None: as the file says.
        threads: number of threads; 0 means one per processor.
        progress: receives events.

    Raises:
        InvalidSceneError: the file is not a usable scene.
        InvalidContainerError: the container is damaged.
        UnsupportedError: the file is valid, but uses a feature that kissgs does not read.
    """
    reading = ReadOptions(
        max_gaussians=max_gaussians, level=level, raw_axes=raw_axes, origin=origin, antialiased=antialiased
    )
    splats, cleaned = clean(read_scene(Path(path), reading, threads=threads, progress=progress))
    splats = replace(splats, notes=(*splats.notes, *cleaned.notes))
    return splats if origin == "auto" else in_world(splats)


def save(
    splats: Splats, path: AnyPath, *, overwrite: bool = False, raw_axes: bool = False, progress: Progress = silent
) -> tuple[str, ...]:
    """Write a scene atomically, in the format that the ending of ``path`` names: see docs/reference/formats.md.

    ``.ply`` (binary, INRIA layout, at the scene's own SH degree) holds every number bit by bit. For the others,
    ``.compressed.ply``, ``.spz``, ``.splat``, ``.glb`` and ``.spz.glb``, the scene is cleaned. Containers are written
    by :func:`compress`.

    Args:
        splats: the scene; it is not changed.
        path: file to write.
        overwrite: replace the file if it exists.
        raw_axes: write ``.spz`` with the axes of a ``.ply``, as some tools expect them.
        progress: receives events.

    Returns:
        What the format cannot hold beyond its usual precision, one phrase each; nothing for ``.ply``.

    Raises:
        OutputError: the file exists and ``overwrite`` is false, its ending is of no such format, or writing fails.
        UnsupportedError: the format cannot hold the scene, such as ``.glb`` one without Gaussians.
    """
    kind = output_format(Path(path))
    with atomic_file(Path(path), overwrite=overwrite) as file:
        return write_scene(file, splats, kind, raw_axes=raw_axes, progress=progress)


def save_ply(splats: Splats, path: AnyPath, *, overwrite: bool = False, progress: Progress = silent) -> None:
    """Write a scene atomically as an exact ``.ply``, also where its name ends in ``.compressed.ply``."""
    check_ply(Path(path), overwrite=overwrite)
    with atomic_file(Path(path), overwrite=overwrite) as file:
        write_scene(file, splats, "ply", progress=progress)


def check_ply(path: Path, *, overwrite: bool) -> None:
    """Raise OutputError if a scene cannot be written to ``path`` as ``.ply``."""
    if path.suffix.lower() != ".ply":
        raise OutputError(f"{path}: a scene is written as .ply; use compress to write a container")
    refuse_existing(path, overwrite=overwrite)


def open_scene(
    source: Splats | AnyPath | bytes, reading: ReadOptions, threads: int, progress: Progress
) -> tuple[Splats, Cleaned, int]:
    """Read and clean a scene; return it, the defects that were corrected, and the bytes of the source."""
    if isinstance(source, Splats):
        splats = reading.marked(source)
        splats, cleaned = clean(centred(splats) if reading.origin == "auto" else splats)
        return splats, cleaned, source.nbytes
    progress("read", 0.0)
    scene = source if isinstance(source, bytes) else Path(source)
    splats, cleaned = clean(read_scene(scene, reading, threads=threads, progress=progress))
    return splats, cleaned, len(scene) if isinstance(scene, bytes) else stored_bytes(scene)


def read_scene(
    source: Path | bytes | Mapping[str, bytes],
    reading: ReadOptions = DEFAULT_READ_OPTIONS,
    *,
    threads: int = 0,
    progress: Progress = silent,
    only_containers: bool = False,
) -> Splats:
    """Read a scene without cleaning. With ``only_containers``, a ``.ply`` is refused."""
    found = recognise(source)
    root = scene_root(source) if isinstance(source, Path) else source
    if only_containers and found == "ply":
        found = "sogxt"  # whose reader says what is wrong
    if found == "sogxt" and isinstance(root, Path | bytes) and b"/data.pkl" in _beginning(root)[0]:
        raise UnsupportedError("a checkpoint of a trainer is read from a file whose name ends in .pt or .ckpt only")
    refuse_level(found, root, reading.level)
    splats = reading.marked(FORMATS[found].codec.read(root, reading, threads, progress))
    if isinstance(source, Path) and isinstance(root, Path) and source in root.parents:
        splats = replace(splats, notes=(f"the scene is {root.relative_to(source)}", *splats.notes))
    return centred(splats) if reading.origin == "auto" else splats


def has_levels(path: Path) -> bool:
    """Whether a scene is streamed, so that it has levels of detail."""
    return bool(FORMATS[recognise(path)].manifest)


def refuse_level(kind: str, source: Path | bytes | Mapping[str, bytes], level: int) -> None:
    """Refuse a level of detail, but for the finest, of a readable scene in a format that has none."""
    if level and not FORMATS[kind].manifest:
        if not isinstance(source, Mapping):
            FORMATS[kind].codec.info(source, 0)  # says what is wrong with a scene that is not readable
        raise UnsupportedError(f"there is no level {level}: this scene has no levels of detail, so leave the level out")


def reading_notes(splats: Splats) -> list[str]:
    """Return what reading a scene left out or changed, and where its positions are if they are not the world's."""
    where = [] if splats.origin == WORLD else [f"{relative_to(splats.origin)}, which containers record"]
    return [*splats.notes, *where]


def stored_bytes(path: Path) -> int:
    """Return the size of a file, with other ranks' of a checkpoint, or of all files in a folder and below, in bytes."""
    try:
        root = scene_root(path)
        if not root.is_dir():
            return sum(file.stat().st_size for file in ranks(root))
        return sum(entry.stat().st_size for entry in root.rglob("*") if entry.is_file())
    except OSError as error:
        raise InvalidContainerError(f"cannot read {path}: {reason_of(error)}") from error


# ``decompress``: it needs no encoder, so that a small container is decoded soon after the program starts.


def decompress(
    source: AnyPath | bytes | Mapping[str, bytes],
    destination: AnyPath | None = None,
    *,
    max_gaussians: int | None = None,
    level: int = 0,
    raw_axes: bool = False,
    antialiased: bool | None = None,
    overwrite: bool = False,
    threads: int = 0,
    progress: Progress = silent,
) -> Splats:
    """Decode a SOG-XT container, or a scene of another compressed format.

    Args:
        source: path of a zip or a folder, the bytes of a zip, or the files in memory; or any other file that
            :func:`kissgs.load` reads, except a ``.ply``.
        destination: ``.ply`` to write; by default nothing is written.
        max_gaussians: see :class:`kissgs.ReadOptions`, as for ``level`` and ``raw_axes``.
        level: level of detail of a streamed scene; 0 is the finest.
        raw_axes: read ``.spz`` that stores the axes of a ``.ply`` without saying so.
        antialiased: see :func:`kissgs.load`.
        overwrite: replace ``destination`` if it exists.
        threads: number of threads; 0 means one per processor.
        progress: receives events.

    Returns:
        The scene exactly as stored: quaternions are as quantised, so their length is only approximately 1. Only
        formats other than containers can hold values that cannot be drawn, such as NaN: such a scene is cleaned as by
        :func:`kissgs.load`, and ``notes`` says so. Positions are those of the world where float32 can hold them, else
        relative to its ``origin``.

    Raises:
        InvalidContainerError: the container is damaged.
        InvalidSceneError: a file of another format is damaged.
        UnsupportedError: the file has a feature that kissgs does not read.
        OutputError: ``destination`` cannot be written.
    """
    if destination is not None:
        check_ply(Path(destination), overwrite=overwrite)
    scene = source if isinstance(source, bytes | Mapping) else Path(source)
    progress = JobProgress(progress, [("decode", 1.0), ("write", 1.0)])
    splats = read_scene(
        scene,
        ReadOptions(max_gaussians=max_gaussians, level=level, raw_axes=raw_axes, antialiased=antialiased),
        threads=threads,
        progress=progress,
        only_containers=True,
    )
    if not FORMATS[recognise(scene)].is_container:
        usable, cleaned = clean(splats)
        if cleaned.notes:
            splats = replace(usable, notes=(*splats.notes, *cleaned.notes))
    splats = in_world(splats)
    if destination is not None:
        save_ply(splats, destination, overwrite=overwrite, progress=progress)
    progress.stop()
    return splats


# Describe the contents of a scene file, for ``kissgs info``.


@dataclass(frozen=True, slots=True, kw_only=True)
class Info(Facts):
    """Facts from the metadata of a scene; where it is decoded for them, with the ranges of its finite values."""

    path: str
    kind: str
    bytes: int  # size of the file or the folder

    @property
    def bits_per_gaussian(self) -> float:
        """Bits of the whole file per Gaussian; of a streamed scene, those of the level's files."""
        total = sum(self.parts.values()) if FORMATS[self.kind].manifest else self.bytes
        return 8 * total / max(self.count, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all fields and derived figures for JSON, without the texts for the terminal."""
        found = {"path": self.path, **asdict(self), "bits_per_gaussian": self.bits_per_gaussian}
        return {name: value for name, value in found.items() if name not in ("title", "lines")}


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneInfo:
    """Properties of a scene that its headers and metadata state.

    Attributes:
        format: format of the scene.
        count: Gaussians.
        sh_degree: 0 to 3.
    """

    format: str
    count: int
    sh_degree: int


def read_scene_info(path: Path, *, name: str | None = None) -> SceneInfo:
    """Read the headers and metadata of a scene, without decoding it; errors in the rest are not found.

    Args:
        path: the file or folder.
        name: name of the file, if ``path`` has another one; the ending tells ``.splat``.

    Raises:
        KissgsError: the file is not a scene.
    """
    kind = recognise(path, name=name)
    facts = FORMATS[kind].codec.info(scene_root(path), 0)
    return SceneInfo(format=kind, count=facts.count, sh_degree=facts.sh_degree)


def describe(path: Path, reading: ReadOptions = DEFAULT_READ_OPTIONS) -> Info:
    """Describe a scene file. No image of a container is decoded, except SOG-XT's mask if the metadata does not state
    the number of Gaussians."""
    kind = recognise(path)
    refuse_level(kind, scene_root(path), reading.level)
    facts = FORMATS[kind].codec.info(scene_root(path), reading.level)
    if FORMATS[kind].is_container:
        refuse_more_than(reading.max_gaussians, facts.count, str(path))  # no default: no image is decoded
    else:
        splats = read_scene(path, reading)
        facts = replace(
            facts,
            count=len(splats),
            sh_degree=splats.sh_degree,
            ranges={name: _extremes(getattr(splats, name)) for name in ATTRIBUTES if getattr(splats, name).size},
            changed=clean(splats)[1].as_dict(),
            notes=tuple(reading_notes(splats)),
        )
    found = {each.name: getattr(facts, each.name) for each in fields(facts)}
    return Info(path=str(path), kind=kind, bytes=stored_bytes(path), **found)


def _extremes(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    if not np.isfinite(low + high):
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return low, high
