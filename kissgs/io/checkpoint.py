"""Checkpoints of trainers: those of gsplat (``.pt``) and of nerfstudio's splatfacto (``.ckpt``).

torch reads them with ``weights_only``: of the pickle in a file only tensors and plain containers are made, and nothing
else that it names is imported or called. Both hold the values of a ``.ply``, with other names and shapes. Where several
GPUs trained a scene, gsplat gives each of them a share of the Gaussians and a file of its own.
"""

from __future__ import annotations

import math
import re
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.context import TORCH_MISSING, Progress, silent
from kissgs.core.errors import InvalidSceneError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, SH_C0, Splats
from kissgs.io.files import SceneFile, listed, open_scene_file, refuse_degree, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, ReadOptions

if TYPE_CHECKING:
    from torch import Tensor

_SPLATFACTO = {"sh0": "features_dc", "shN": "features_rest"}  # its names of attributes, where they are not gsplat's
_RANK = re.compile(r"(.+_rank)([0-9]{1,4})(\.(?:pt|ckpt))", re.IGNORECASE)
_MOST_VALUES = 72  # of a Gaussian in any attribute: a tensor may claim more values than its file has
_MOST_PICKLE_BYTES = 1 << 24  # without the tensors, which are other files of the zip
_LOADING = Lock()  # what torch may unpickle, and Python's filter of warnings, are those of all threads


def read_checkpoint(
    source: Path, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene without cleaning it: quaternions of any length are kept. The files of other ranks beside the source
    are read too, in their order."""
    progress("read", 0.0)
    files = ranks(source)
    parts = [_tensors(file) for file in files]
    refuse_more_than(reading.max_compressed, _count(parts), source.name)
    splats = _scene(parts, source.name)
    progress("read", 1.0)
    note = f"read from {listed([file.name for file in files])}"
    return replace(splats, notes=(note,)) if len(files) > 1 else splats


def _describe(source: Path, level: int) -> Facts:
    parts = [_tensors(file) for file in ranks(source)]
    first = _scene([{name: tensor[:1] for name, tensor in parts[0].items()}], source.name)
    return Facts(title="checkpoint of a trainer", count=_count(parts), sh_degree=first.sh_degree)


def _count(parts: Sequence[Mapping[str, Tensor]]) -> int:
    return sum(len(part["means"]) for part in parts)


def _scene(parts: Sequence[Mapping[str, Tensor]], name: str) -> Splats:
    """Return the scene of the tensors of all ranks."""
    arrays: dict[str, Any] = {}
    degree = math.isqrt(1 + parts[0]["shN"].shape[1]) - 1 if parts[0]["shN"].ndim == 3 else 0
    refuse_degree(degree, name)
    try:
        for each in ATTRIBUTES:
            arrays[each] = np.concatenate([part[each].float().numpy() for part in parts])
        arrays["opacities"] = arrays["opacities"].reshape(-1)
        arrays["sh0"] = arrays["sh0"].reshape(-1, 3)
        splats = Splats(**arrays)
    except (InvalidSceneError, ValueError, TypeError, RuntimeError) as error:  # ranks or shapes that do not fit, too
        raise InvalidSceneError(f"{name} has attributes that make no scene: {error}; save it again") from error
    if "features_dc" in parts[0] and splats.sh_degree == 0:  # splatfacto's colours are sigmoids, then
        with np.errstate(over="ignore"):
            splats.sh0[:] = (1 / (1 + np.exp(-splats.sh0)) - 0.5) / SH_C0
    return splats


def ranks(path: Path) -> list[Path]:
    """Return the files of all ranks of the same step, in their order; the path itself where there is one only.

    Raises:
        InvalidSceneError: that of one rank is missing, or there twice.
    """
    named = _RANK.fullmatch(path.name)
    if named is None or not path.is_file():
        return [path]
    matches = [_RANK.fullmatch(each.name) for each in path.parent.iterdir()]
    same = [each for each in matches if each and each.group(1, 3) == named.group(1, 3)]
    found = {int(each[2]): path.with_name(each.string) for each in same}
    if len(found) < len(same):
        twice = listed(sorted(each.string for each in same))
        raise InvalidSceneError(f"two files hold the same rank's share of the Gaussians: {twice}; remove one of them")
    if missing := set(range(max(found))) - set(found):
        raise InvalidSceneError(
            f"{path.name} holds a share of the Gaussians, and that of rank {min(missing)} is not beside it; put the "
            "files of all ranks into one folder"
        )
    return [found[rank] for rank in sorted(found)]


def one_per_step(names: Sequence[str]) -> list[str]:
    """Return the names of scenes without the further ranks of the same step, which are read with the first."""
    first = dict[object, str]()
    for n, name in enumerate(names):
        named = _RANK.fullmatch(name)
        first.setdefault(n if named is None else named.group(1, 3), name)
    return list(first.values())


def _tensors(source: Path) -> dict[str, Tensor]:
    """Return the tensors of a file by attribute, of splatfacto also by its own names; their values stay in the file."""
    try:
        import torch
    except (ImportError, OSError) as error:  # OSError: of a library that it needs
        raise UnsupportedError(f"a checkpoint needs {TORCH_MISSING}") from error
    name, document = source.name, _load(source)
    found = document.get("splats", document.get("pipeline")) if isinstance(document, Mapping) else None
    if not (isinstance(document, Mapping) and isinstance(found, Mapping)):
        raise InvalidSceneError(
            f"{name} is no checkpoint of a scene: it has neither 'splats' (gsplat) nor 'pipeline' (nerfstudio's "
            "splatfacto); export the scene as .ply"
        )
    tensors, missing = dict[str, torch.Tensor](), list[str]()
    for attribute in ATTRIBUTES:
        own = attribute if "splats" in document else _SPLATFACTO.get(attribute, attribute)
        stored = own if "splats" in document else f"_model.gauss_params.{own}"
        tensor = found.get(stored)
        if tensor is None:
            missing.append(stored)
            continue
        # Of the class, as a parameter in a file may have attributes of these names; anything else counts as integers.
        plain = torch.Tensor.detach(tensor) if isinstance(tensor, torch.Tensor) else torch.zeros(1, dtype=torch.int64)
        usable = plain.layout == torch.strided and plain.device.type == "cpu" and not plain.is_nested
        usable = usable and plain.is_floating_point() and plain.ndim > 0
        if not (usable and plain.numel() <= _MOST_VALUES * len(plain)):
            raise InvalidSceneError(f"{name}: {stored} is no array of floating-point numbers; save the scene again")
        tensors[own] = tensors[attribute] = plain.resolve_neg()
    if missing:
        remedy = "save all attributes of a scene that was trained without app_opt"
        remedy = "nerfstudio before 1.1 wrote it: export the scene as .ply" if "_model.means" in found else remedy
        raise InvalidSceneError(f"{name} has no {listed(missing)}; {remedy}")
    return tensors


def _load(source: Path) -> object:
    from pickle import UnpicklingError

    import torch

    # Learning rates of nerfstudio's optimisers are NumPy's numbers; their pickles have either name of the function.
    scalar: Any = np.float64(0).__reduce__()[0]
    safe: list[Any] = [np.dtype, type(np.dtype(np.float64)), scalar, (scalar, "numpy.core.multiarray.scalar")]
    with open_scene_file(source) as opened, _LOADING, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _check_zip(opened)
        try:
            with torch.serialization.safe_globals(safe):
                return torch.load(source, map_location="cpu", weights_only=True, mmap=True)
        except UnpicklingError as error:
            named = re.search(r"GLOBAL (\S+) was not", str(error))
            more = f" (it has {listed([named[1]])})" if named else ""
            raise InvalidSceneError(
                f"{opened.name} is no checkpoint, or holds more than tensors and numbers{more}; the rest could run "
                "code, so none of it is read: export the scene as .ply"
            ) from error
        except Exception as error:  # of many kinds where a file is damaged
            raise opened.invalid("is no checkpoint that torch can read") from error


def _check_zip(opened: SceneFile) -> None:
    """Refuse files whose tensors cannot be mapped: torch would take compressed bytes for numbers."""
    try:
        with zipfile.ZipFile(opened.file) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        remedy = "save it again, by torch 1.6 or newer"
        raise InvalidSceneError(f"{opened.name} is no zip, as checkpoints are; {remedy}") from error
    pickles = [entry.file_size for entry in entries if entry.filename.endswith("data.pkl")]
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise InvalidSceneError(f"{opened.name} was compressed after it was saved; save it again with torch.save")
    if max(pickles, default=0) > _MOST_PICKLE_BYTES:
        raise InvalidSceneError(f"{opened.name} holds much more than tensors; export the scene as .ply")


FORMAT = Codec(info=_describe, read=read_checkpoint)
