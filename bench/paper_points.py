"""Scenes of a manifest, and the points of rate and distortion, and of other studies, that are made of them."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shlex
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator

import kissgs
from bench.curves import MEAN
from bench.external import convert
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

# The manifest. Its names are names of folders.


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    try:
        return Path(info.context or "", path.expanduser())
    except RuntimeError as error:  # ~ of a user that there is not
        raise ValueError(f"{path}: {error}") from error


def _name(name: str) -> str:
    if name == MEAN or not re.fullmatch(r"[\w ()-][\w .()-]{0,99}", name):
        raise ValueError(
            f"{name!r} is no name: use at most 100 letters, digits, spaces and . _ - ( ), not {MEAN}, and no . to begin"
        )
    return name


def _tier(name: str) -> str:
    if name == REFERENCE:
        raise ValueError(f"{name!r} is the tier of the reference; choose another name")
    return _name(name)


def _ply(path: Path) -> Path:
    if path.suffix != ".ply" or path.name.endswith(".compressed.ply"):
        raise ValueError(f"{path} is no plain .ply, whose bytes are those of a series; save it as one")
    return path


ManifestPath = Annotated[Path, AfterValidator(_in_folder)]
Name = Annotated[str, AfterValidator(_name)]
Tier = Annotated[str, AfterValidator(_tier)]


class Checkpoint(BaseModel):
    """A scene that is encoded, and to how many Gaussians it is compacted before."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: ManifestPath
    count: Annotated[int, Field(gt=0)] | None = None
    ratio: Annotated[float, Field(gt=0, le=1)] | None = None

    @model_validator(mode="after")
    def _is_unambiguous(self) -> Self:
        if len(self.budget) > 1:
            raise ValueError("count and ratio cannot both be met; give one")
        if not self.budget:
            _ply(self.scene)
        return self

    @property
    def budget(self) -> dict[str, object]:
        """Setting of compaction; empty if the scene is encoded as it is."""
        return self.model_dump(exclude={"scene"}, exclude_none=True)


class Scene(BaseModel):
    """A scene of a data set."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: ManifestPath
    training: ManifestPath | None = None
    reference: Annotated[ManifestPath, AfterValidator(_ply)] | None = None
    checkpoints: dict[Tier, Checkpoint] = {}


class Manifest(BaseModel):
    """Scenes by data set, and how they are compressed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    datasets: dict[Name, dict[Name, Scene]]
    preset: Preset = Preset.PAPER
    settings: dict[Literal["compact", "encode", "finetune"], dict[str, Any]] = {}

    def with_changes(
        self,
        *,
        compact: Mapping[str, object] = {},
        encode: Mapping[str, object] = {},
        finetune: Mapping[str, object] = {},
    ) -> Settings:
        """Return the settings with changes by group; UnsupportedError says what is wrong with them."""
        given = self.settings
        return Settings.research(
            self.preset,
            compact={**given.get("compact", {}), **compact},
            finetune={**given.get("finetune", {}), **finetune},
            **{**given.get("encode", {}), **encode},
        )

    def check_settings(self) -> None:
        """Check the settings, and those of all checkpoints; raise UnsupportedError if something is wrong."""
        for name in BUDGETS:
            if name in self.settings.get("compact", {}):
                raise UnsupportedError(f"settings.compact: give count or ratio to a checkpoint instead of {name}")
        self.with_changes(finetune={"enabled": True})
        for scenes in self.datasets.values():
            for scene in scenes.values():
                for checkpoint in scene.checkpoints.values():
                    self.with_changes(compact=checkpoint.budget)


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
}
"""What is wrong with a value, by pydantic's type of error; of others, pydantic's message is plain."""


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        KissgsError: the file is no YAML, or something in it is missing, unknown or wrong.
    """
    try:
        document = yaml.load(path.read_text(encoding="utf-8-sig"), _UniqueKeys)
        manifest = Manifest.model_validate(document, context=path.parent)
        manifest.check_settings()
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(each) for each in problem["loc"] if each != "[key]") or "the file"
        message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
        reason = PROBLEMS.get(problem["type"], message)
        raise KissgsError(f"{path}: {place}: {reason}; --help shows a manifest") from error
    except UnsupportedError as error:
        raise KissgsError(f"{path}: {error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise KissgsError(f"{path} is no YAML: {' '.join(str(error).split())}; --help shows a manifest") from error
    return manifest


# A scene with the number of Gaussians of one tier, and the files that are made of it.

Make = Callable[[Path, Path], Mapping[str, float] | None]
"""Writes a file, the second, from another; returns the seconds of the stages of that, if it has any."""


@dataclass(frozen=True, slots=True)
class Made:
    """A scene that a decoder gets, the bytes that it needs, and the times of making them as in a :class:`Point`."""

    splats: Splats
    bytes: int
    seconds: float | None = None
    cpu_seconds: float | None = None
    stages: str = ""


@dataclass(frozen=True, slots=True)
class Job:
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
        files = map(digest_of, (self.checkpoint.scene, self.scene.capture, self.training))
        inputs = [kissgs.__version__, self.given.device, *files, *texts]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:16]

    def path(self, key: str, ending: str) -> Path:
        """Return the file of a job: files of equal keys are equal, whatever their series."""
        return Path(self.given.output, self.dataset, self.name, self.tier, f"{key}{ending}")

    def file(self, series: str, ending: str, make: Make, *parts: BaseModel | str, small: bool = True) -> Job:
        """Return a job for a file that depends on the parts, made of the compacted scene or of the one before. What is
        loaded before is not in its times."""
        key = self.key(*([self.compaction.key] if small else []), *parts)

        def source() -> Path:
            _ = self.original, self.training_views
            return self.compacted() if small else self.checkpoint.scene

        return Job(series, key, lambda: stored(self.path(key, ending), make, source))

    @cached_property
    def compaction(self) -> Job:
        """The job of the ``.ply`` that is encoded; where it has failed, it fails again at once."""
        job = compaction(self)
        return Job(job.series, job.key, failing_once(job.make))

    def compacted(self) -> Path:
        """Return the compacted scene, which is made now unless it exists."""
        self.compaction.make()
        return self.path(self.compaction.key, ".ply") if self.checkpoint.budget else self.checkpoint.scene


def failing_once(make: Callable[[], Made]) -> Callable[[], Made]:
    """Return a function that after its first failure repeats only the message."""
    failures = list[str]()

    def attempt() -> Made:
        if failures:
            raise KissgsError(failures[0])
        try:
            return make()
        except (KissgsError, OSError) as error:
            failures.append(str(error))
            raise

    return attempt


def stored(path: Path, make: Make, source: Callable[[], Path]) -> Made:
    """Return what is in a file; ``make`` writes it unless an earlier run has, whose record, with its times, is beside
    it."""
    record = path.with_name(f"{path.name}.json")
    found = _record_of(path, record)
    if found is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        scene = source()
        wall, cpu = time.perf_counter(), sum(os.times()[:4])
        stages = make(scene, path) or {}
        wall, cpu = time.perf_counter() - wall, sum(os.times()[:4]) - cpu
        text = " ".join(f"{name.replace(' ', '-')}={seconds:.2f}" for name, seconds in stages.items())
        found = {"bytes": path.stat().st_size, "seconds": wall, "cpu_seconds": cpu, "stages": text}
        with atomic_file(record, overwrite=True) as file:
            file.write(json.dumps(found).encode())
    splats = kissgs.load(path, raw_axes=True)
    return Made(splats, found["bytes"], found["seconds"], found["cpu_seconds"], found["stages"])


def _record_of(path: Path, record: Path) -> dict[str, Any] | None:
    """Return the record of a file; None if one of the two is missing, or the file is not the one of the record."""
    try:
        found: dict[str, Any] = json.loads(record.read_bytes())
        return found if path.stat().st_size == found["bytes"] else None
    except (OSError, ValueError, LookupError, TypeError):
        return None


views_of = cache(kissgs.load_views)


@cache
def digest_of(path: Path) -> str:
    """Return the hash of a file, or of a capture: of all its cameras and photographs."""
    if path.is_file() and path.suffix != ".json":
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    views = views_of(path)
    digest = hashlib.sha256(f"{views.background} {[each.matrix.tolist() for each in views.similarities]}".encode())
    for role, each in (("train", views.train), ("test", views.test)):
        for view in each:
            photo = "" if view.photo is None else digest_of(view.photo)
            geometry = view.camera.viewmat.tolist(), view.camera.K.tolist(), view.undistortion, view.background
            digest.update(f"{role} {view.name} {photo} {geometry}".encode())
    return digest.hexdigest()


def works(manifest: Manifest, given: argparse.Namespace) -> Iterator[Work]:
    """Return the works of a manifest that are wanted."""
    for dataset, scenes in manifest.datasets.items():
        for name, scene in scenes.items():
            checkpoints = {} if scene.reference is None else {REFERENCE: Checkpoint(scene=scene.reference)}
            for tier, checkpoint in (checkpoints | scene.checkpoints).items():
                if name in (given.scenes or [name]) and tier in (REFERENCE, *(given.tiers or [tier])):
                    yield Work(dataset, name, tier, scene, checkpoint, manifest, given)


# Rate and distortion: the checkpoint compacted, encoded, fine-tuned, and in other formats.


def rate_distortion(work: Work) -> Iterator[Job]:
    """Return the points of one tier; of the reference as it is and encoded."""
    yield work.compaction
    if work.tier == REFERENCE:
        yield encoding(work, "inria-sogxt")
        return
    yield encoding(work, "popspa-sogxt")
    yield encoding(work, "popspa-sogxt-ft", finetune={"enabled": True})
    if work.given.splat_transform:
        yield converted(work, "sog")
    else:
        yield encoding(work, "popspa-sog-kissgs", ".sog")
    yield converted(work, "spz")


def compaction(work: Work) -> Job:
    """Return the job of the ``.ply`` that is encoded."""
    source = work.checkpoint.scene
    if not work.checkpoint.budget:
        series = BASE if work.tier == REFERENCE else "popspa-ply"
        return Job(series, work.key(), lambda: Made(work.original, source.stat().st_size))
    settings = work.manifest.with_changes(compact=work.checkpoint.budget)

    def make(source: Path, path: Path) -> Mapping[str, float]:
        report = kissgs.compact(
            source,
            path,
            settings=settings,
            views=work.training_views,
            checkpoint=path.with_suffix(".checkpoint"),
            overwrite=True,
            device=work.given.device,
        ).report
        stages = defaultdict[str, float](float)
        for step in report.steps:
            stages[step.name] += step.seconds
        return stages

    return work.file("popspa-ply", ".ply", make, settings.compact, small=False)


def encoding(work: Work, series: str, ending: str = ".zip", **changes: Mapping[str, object]) -> Job:
    """Return the job of a container, with changes of settings by group."""
    settings = work.manifest.with_changes(**changes)
    used = [settings.encode, *([settings.finetune] if settings.finetune.enabled else [])]

    def make(source: Path, path: Path) -> Mapping[str, float]:
        return kissgs.compress(
            source,
            path,
            settings=settings,
            views=work.training_views,
            checkpoint=path.with_suffix(".checkpoint"),
            overwrite=True,
            device=work.given.device,
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


@cache
def version_of(tool: str) -> str:
    """Return what a command says about its version."""
    done = subprocess.run([*shlex.split(tool), "--version"], check=False, capture_output=True, stdin=subprocess.DEVNULL)
    if done.returncode:
        raise KissgsError(f"{tool} --version fails; give a command that starts splat-transform")
    return done.stdout.decode(errors="replace").strip()


# The other studies.


def ablation(work: Work) -> Iterator[Job]:
    """Return the containers of preset ``paper`` with one part left out, which no decoder reads."""
    settings, before = work.manifest.with_changes().encode, work.compaction.key
    whole = cache(lambda: encode_parts(kissgs.load(work.compacted()), settings, 0))

    def make(leave_out: LeaveOut | None) -> Made:
        parts = whole() if leave_out is None else leave_out(whole(), settings, 0)
        return Made(parts.decoded, parts.size(settings, 0))

    for name, (leave_out, _, _) in PARTS.items():
        if name in OF_CODEBOOK and work.original.sh_degree == 0:
            continue
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


def check_request(manifest: Manifest, given: argparse.Namespace) -> None:
    """Check, before any work, that the manifest has the scenes and tiers, and that its settings allow the studies."""
    scenes = {name for each in manifest.datasets.values() for name in each}
    tiers = {REFERENCE, *(tier for each in manifest.datasets.values() for s in each.values() for tier in s.checkpoints)}
    for option, words, known in (("--scenes", given.scenes, scenes), ("--tiers", given.tiers, tiers)):
        for word in words or []:
            if word not in known:
                raise UnsupportedError(f"{option}: the manifest has no {word!r}; it has {', '.join(sorted(known))}")
    usual = manifest.with_changes()
    if "ablation" in given.studies and usual.encode.rate_distortion:
        raise UnsupportedError(f"the ablation leaves out parts of preset paper, not of {manifest.preset}")
    trained = [name for name in given.strategies if STRATEGIES[name][0] != "untrained"]
    if "compaction" in given.studies and trained and not usual.compact.trains:
        raise UnsupportedError(f"{trained[0]!r} needs training steps, which preset {manifest.preset} does not have")
    if "sensitivity" in given.studies:
        for changes in variants(manifest).values():
            manifest.with_changes(encode=changes.get("encode", {}), finetune=changes.get("finetune", {}))
