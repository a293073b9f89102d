"""Scenes of a manifest, and the points of rate and distortion, and of other studies, that are made of them."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shlex
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo

import kissgs
from bench.common import digest_of, digest_of_capture, views_of
from bench.external import convert, version_of
from bench.paper_parts import OF_CODEBOOK, PARTS, LeaveOut, encode_parts
from kissgs import KissgsError, Preset, Settings, Splats, UnsupportedError, Views
from kissgs.compaction.merging import merge_gaussians
from kissgs.compaction.popspa import Popspa
from kissgs.core.context import Context
from kissgs.core.errors import InvalidViewsError
from kissgs.evaluation.evaluate import in_scene_frame
from kissgs.io.files import atomic_file
from kissgs.settings import BUDGETS
from kissgs.training.supervision import SCORING_STRIDE, supervision_views, training_targets

REFERENCE, BASE = "reference", "inria-ply"
"""Tier and series of the scene that has the quality at which bytes are compared."""

# The manifest. Its names are those of folders.


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    return Path(info.context or "", os.path.expanduser(path))  # noqa: PTH111 (Path.expanduser fails for unknown users)


ManifestPath = Annotated[Path, AfterValidator(_in_folder)]
Name = Annotated[str, Field(pattern=r"^[^\W_][\w .()-]{0,99}$")]


class Part(BaseModel):
    """A part of a manifest."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Checkpoint(Part):
    """A scene that is encoded, and to how many Gaussians it is compacted before."""

    scene: ManifestPath
    count: int | None = None
    ratio: float | None = None

    @property
    def budget(self) -> dict[str, object]:
        """Setting of compaction; empty if the scene is encoded as it is."""
        return self.model_dump(exclude={"scene"}, exclude_none=True)


class Scene(Part):
    """A scene of a data set."""

    capture: ManifestPath
    training: ManifestPath | None = None
    reference: ManifestPath | None = None
    checkpoints: dict[Name, Checkpoint] = {}

    @property
    def tiers(self) -> dict[str, Checkpoint]:
        """The reference, if there is one, and all checkpoints."""
        reference = {} if self.reference is None else {REFERENCE: Checkpoint(scene=self.reference)}
        return reference | self.checkpoints


class Manifest(Part):
    """Scenes by data set, and how they are compressed."""

    datasets: dict[Name, dict[Name, Scene]]
    preset: Preset = Preset.PAPER
    settings: dict[Literal["compact", "encode", "finetune"], dict[str, Any]] = {}

    def with_changes(self, **changes: Mapping[str, object]) -> Settings:
        """Return the settings with changes by group; UnsupportedError says what is wrong with them."""
        compact = {**self.settings.get("compact", {}), **changes.get("compact", {})}
        encode = {**self.settings.get("encode", {}), **changes.get("encode", {})}
        finetune = {**self.settings.get("finetune", {}), **changes.get("finetune", {})}
        return Settings.research(self.preset, compact=compact, finetune=finetune, **encode)

    def checkpoints(self) -> Iterator[tuple[str, str, str, Checkpoint]]:
        """Yield data set, scene, tier and checkpoint of all."""
        for dataset, scenes in self.datasets.items():
            for name, scene in scenes.items():
                for tier, checkpoint in scene.tiers.items():
                    yield dataset, name, tier, checkpoint

    def check(self) -> None:
        """Raise UnsupportedError if settings are wrong, or scenes whose bytes count are no ``.ply``."""
        self.with_changes(finetune={"enabled": True})
        if any(name in self.settings.get("compact", {}) for name in BUDGETS):
            raise UnsupportedError("settings.compact has a budget; give count or ratio to checkpoints instead")
        for dataset, name, tier, checkpoint in self.checkpoints():
            try:
                if REFERENCE in self.datasets[dataset][name].checkpoints:
                    raise UnsupportedError(f"{REFERENCE!r} is the tier of the reference; rename it")
                path = checkpoint.scene
                if not checkpoint.budget and (path.suffix != ".ply" or path.name.endswith(".compressed.ply")):
                    raise UnsupportedError(f"{path} is no plain .ply, whose bytes are to be compared; save it as one")
                self.with_changes(compact=checkpoint.budget)
            except UnsupportedError as error:
                raise UnsupportedError(f"{dataset}/{name} {tier}: {error}") from error


class _UniqueKeys(yaml.SafeLoader):
    """Refuses a mapping that has a key twice; PyYAML would take the later one."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        names = [key.value for key, _ in node.value]
        for number, (key, _) in enumerate(node.value):
            if key.value in names[:number]:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value!r} is there twice", key.start_mark)
        return super().construct_mapping(node, deep)


PROBLEMS = {
    "missing": "is missing",
    "extra_forbidden": "is unknown",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "string_type": "must be text; put quotes around it",
    "string_pattern_mismatch": "is no name: write up to 100 letters, digits, spaces and . _ - ( ), not first",
}
"""Messages by pydantic's type of error; of other types, its own message is plain."""


def read_manifest(path: Path) -> Manifest:
    """Read a manifest; a KissgsError says what in it is missing, unknown or wrong."""
    try:
        document = yaml.load(path.read_text(encoding="utf-8-sig"), _UniqueKeys)
        manifest = Manifest.model_validate(document, context=path.parent)
        manifest.check()
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(each) for each in problem["loc"] if each != "[key]") or "the file"
        reason = PROBLEMS.get(problem["type"], problem["msg"].replace("Input should be", "must be"))
        raise KissgsError(f"{path}: {place}: {reason}; --help shows a manifest") from error
    except UnsupportedError as error:
        raise KissgsError(f"{path}: {error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise KissgsError(f"{path} is no YAML: {' '.join(str(error).split())}; --help shows a manifest") from error
    return manifest


# A scene with the number of Gaussians of one tier, and the files that are made of it.

Make = Callable[[Path, Path], Mapping[str, float] | None]
"""Writes a file, the second, from another; returns the seconds of the stages of that, if it has any."""


class Made(NamedTuple):
    """A scene that a decoder gets, values of its :class:`Point`, the bytes that it needs and the times of making them,
    and its file, if there is one."""

    splats: Splats
    values: Mapping[str, Any]
    path: Path = Path()


class Job(NamedTuple):
    """A point that is to be made, unless there is one with the same key."""

    series: str
    key: str
    make: Callable[[], Made]


@dataclass(frozen=True)
class Work:
    """A checkpoint, or the reference of its scene; ``given`` are the arguments of the command."""

    dataset: str
    name: str
    tier: str
    scene: Scene
    checkpoint: Checkpoint
    manifest: Manifest
    given: argparse.Namespace
    images: dict[int, Any] = field(default_factory=dict)  # renderings of the original that evaluations have made
    failures: list[str] = field(default_factory=list)  # of the compaction, at most one

    def __str__(self) -> str:
        return f"{self.dataset}/{self.name} {self.tier}"

    def check(self) -> None:
        """Check that all files are there, and photographs that held-out views are compared with."""
        for path in (self.checkpoint.scene, self.scene.capture, self.training):
            if not path.exists():
                raise KissgsError(f"there is no {path}")
        held_out = views_of(self.scene.capture).test
        if not held_out or any(view.photo is None for view in held_out):
            raise InvalidViewsError(f"{self.scene.capture} has no held-out photographs to compare with; add them")

    @property
    def training(self) -> Path:
        """The capture whose photographs train."""
        return self.scene.training or self.scene.capture

    @cached_property
    def original(self) -> Splats:
        """The scene before compaction."""
        return kissgs.load(self.checkpoint.scene)

    @cached_property
    def training_views(self) -> Views:
        """Views to train from, in the coordinates of the scene."""
        return in_scene_frame(self.original, views_of(self.training))

    @cached_property
    def evaluation_views(self) -> Views:
        """Views to evaluate from, in the coordinates of the scene."""
        return in_scene_frame(self.original, views_of(self.scene.capture))

    def key(self, *parts: BaseModel | str) -> str:
        """Return what stands for the scene, its views, the device, and settings or texts."""
        texts = [part.model_dump_json() if isinstance(part, BaseModel) else part for part in parts]
        captures = [digest_of_capture(self.scene.capture), digest_of_capture(self.training)]
        inputs = [kissgs.__version__, self.given.device, digest_of(self.checkpoint.scene), *captures, *texts]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:16]

    def file(self, series: str, ending: str, make: Make, *parts: BaseModel | str, small: bool = True) -> Job:
        """Return a job for a file that depends on the parts, made of the compacted scene or of the one before, unless
        it is there with its record of bytes and times, which exclude what is loaded before. Files of equal keys are
        equal, whatever their series."""
        key = self.key(*([self.compaction.key] if small else []), *parts)
        path = Path(self.given.output, self.dataset, self.name, self.tier, f"{key}{ending}")
        record = path.with_name(f"{path.name}.json")

        def made() -> Made:
            found = _record_of(path, record)
            if found is None:
                path.parent.mkdir(parents=True, exist_ok=True)
                source = self.compacted().path if small else self.checkpoint.scene
                _ = self.original, self.training_views
                wall, cpu = time.perf_counter(), sum(os.times()[:4])
                stages = make(source, path) or {}
                wall, cpu = time.perf_counter() - wall, sum(os.times()[:4]) - cpu
                text = " ".join(f"{name}={seconds:.2f}" for name, seconds in stages.items())
                found = {"bytes": path.stat().st_size, "seconds": wall, "cpu_seconds": cpu, "stages": text}
                with atomic_file(record, overwrite=True) as file:
                    file.write(json.dumps(found).encode())
            return Made(kissgs.load(path, raw_axes=True), found, path)

        return Job(series, key, made)

    @cached_property
    def compaction(self) -> Job:
        """The job of the ``.ply`` that is encoded."""
        source = self.checkpoint.scene
        if not self.checkpoint.budget:
            series = BASE if self.tier == REFERENCE else "popspa-ply"
            return Job(series, self.key(), lambda: Made(self.original, {"bytes": source.stat().st_size}, source))
        settings = self.manifest.with_changes(compact=self.checkpoint.budget)

        def make(source: Path, path: Path) -> Mapping[str, float]:
            views, checkpoint, device = self.training_views, path.with_suffix(".checkpoint"), self.given.device
            report = kissgs.compact(
                source, path, settings=settings, views=views, checkpoint=checkpoint, overwrite=True, device=device
            ).report
            stages = defaultdict[str, float](float)
            for step in report.steps:
                stages[step.name] += step.seconds
            return stages

        return self.file("popspa-ply", ".ply", make, settings.compact, small=False)

    def compacted(self) -> Made:
        """Return the scene that is encoded, compacted now unless that is done; what has failed fails again at once."""
        try:
            if not self.failures:
                return self.compaction.make()
        except (KissgsError, OSError) as error:
            self.failures.append(str(error))
        raise KissgsError(self.failures[0])


def _record_of(path: Path, record: Path) -> dict[str, Any] | None:
    """Return the record of a file; None if one of the two is missing, or the file is not the one of the record."""
    try:
        found: dict[str, Any] = json.loads(record.read_bytes())
        return found if path.stat().st_size == found["bytes"] else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


# Rate and distortion: the checkpoint compacted, encoded, fine-tuned, and in other formats.


def rate_distortion(work: Work) -> Iterator[Job]:
    """Return the points of one tier; of the reference as it is and encoded."""
    yield work.compaction._replace(make=work.compacted)
    if work.tier == REFERENCE:
        yield encoding(work, "inria-sogxt")
        return
    yield encoding(work, "popspa-sogxt")
    yield encoding(work, "popspa-sogxt-ft", finetune={"enabled": True})
    yield converted(work, "sog") if work.given.splat_transform else encoding(work, "popspa-sog-kissgs", ".sog")
    yield converted(work, "spz")


def encoding(work: Work, series: str, ending: str = ".zip", **changes: Mapping[str, object]) -> Job:
    """Return the job of a container, with changes of settings by group."""
    settings = work.manifest.with_changes(**changes)
    used = [settings.encode, *([settings.finetune] if settings.finetune.enabled else [])]

    def make(source: Path, path: Path) -> Mapping[str, float]:
        views, checkpoint, device = work.training_views, path.with_suffix(".checkpoint"), work.given.device
        return kissgs.compress(
            source, path, settings=settings, views=views, checkpoint=checkpoint, overwrite=True, device=device
        ).report.seconds

    return work.file(series, ending, make, ending, *used)


def converted(work: Work, ending: str) -> Job:
    """Return the job of a ``.sog`` or ``.spz``, by splat-transform if it is given."""
    tool = work.given.splat_transform

    def make(source: Path, path: Path) -> None:
        if tool:
            convert(shlex.split(tool), source, path, [])
        else:
            kissgs.save(kissgs.load(source), path, raw_axes=True, overwrite=True)

    series = f"popspa-{ending}" if tool else f"popspa-{ending}-kissgs"
    return work.file(series, f".{ending}", make, ending, tool, version_of(tool) if tool else "")


# The other studies.


def ablation(work: Work) -> Iterator[Job]:
    """Return the containers of preset ``paper`` with one part left out, which no decoder reads."""
    settings, before = work.manifest.with_changes().encode, work.compaction.key
    whole = cache(lambda: encode_parts(work.compacted().splats, settings))

    def make(leave_out: LeaveOut) -> Made:
        parts = leave_out(whole())
        return Made(parts.decoded, {"bytes": parts.size()})

    for name, (leave_out, _, _) in PARTS.items():
        if work.original.sh_degree or name not in OF_CODEBOOK:
            yield Job(f"without: {name}", work.key(before, settings, name), partial(make, leave_out))


AT_ONCE, IN_ROUNDS = {"min_keep_per_scoring": 0.0}, {"min_keep_per_scoring": 0.8}
ALONE = {"admm_rho": 0.0, "erank_weight": 0.0, "min_scale_weight": 0.0, "prune_rounds": 1}
ADMM, ERANK = {"admm_rho": 5e-4}, {"erank_weight": 0.01, "min_scale_weight": 1.0}
"""Weights in the published code of GaussianSpa and of the effective-rank loss."""

OF_PAPER = "POP + train + POP + refine", "POP + sparsify + POP + refine", "POPSpa"
STRATEGIES: dict[str, tuple[str, dict[str, Any]]] = {
    "POP": ("untrained", AT_ONCE),
    "POP in rounds": ("untrained", IN_ROUNDS),
    "merge": ("untrained", {}),
    "POP + refine": ("refined", AT_ONCE),
    "POP in rounds + refine": ("refined", IN_ROUNDS),
    "merge + refine": ("refined", {}),
    OF_PAPER[0]: ("trained", {**AT_ONCE, **ALONE}),
    OF_PAPER[1]: ("trained", {**AT_ONCE, **ALONE, **ADMM}),
    OF_PAPER[2]: ("trained", {**AT_ONCE, **ALONE, **ADMM, **ERANK}),
    "prunings along the way": ("trained", {**IN_ROUNDS, **ALONE, "prune_rounds": 5}),
}
"""When the Gaussians that are left are trained, for as many steps in total, and settings of compaction."""


def strategies(work: Work) -> Iterator[Job]:
    """Return the scene with as many Gaussians by strategies of compaction."""
    settings = work.manifest.with_changes(compact=work.checkpoint.budget).compact

    def make(name: str, _: Path, path: Path) -> None:
        (when, changes), scene, context = STRATEGIES[name], work.original, Context(device=work.given.device)
        count = min(settings.count or max(1, round(len(scene) * (settings.ratio or 1))), len(scene))
        reduced = merge_gaussians(scene, count, context)[0] if name.startswith("merge") else scene
        if name == "merge":
            kissgs.save(reduced, path, overwrite=True)
            return
        steps = {"sparsify_steps": 0, "refine_steps": settings.steps if when == "refined" else 0}
        own = settings.model_copy(update={**({} if when == "trained" else steps), **changes})
        stride = SCORING_STRIDE if settings.trains else 1
        supervised = supervision_views(scene, work.training_views, settings, context, scoring_stride=stride)
        targets = training_targets(scene, supervised, context) if own.trains else None
        kissgs.save(Popspa(reduced, own, supervised, context, targets)(count).splats, path, overwrite=True)

    for name in work.given.strategies if work.checkpoint.budget else ():
        yield work.file(f"compaction: {name}", ".ply", partial(make, name), settings, name, small=False)


def variants(manifest: Manifest) -> dict[str, dict[str, dict[str, object]]]:
    """Return other settings of fine-tuning and of what it trains, as changes by group."""
    usual = manifest.with_changes()
    entries, steps = usual.encode.gaussians_per_codebook_entry, usual.finetune.steps
    return {
        "as it is": {},
        "codebook twice as large": {"encode": {"gaussians_per_codebook_entry": max(entries / 2, 1)}},
        "codebook half as large": {"encode": {"gaussians_per_codebook_entry": entries * 2}},
        "256 levels of rotations": {"encode": {"quat_levels": 256}},
        "PRAS before only": {"finetune": {"pras_at": []}},
        "no total variation": {"finetune": {"tv_weight": 0}},
        "total variation x 10": {"finetune": {"tv_weight": 10 * usual.finetune.tv_weight}},
        "half the steps": {"finetune": {"steps": max(steps // 2, 1)}},
        "twice the steps": {"finetune": {"steps": 2 * steps}},
    }


def sensitivity(work: Work) -> Iterator[Job]:
    """Return fine-tuned containers with other settings."""
    for name, changes in variants(work.manifest).items():
        finetune = {"enabled": True, **changes.get("finetune", {})}
        yield encoding(work, f"fine-tuning: {name}", finetune=finetune, encode=changes.get("encode", {}))


STUDIES = {"rd": rate_distortion, "ablation": ablation, "compaction": strategies, "sensitivity": sensitivity}
