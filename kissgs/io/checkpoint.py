"""Checkpoints of trainers: those of gsplat (``.pt``) and of nerfstudio's splatfacto (``.ckpt``).

torch reads them with ``weights_only``: of the pickle in a file only tensors and plain containers are made, and nothing
else that it names is imported or called. Both hold the values of a ``.ply``, with other names and shapes. Where several
GPUs trained a scene, gsplat gives each of them a share of the Gaussians and a file of its own.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from kissgs.core.context import Progress, silent
from kissgs.core.errors import InvalidSceneError, KissgsError, UnsupportedError
from kissgs.core.splats import ATTRIBUTES, SH_C0, SH_REST_COUNTS, Splats, empty_splats
from kissgs.io.conventions import steps
from kissgs.io.files import listed, open_scene_file, refuse_more_than
from kissgs.io.scene_format import DEFAULT_READ_OPTIONS, Codec, Facts, ReadOptions, titled

if TYPE_CHECKING:
    from torch import Tensor

_SPLATFACTO = {"sh0": "features_dc", "shN": "features_rest"}  # its names of attributes, where they are not gsplat's
_PREFIXES = ("_model.gauss_params.", "_model.")  # of splatfacto's attributes; the second in its first versions
_SHAPES: dict[str, tuple[tuple[int, ...], ...]] = {
    "means": ((3,),),
    "quats": ((4,),),
    "scales": ((3,),),
    "opacities": ((), (1,)),
    "sh0": ((3,), (1, 3)),
    "shN": tuple((coefficients, 3) for coefficients in SH_REST_COUNTS),
}
"""Shapes of attributes in files, without the number of Gaussians; the first is that of a scene."""

_RANK = re.compile(r"(?P<step>.+_rank)(?P<rank>[0-9]{1,4})(?P<ending>\.\w+)")


@dataclass(frozen=True, slots=True)
class _Part:
    """The tensors of one file by attribute of a scene, of the shapes that a scene has."""

    trainer: str
    tensors: dict[str, Tensor]
    step: int | None  # training steps before it was written, from 0
    left_out: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        return len(self.tensors["means"])


def read_checkpoint(
    source: Path | bytes, reading: ReadOptions = DEFAULT_READ_OPTIONS, threads: int = 0, progress: Progress = silent
) -> Splats:
    """Read a scene without cleaning it: quaternions of any length are kept. The files of other ranks beside the source
    are read too, in their order."""
    progress("read", 0.0)
    paths, parts = _parts(source)
    count, done = sum(part.count for part in parts), 0
    refuse_more_than(reading.max_compressed, count, _name(source))
    splats = empty_splats(count, parts[0].tensors["shN"].shape[1])
    for part in parts:
        for rows in steps(part.count):
            for name in ATTRIBUTES:
                own = getattr(splats, name)[done + rows.start : done + rows.stop]
                own[:] = part.tensors[name][rows].float().numpy()
        done += part.count
        progress("read", done / max(count, 1))
    if parts[0].trainer == "splatfacto" and splats.sh_degree == 0:  # its colours are sigmoids, then
        with np.errstate(over="ignore"):
            splats.sh0[:] = (1 / (1 + np.exp(-splats.sh0)) - 0.5) / SH_C0
    notes = [f"read together with the other ranks' {listed([path.name for path in paths])}"] * bool(paths)
    if left_out := dict.fromkeys(name for part in parts for name in part.left_out):
        notes.append(f"left out: {listed(list(left_out))}")
    return replace(splats, notes=tuple(notes))


def _describe(source: Path | bytes, level: int) -> Facts:
    paths, parts = _parts(source)
    first, ranks = parts[0], f"{len(parts)} ranks" if paths else ""
    step = None if first.step is None else f"step {first.step}"
    return Facts(
        title=titled(f"checkpoint of {first.trainer}", step, ranks),
        count=sum(part.count for part in parts),
        sh_degree=SH_REST_COUNTS.index(first.tensors["shN"].shape[1]),
        details={"trainer": first.trainer, "step": first.step, "ranks": len(parts)},
    )


def _name(source: Path | bytes) -> str:
    return "the data" if isinstance(source, bytes) else source.name


def _parts(source: Path | bytes) -> tuple[list[Path], list[_Part]]:
    """Return the files of other ranks than the source's, and what all files hold, rank by rank."""
    ranks: list[Path | bytes] = [source] if isinstance(source, bytes) else [*_ranks(source)]
    parts = [_part(each) for each in ranks]
    for rank, part in zip(ranks, parts, strict=True):
        if part.tensors["shN"].shape[1] != parts[0].tensors["shN"].shape[1]:
            raise InvalidSceneError(
                f"{_name(rank)} has another SH degree than {_name(ranks[0])}; train the scene again"
            )
    return [each for each in ranks if isinstance(each, Path) and each != source], parts


def _ranks(path: Path) -> list[Path]:
    """Return the files of all ranks of the same step, in their order; the path itself where there is one only."""
    named = _RANK.fullmatch(path.name)
    if named is None:
        return [path]
    with open_scene_file(path):  # refuses a missing file; the folder is there then
        found = {int(each["rank"]): path.with_name(each.string) for each in _siblings(path, named["step"])}
    found[int(named["rank"])] = path
    missing = next((rank for rank in range(max(found)) if rank not in found), None)
    if missing is not None:
        raise InvalidSceneError(
            f"{path.name} holds a share of the Gaussians, and that of rank {missing} is not beside it; put the files "
            "of all ranks into one folder"
        )
    return [found[rank] for rank in sorted(found)]


def _siblings(path: Path, step: str) -> list[re.Match[str]]:
    matches = [_RANK.fullmatch(each.name) for each in path.parent.iterdir()]
    return [each for each in matches if each and each["step"] == step and each["ending"] == path.suffix]


def _part(source: Path | bytes) -> _Part:
    """Read the tensors of one file, whose values stay in the file until they are used."""
    name, document = _name(source), _load(source)
    if not isinstance(document, Mapping) or document.keys().isdisjoint({"splats", "pipeline"}):
        raise InvalidSceneError(
            f"{name} is no checkpoint of a scene that is known here: it has neither 'splats' (gsplat) nor 'pipeline' "
            "(nerfstudio's splatfacto); export the scene as .ply"
        )
    step = document.get("step")
    trainer = "gsplat" if "splats" in document else "splatfacto"
    found = document["splats" if trainer == "gsplat" else "pipeline"]
    if not isinstance(found, Mapping):
        raise InvalidSceneError(f"{name} has no tensors of a scene; export the scene as .ply")
    names, left_out = {each: each for each in ATTRIBUTES}, []
    if trainer == "splatfacto":
        prefix = next((each for each in _PREFIXES if f"{each}means" in found), _PREFIXES[0])
        names = {each: prefix + _SPLATFACTO.get(each, each) for each in ATTRIBUTES}
    else:
        if {"features", "colors"} <= found.keys():
            raise UnsupportedError(
                f"{name} holds features that a network turns into colours (app_opt), which is not supported; train "
                "without it"
            )
        left_out = [str(each) for each in (*document, *found) if each not in {"step", "splats", *ATTRIBUTES}]
    tensors = _tensors(name, found, names)
    return _Part(trainer, tensors, step if isinstance(step, int) else None, tuple(left_out))


def _tensors(name: str, found: Mapping[Any, Any], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Return the tensors of a scene with the shapes of :class:`Splats`; ``names`` are those in the file."""
    import torch

    missing = [stored for stored in names.values() if stored not in found]
    if missing:
        raise InvalidSceneError(f"{name} has no {listed(missing)}; save the scene with all its attributes")
    count, tensors = 0, dict[str, torch.Tensor]()
    for attribute, stored in names.items():
        tensor = found[stored]
        usable = isinstance(tensor, torch.Tensor) and tensor.layout == torch.strided and tensor.device.type == "cpu"
        if not (usable and tensor.is_floating_point() and tensor.ndim):
            raise InvalidSceneError(f"{name}: {stored} is no array of floating-point numbers; save the scene again")
        count = count if tensors else len(tensor)
        shapes = [(count, *shape) for shape in _SHAPES[attribute]]
        if tuple(tensor.shape) not in shapes:
            wanted = " or ".join(map(str, shapes))
            raise InvalidSceneError(
                f"{name}: {stored} has the shape {tuple(tensor.shape)}, not {wanted}; save the scene again"
            )
        tensors[attribute] = tensor.detach().reshape(shapes[0] if attribute != "shN" else tensor.shape)
    return tensors


def _load(source: Path | bytes) -> object:
    try:
        import torch
    except ImportError as error:
        raise UnsupportedError("a checkpoint needs torch, which is missing: pip install 'kissgs[train]'") from error
    from pickle import UnpicklingError

    # Learning rates of nerfstudio's optimisers are NumPy's numbers; their pickles have either name of the function.
    scalar: Any = np.float64(0).__reduce__()[0]
    safe: list[Any] = [np.dtype, type(np.dtype(np.float64)), scalar, (scalar, "numpy.core.multiarray.scalar")]
    with open_scene_file(source) as opened:
        try:
            with torch.serialization.safe_globals(safe):
                if isinstance(source, bytes):
                    return torch.load(io.BytesIO(source), map_location="cpu", weights_only=True)
                return torch.load(source, map_location="cpu", weights_only=True, mmap=True)
        except UnpicklingError as error:
            raise InvalidSceneError(
                f"{opened.name} is no checkpoint, or holds more than tensors and numbers; the rest could run code, so "
                "none of it is read: export the scene as .ply"
            ) from error
        except (KissgsError, OSError):
            raise
        except Exception as error:  # of many kinds where a file is damaged
            raise opened.invalid("is no checkpoint that torch can read") from error


FORMAT = Codec(info=_describe, read=read_checkpoint)
