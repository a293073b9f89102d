"""The experiments of the KISS-GS paper on the scenes of a manifest: points, tables and plots.

    python bench/paper.py scenes.yaml -o results --published rd.csv
    python bench/paper.py --published rd.csv    # the factors of published points alone

The manifest names scenes by data set; its paths are relative to it:

    datasets:
      MipNeRF360:
        bicycle:
          capture: 360_v2/bicycle                # held-out photographs evaluate, at most 1600 pixels long
          training: 360_v2/bicycle/images_4      # default: the capture
          reference: inria/bicycle.ply           # has the quality at which bytes are compared
          checkpoints:
            L: {scene: mcmc/bicycle.ply, count: 256000}    # compacted to a count or a ratio
            XL: {scene: popspa/bicycle.ply}                # as it is
    preset: paper                                # the default
    settings: {finetune: {steps: 2000}}          # values of the preset to change

Files and points.csv are in the output folder; a later run makes what is missing or has other inputs or settings.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import shlex
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, ValidationInfo

import kissgs
from bench.common import markdown, parser_of, percent, run, signed, write
from bench.curves import MEAN, METRICS, Point, append_point, means, ranks, read_points, reduction
from bench.external import convert
from bench.paper_parts import PARTS, PUBLISHED_BYTES, LeaveOut, encode_parts
from kissgs import KissgsError, Preset, Settings, Splats, UnsupportedError, Views
from kissgs.compaction.merging import merge_gaussians
from kissgs.compaction.popspa import Popspa
from kissgs.core.context import Context
from kissgs.evaluation.evaluate import compare_images, in_scene_frame
from kissgs.io.files import atomic_file
from kissgs.training.supervision import SCORING_STRIDE, supervision_views, training_targets

REFERENCE, BASE = "reference", "inria-ply"
"""Tier and series of the scene that has the quality at which bytes are compared."""

# The manifest.


def _in_folder(path: Path, info: ValidationInfo) -> Path:
    return Path(info.context or "", path)


ManifestPath = Annotated[Path, AfterValidator(_in_folder)]


class Checkpoint(BaseModel):
    """A scene that is encoded, and to how many Gaussians it is compacted before."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    scene: ManifestPath
    count: int | None = None
    ratio: float | None = None

    @property
    def budget(self) -> dict[str, object]:
        """Setting of compaction; empty if the scene is encoded as it is."""
        return self.model_dump(exclude={"scene"}, exclude_none=True)


class Scene(BaseModel):
    """A scene of a data set."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: ManifestPath
    training: ManifestPath | None = None
    reference: ManifestPath | None = None
    checkpoints: dict[str, Checkpoint] = {}


class Manifest(BaseModel):
    """Scenes by data set, and how they are compressed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    datasets: dict[str, dict[str, Scene]]
    preset: Preset = Preset.PAPER
    settings: dict[Literal["compact", "encode", "finetune"], dict[str, Any]] = {}


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        KissgsError: the file is no YAML, or something in it is missing, unknown or wrong.
    """
    try:
        return Manifest.model_validate(yaml.safe_load(path.read_text(encoding="utf-8")), context=path.parent)
    except ValidationError as error:
        problem = error.errors()[0]
        place = ".".join(str(each) for each in problem["loc"]) or "the file"
        raise KissgsError(f"{path}: {place}: {problem['msg'].lower()}; --help shows a manifest") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise KissgsError(f"{path} is no YAML: {' '.join(str(error).split())}; --help shows a manifest") from error


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

    @cached_property
    def original(self) -> Splats:
        """The scene before compaction."""
        return kissgs.load(self.checkpoint.scene)

    def views(self, capture: Path | None) -> Views:
        """Return the views of a capture, by default of that to evaluate from, in the coordinates of the scene."""
        return in_scene_frame(self.original, views_of(capture or self.scene.capture))

    def settings(self, **changes: Mapping[str, object]) -> Settings:
        """Return the settings of the manifest with changes by group."""
        given = self.manifest.settings
        compact = {**given.get("compact", {}), **changes.get("compact", {})}
        finetune = {**given.get("finetune", {}), **changes.get("finetune", {})}
        encode = {**given.get("encode", {}), **changes.get("encode", {})}
        return Settings.research(self.manifest.preset, compact=compact, finetune=finetune, **encode)

    def key(self, *parts: BaseModel | str) -> str:
        """Return what stands for the scene, its views, and settings or texts."""
        captures = self.scene.capture, self.scene.training or self.scene.capture
        texts = [part.model_dump_json() if isinstance(part, BaseModel) else part for part in parts]
        inputs = [kissgs.__version__, digest_of(self.checkpoint.scene), *map(digest_of, captures), *texts]
        return hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:16]

    def path(self, key: str, ending: str) -> Path:
        """Return the file of a job: files of equal keys are equal, whatever their series."""
        return Path(self.given.output, self.dataset, self.name, self.tier, f"{key}{ending}")

    def file(self, series: str, ending: str, make: Make, *parts: BaseModel | str, small: bool = True) -> Job:
        """Return a job for a file that depends on the parts, made of the compacted scene or of the one before."""
        key = self.key(*([compaction(self).key] if small else []), *parts)
        source = self.compacted if small else lambda: self.checkpoint.scene
        return Job(series, key, lambda: stored(self.path(key, ending), make, source))

    def compacted(self) -> Path:
        """Return the compacted scene, which is made now unless it exists."""
        job = compaction(self)
        job.make()
        return self.path(job.key, ".ply") if self.checkpoint.budget else self.checkpoint.scene


def stored(path: Path, make: Make, source: Callable[[], Path]) -> Made:
    """Return what is in a file; ``make`` writes it unless an earlier run has. Its times are in a file beside it."""
    times = path.with_name(f"{path.name}.json")
    if not times.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        scene = source()
        wall, cpu = time.perf_counter(), sum(os.times()[:4])
        stages = make(scene, path) or {}
        text = " ".join(f"{name}={seconds:.2f}" for name, seconds in stages.items())
        found = time.perf_counter() - wall, sum(os.times()[:4]) - cpu, text
        with atomic_file(times) as file:
            file.write(json.dumps(found).encode())
    return Made(kissgs.load(path, raw_axes=True), path.stat().st_size, *json.loads(times.read_bytes()))


views_of = cache(kissgs.load_views)


@cache
def digest_of(path: Path) -> str:
    """Return the hash of a scene, or of a capture: of all its cameras, and of the sizes of its photographs."""
    digest = hashlib.sha256()
    if path.is_file():
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256")
    else:
        for view in views_of(path).all:
            size = 0 if view.photo is None else view.photo.stat().st_size
            digest.update(f"{view.name} {size} {view.camera.viewmat.tolist()} {view.camera.K.tolist()}".encode())
    return digest.hexdigest()


def works(manifest: Manifest, given: argparse.Namespace) -> Iterator[Work]:
    """Return the works of a manifest that are wanted; those whose files are missing are named."""
    for dataset, scenes in manifest.datasets.items():
        for name, scene in scenes.items():
            checkpoints = {} if scene.reference is None else {REFERENCE: Checkpoint(scene=scene.reference)}
            for tier, checkpoint in (checkpoints | scene.checkpoints).items():
                work = Work(dataset, name, tier, scene, checkpoint, manifest, given)
                needed = checkpoint.scene, scene.capture, scene.training or scene.capture
                missing = [path for path in needed if not path.exists()]
                wanted = name in (given.scenes or [name]) and tier in (REFERENCE, *(given.tiers or [tier]))
                if wanted and missing:
                    sys.stderr.write(f"{work} is skipped: there is no {missing[0]}\n")
                elif wanted:
                    yield work


# Rate and distortion: the checkpoint compacted, encoded, fine-tuned, and in other formats.


def rate_distortion(work: Work) -> Iterator[Job]:
    """Return the points of one tier; of the reference as it is and encoded."""
    yield compaction(work)
    if work.tier == REFERENCE:
        yield encoding(work, "inria-sogxt")
        return
    yield encoding(work, "popspa-sogxt")
    yield encoding(work, "popspa-sogxt-ft", finetune={"enabled": True})
    if work.given.splat_transform:
        yield converted(work, "sog")
    else:
        yield encoding(work, "popspa-sog", ".sog")
    yield converted(work, "spz")


def compaction(work: Work) -> Job:
    """Return the job of the ``.ply`` that is encoded."""
    source = work.checkpoint.scene
    if not work.checkpoint.budget:
        series = BASE if work.tier == REFERENCE else "popspa-ply"
        return Job(series, work.key(), lambda: Made(work.original, source.stat().st_size))
    settings = work.settings(compact=work.checkpoint.budget)

    def make(source: Path, path: Path) -> Mapping[str, float]:
        report = kissgs.compact(
            source,
            path,
            settings=settings,
            views=work.views(work.scene.training),
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
    settings = work.settings(**changes)
    used = [settings.encode, *([settings.finetune] if settings.finetune.enabled else [])]

    def make(source: Path, path: Path) -> Mapping[str, float]:
        return kissgs.compress(
            source,
            path,
            settings=settings,
            views=work.views(work.scene.training),
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

    return work.file(f"popspa-{ending}", f".{ending}", make, ending, tool)


# The other studies.


def ablation(work: Work) -> Iterator[Job]:
    """Return the containers of preset ``paper`` with one part left out, which no decoder reads."""
    settings, before = work.settings().encode, compaction(work).key
    if settings.rate_distortion:
        raise UnsupportedError(f"the ablation leaves out parts of preset paper, not of {work.manifest.preset}")
    whole = cache(lambda: encode_parts(kissgs.load(work.compacted()), settings, 0))

    def make(leave_out: LeaveOut | None) -> Made:
        parts = whole() if leave_out is None else leave_out(whole(), settings, 0)
        return Made(parts.decoded, parts.size(settings, 0))

    for name, (leave_out, _, _) in PARTS.items():
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
    settings = work.settings(compact=work.checkpoint.budget).compact

    def make(name: str, _: Path, path: Path) -> None:
        (when, changes), scene, context = STRATEGIES[name], work.original, Context(device=work.given.device)
        count = min(settings.count or max(1, round(len(scene) * (settings.ratio or 1))), len(scene))
        steps = {"sparsify_steps": 0, "refine_steps": settings.steps if when == "refined" else 0}
        own = settings.model_copy(update={**({} if when == "trained" else steps), **changes})
        stride = SCORING_STRIDE if settings.trains else 1
        supervised = supervision_views(scene, work.views(work.scene.training), settings, context, scoring_stride=stride)
        targets = training_targets(scene, supervised, context) if own.trains else None
        reduced = merge_gaussians(scene, count, context)[0] if name.startswith("merge") else scene
        kissgs.save(Popspa(reduced, own, supervised, context, targets)(count).splats, path, overwrite=True)

    for name in work.given.strategies if work.checkpoint.budget else ():
        yield work.file(f"compaction: {name}", ".ply", partial(make, name), settings, name, small=False)


def sensitivity(work: Work) -> Iterator[Job]:
    """Return fine-tuned containers with other settings of fine-tuning and of what it trains."""
    usual = work.settings()
    entries, steps = usual.encode.gaussians_per_codebook_entry, usual.finetune.steps
    variants: dict[str, dict[str, dict[str, object]]] = {
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
    for name, changes in variants.items():
        finetune = {"enabled": True, **changes.get("finetune", {})}
        yield encoding(work, f"fine-tuning: {name}", finetune=finetune, encode=changes.get("encode", {}))


STUDIES = {"rd": rate_distortion, "ablation": ablation, "compaction": strategies, "sensitivity": sensitivity}


def points_of(manifest: Manifest, given: argparse.Namespace) -> list[Point]:
    """Return all wanted points, those that are missing made now; what fails is said, and the others are made."""
    table, found = given.output / "points.csv", list[Point]()
    known = {point.place: point for point in read_points(table)} if table.exists() else {}
    for work in works(manifest, given):
        for study in given.studies if work.tier != REFERENCE else ("rd",):
            jobs = list[Job]()
            with said(f"{work}, {study}"):
                jobs.extend(STUDIES[study](work))
            for job in jobs:
                with said(f"{work}, {job.series}"):
                    point = known.get((job.series, work.dataset, work.name, work.tier))
                    if point is None or point.key != job.key or (given.lpips and point.lpips is None):
                        point = measured(work, job)
                        append_point(table, point)
                        sys.stderr.write(f"{work}, {job.series}: {point.bytes:,.0f} bytes, {point.psnr:.2f} dB\n")
                    found.append(point)
    return found


@contextlib.contextmanager
def said(what: str) -> Iterator[None]:
    """Say an error of the library or the system, and go on."""
    try:
        yield
    except (KissgsError, OSError) as error:
        sys.stderr.write(f"{what}: {error}\n")


def measured(work: Work, job: Job) -> Point:
    """Make a file, and compare what it shows with the held-out photographs."""
    made, context = job.make(), Context(device=work.given.device)
    found = compare_images(
        work.original,
        made.splats,
        work.views(None),
        context,
        reference_images=work.images,
        lpips=work.given.lpips,
    ).mean.candidate
    return Point(
        series=job.series,
        dataset=work.dataset,
        scene=work.name,
        tier=work.tier,
        bytes=made.bytes,
        psnr=found.psnr,
        ssim=found.ssim,
        lpips=found.lpips,
        seconds=made.seconds,
        cpu_seconds=made.cpu_seconds,
        stages=made.stages,
        key=job.key,
    )


# Tables and plots.

TITLES = {
    "": "Means over scenes",
    "without": "Parts left out of the codec",
    "compaction": "Strategies of compaction",
    "fine-tuning": "Settings of fine-tuning",
}
"""Titles of tables by the beginning of a series, up to a colon."""


def tables(found: Sequence[Point], published: Sequence[Point]) -> str:
    """Return all tables that these means over scenes fill, in Markdown."""
    sections = {title: study_table(found, study) for study, title in TITLES.items()}
    sections["Times smaller than the reference at its quality"] = reductions(found, published)
    return "\n".join(f"## {title}\n\n{text}" for title, text in sections.items() if text)


def study_table(found: Sequence[Point], study: str) -> str:
    """Return the points of a study, with changes from the first one of their tier, the mean rank of each strategy of
    compaction over data sets and tiers, and what the paper has for the parts of its codec."""
    groups, every = defaultdict[tuple[str, str], dict[str, Point]](dict), defaultdict[str, list[float]](list)
    for point in found:
        prefix, colon, name = point.series.partition(": ")
        if study == (prefix if colon else ""):
            groups[point.dataset, point.tier][name or prefix] = point
    rows = list[list[object]]()
    for place, group in groups.items():
        first, rank = next(iter(group.values())), ranks(group) if study == "compaction" else {}
        for name, point in group.items():
            quality = [_with_change(getattr(point, metric), getattr(first, metric)) for metric in METRICS]
            seconds = ["" if not value else f"{value:.1f}" for value in (point.seconds, point.cpu_seconds)]
            _, more, psnr = PARTS.get(name, (None, None, None))
            paper = [percent(None if more is None else more / PUBLISHED_BYTES), signed(psnr, 4)]
            rows.append([*place, name, round(point.bytes), percent(point.bytes / first.bytes - 1), *quality])
            rows[-1] += [f"{rank[name]:.2f}" if rank else "", *seconds, *paper]
        for name, value in rank.items():
            every[name].append(value)
    rows += [["all", "", name, *[""] * 5, f"{sum(each) / len(each):.2f}", *[""] * 4] for name, each in every.items()]
    head = ["data set", "tier", study or "series", "bytes", "change", *METRICS.values(), "rank", "seconds", "CPU s"]
    return markdown([*head, "published: bytes", "published: PSNR"], rows)


def _with_change(value: float | None, first: float | None) -> str:
    return "" if value is None or first is None else f"{value:.4f} ({value - first:+.4f})"


def reductions(found: Sequence[Point], published: Sequence[Point]) -> str:
    """Return the reduction factors of all series; * is a lower bound, and - a quality that is never reached."""
    both = [points for points in (found, published) if points]

    def factors(points: Sequence[Point], dataset: str, series: str) -> list[str]:
        reference, curve = ([p for p in points if p.place == (name, dataset, MEAN, p.tier)] for name in (BASE, series))
        return [reduction(reference[0], curve, metric) if reference and curve else "" for metric in METRICS]

    curves = [point for points in both for point in points if ": " not in point.series and point.series != BASE]
    names = dict.fromkeys((point.dataset, point.series) for point in curves)
    rows = [[*name, *(cell for points in both for cell in factors(points, *name))] for name in names]
    head = [*METRICS.values(), *(f"published {name}" for name in METRICS.values() if len(both) == 2)]
    return markdown(["data set", "series", *head], [row for row in rows if any(row[2:])])


def plot(path: Path, found: Sequence[Point], published: Sequence[Point]) -> None:
    """Draw the curves of one data set, published ones dashed."""
    from matplotlib.figure import Figure

    drawn = {name: label for name, label in METRICS.items() if any(point.quality(name) is not None for point in found)}
    figure = Figure(figsize=(5 * len(drawn), 5), layout="constrained")
    names = list(dict.fromkeys(point.series for point in (*found, *published)))
    for axes, (metric, label) in zip(figure.subplots(1, len(drawn), squeeze=False)[0], drawn.items(), strict=True):
        for number, series in enumerate(names):
            for points, form in ((found, "o-"), (published, "o--")):
                curve = sorted((p for p in points if p.series == series), key=lambda point: point.bytes)
                x, y = [point.bytes / 1e6 for point in curve], [getattr(point, metric) for point in curve]
                name = series if points is found else f"{series}, published"
                axes.plot(x, y, form, color=f"C{number}", label=name if curve else None)
        axes.set(xscale="log", xlabel="megabytes", ylabel=label)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Make the points of a manifest, and print and draw what they show."""
    parser = parser_of(__doc__)
    parser.add_argument("manifest", nargs="?", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("paper-results"), help="folder for all files")
    parser.add_argument("--published", type=Path, metavar="CSV", help="points to compare with, such as another run's")
    parser.add_argument("--studies", nargs="+", default=["rd"], choices=list(STUDIES), help="default: rd")
    parser.add_argument("--strategies", nargs="+", default=OF_PAPER, choices=list(STRATEGIES), help="of compaction")
    parser.add_argument("--scenes", nargs="+", help="only these")
    parser.add_argument("--tiers", nargs="+", help="only these")
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument("--lpips", action="store_true", help="also measure LPIPS")
    parser.add_argument("--splat-transform", default="", help="command that writes .sog and .spz; default: kissgs does")
    given = parser.parse_args()
    if given.manifest is None and given.published is None:
        parser.error("give a manifest, or published points")
    published = [] if given.published is None else read_points(given.published)
    if given.manifest is None:
        write(reductions([], means(published)))
        return
    given.output.mkdir(parents=True, exist_ok=True)
    points = points_of(read_manifest(given.manifest), given)
    scenes = {(point.dataset, point.scene) for point in points}
    found, theirs = means(points), means([p for p in published if (p.dataset, p.scene) in scenes])
    text = tables(found, theirs)
    write(text)
    (given.output / "tables.md").write_text(text, encoding="utf-8")
    if find_spec("matplotlib") is None:
        sys.stderr.write("no plots without matplotlib, which is missing: pip install 'kissgs[bench]'\n")
        return
    for dataset in dict.fromkeys(point.dataset for point in found):
        ours = [point for point in found if point.dataset == dataset and ": " not in point.series]
        if ours:
            plot(given.output / f"{dataset}.png", ours, [point for point in theirs if point.dataset == dataset])


if __name__ == "__main__":
    run(main)
