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

Files and points.csv are in the output folder; a later run makes what is missing or has other inputs or settings. What
fails is said, and the exit status is 1 after all else is made.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from bench.common import markdown, parser_of, percent, run, signed, write
from bench.curves import MEAN, METRICS, Point, append_point, means, ranks, read_points, reduction, resumed_points
from bench.external import version_of
from bench.paper_parts import PARTS, PUBLISHED_BYTES
from bench.paper_points import (
    BASE,
    OF_PAPER,
    REFERENCE,
    STRATEGIES,
    STUDIES,
    Job,
    Manifest,
    Work,
    read_manifest,
    variants,
)
from kissgs import KissgsError, Preset, UnsupportedError
from kissgs.core.context import Context
from kissgs.evaluation.evaluate import compare_images

# The points of a run.


def check_request(manifest: Manifest, given: argparse.Namespace) -> None:
    """Check, before any work, that the manifest has the scenes and tiers, and that its settings allow the studies."""
    scenes = {name for _, name, _, _ in manifest.checkpoints()}
    tiers = {tier for _, _, tier, _ in manifest.checkpoints()}
    for option, words, known in (("--scenes", given.scenes, scenes), ("--tiers", given.tiers, tiers)):
        for word in words or []:
            if word not in known:
                raise UnsupportedError(f"{option}: the manifest has no {word!r}; it has {', '.join(sorted(known))}")
    if given.splat_transform:
        version_of(given.splat_transform)
    usual = manifest.with_changes()
    if "ablation" in given.studies and usual.encode.rate_distortion:
        raise UnsupportedError(f"the ablation leaves out parts of preset paper, not of {manifest.preset}")
    trained = [name for name in given.strategies if STRATEGIES[name][0] != "untrained"]
    if "compaction" in given.studies and trained and not usual.compact.trains:
        raise UnsupportedError(f"{trained[0]!r} needs training steps, which preset {manifest.preset} does not have")
    if "sensitivity" in given.studies:
        for changes in variants(manifest).values():
            manifest.with_changes(encode=changes.get("encode", {}), finetune=changes.get("finetune", {}))


def points_of(manifest: Manifest, given: argparse.Namespace, failed: list[str]) -> list[Point]:
    """Return all wanted points, those that are missing made now. What fails is said and added to ``failed``, and the
    others are made; but where the table of points cannot be written, the run ends."""
    table, found = given.output / "points.csv", list[Point]()
    known = {point.place: point for point in resumed_points(table)}
    for dataset, name, tier, checkpoint in manifest.checkpoints():
        if name not in (given.scenes or [name]) or tier not in (REFERENCE, *(given.tiers or [tier])):
            continue
        work = Work(dataset, name, tier, manifest.datasets[dataset][name], checkpoint, manifest, given)
        jobs = list[Job]()
        with said(str(work), failed):
            work.check()
            for study in given.studies:
                if work.tier != REFERENCE or study == "rd":
                    jobs.extend(STUDIES[study](work))
        for job in jobs:
            point = known.get((job.series, work.dataset, work.name, work.tier))
            if point is None or point.key != job.key or (given.lpips and point.lpips is None):
                point = None
                with said(f"{work}, {job.series}", failed):
                    point = measured(work, job)
                if point is not None:
                    append_point(table, point)
                    sys.stderr.write(f"{work}, {job.series}: {point.bytes:,.0f} bytes, {point.psnr:.2f} dB\n")
            if point is not None:
                found.append(point)
    return found


@contextlib.contextmanager
def said(what: str, failed: list[str]) -> Iterator[None]:
    """Say an error of the library or the system, and go on."""
    try:
        yield
    except (KissgsError, OSError) as error:
        failed.append(what)
        sys.stderr.write(f"{what}: {error}\n")


def measured(work: Work, job: Job) -> Point:
    """Make a file, and compare what it shows with the held-out photographs."""
    made, context, images, lpips = job.make(), Context(device=work.given.device), work.images, work.given.lpips
    found = compare_images(
        work.original, made.splats, work.evaluation_views, context, reference_images=images, lpips=lpips
    ).mean.candidate
    place = {"series": job.series, "dataset": work.dataset, "scene": work.name, "tier": work.tier, "key": job.key}
    quality = {"psnr": found.psnr, "ssim": found.ssim, "lpips": found.lpips}
    return Point.model_validate({**place, **quality, **made.values})


# Tables and plots.

TABLES = {
    "": ("Means over scenes", ("popspa-ply", BASE)),
    "without": ("Parts left out of the codec", ("nothing",)),
    "compaction": ("Strategies of compaction", (OF_PAPER[-1],)),
    "fine-tuning": ("Settings of fine-tuning", ("as it is",)),
}
"""Titles of tables, and what their changes are from, by the beginning of a series, up to a colon."""


def tables(points: Sequence[Point], found: Sequence[Point], published: Sequence[Point]) -> str:
    """Return all tables that these points and means over scenes fill, in Markdown."""
    sections = {title: study_table(found, study, bases) for study, (title, bases) in TABLES.items()}
    sections["Times smaller than the reference at its quality"] = reductions(found, published)
    sections["Seconds of each stage"] = stage_table(points)
    return "\n".join(f"## {title}\n\n{text}" for title, text in sections.items() if text)


def study_table(found: Sequence[Point], study: str, bases: Sequence[str]) -> str:
    """Return the points of a study, with changes from a base if there is one in their tier, the mean rank of each
    strategy of compaction over data sets and tiers with all of them, and what the paper has for the parts of its codec.
    """
    groups, every = defaultdict[tuple[str, str], dict[str, Point]](dict), defaultdict[str, list[float]](list)
    for point in found:
        prefix, colon, name = point.series.partition(": ")
        if study == (prefix if colon else ""):
            groups[point.dataset, point.tier][name or prefix] = point
    count = len({name for group in groups.values() for name in group})
    rows = list[list[object]]()
    for place, group in groups.items():
        base = next((group[name] for name in bases if name in group), None)
        rank = ranks(group) if study == "compaction" and len(group) == count else {}
        for name, point in group.items():
            quality = [
                _with_change(point.value(metric), None if base is None else base.value(metric)) for metric in METRICS
            ]
            seconds = ["" if value is None else f"{value:.1f}" for value in (point.seconds, point.cpu_seconds)]
            _, more, psnr = PARTS.get(name, (None, None, None))
            paper = [percent(None if more is None else more / PUBLISHED_BYTES), signed(psnr, 4)]
            change = percent(None if base is None else point.bytes / base.bytes - 1)
            rank_text = f"{rank[name]:.2f}" if rank else ""
            rows.append([*place, name, round(point.bytes), change, *quality, rank_text, *seconds, *paper])
        for name, value in rank.items():
            every[name].append(value)
    rows += [["all", "", name, *[""] * 5, f"{sum(each) / len(each):.2f}", *[""] * 4] for name, each in every.items()]
    head = ["data set", "tier", study or "series", "bytes", "change", *METRICS.values(), "rank", "seconds", "CPU s"]
    return markdown([*head, "published: bytes", "published: PSNR"], rows)


def _with_change(value: float | None, base: float | None) -> str:
    change = "" if value is None or base is None else f" ({value - base:+.4f})"
    return "" if value is None else f"{value:.4f}{change}"


def stage_table(points: Sequence[Point]) -> str:
    """Return the mean wall times of the stages of each series over the scenes of a data set."""
    groups = defaultdict[tuple[str, str, str], list[dict[str, float]]](list)
    for point in points:
        if point.stages and ": " not in point.series:
            cells = re.findall(r"([^=]+)=(\S+) ?", point.stages)
            groups[point.dataset, point.tier, point.series].append({name: float(each) for name, each in cells})
    names = list(dict.fromkeys(name for group in groups.values() for each in group for name in each))
    rows = list[list[object]]()
    for place, group in groups.items():
        sums = [sum(each.get(name, 0) for each in group) for name in names]
        rows.append([*place, *(f"{each / len(group):.1f}" if each else "" for each in sums)])
    return markdown(["data set", "tier", "series", *names], rows)


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
    """Draw the curves of one data set, published ones dashed with open markers."""
    from matplotlib.figure import Figure

    drawn = {name: label for name, label in METRICS.items() if any(point.quality(name) is not None for point in found)}
    if not drawn:
        return
    figure = Figure(figsize=(5 * len(drawn), 5), layout="constrained")
    names = list(dict.fromkeys(point.series for point in (*found, *published)))
    for axes, (metric, label) in zip(figure.subplots(1, len(drawn), squeeze=False)[0], drawn.items(), strict=True):
        for number, series in enumerate(names):
            for points, form in ((found, "o-"), (published, "o--")):
                curve = sorted((p for p in points if p.series == series), key=lambda point: point.bytes)
                x, y = [point.bytes / 1e6 for point in curve], [point.value(metric) for point in curve]
                name = series if points is found else f"{series}, published"
                fill = f"C{number}" if points is found else "none"
                axes.plot(x, y, form, color=f"C{number}", markerfacecolor=fill, label=name if curve else None)
        axes.set(xscale="log", xlabel="megabytes", ylabel=label)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    figure.savefig(path, dpi=150)


def write_results(points: Sequence[Point], published: Sequence[Point], folder: Path) -> None:
    """Print tables and write them and plots to the folder. They have the points of this run, not all of the folder."""
    scenes, missing = {(point.dataset, point.scene) for point in points}, list[str]()
    found, theirs = means(points, missing), means([p for p in published if (p.dataset, p.scene) in scenes])
    sys.stderr.writelines(f"{each}\n" for each in missing)
    if published and not theirs:
        sys.stderr.write("no published point is of these scenes\n")
    text = tables(points, found, theirs)
    write(text)
    (folder / "tables.md").write_text(text, encoding="utf-8")
    if find_spec("matplotlib") is None:
        sys.stderr.write("no plots without matplotlib, which is missing: pip install matplotlib\n")
        return
    for dataset in dict.fromkeys(point.dataset for point in found):
        ours = [point for point in found if point.dataset == dataset and ": " not in point.series]
        if ours:
            plot(folder / f"{dataset}.png", ours, [point for point in theirs if point.dataset == dataset])


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
    given.studies, given.strategies = list(dict.fromkeys(given.studies)), list(dict.fromkeys(given.strategies))
    manifest, failed = read_manifest(given.manifest), list[str]()
    check_request(manifest, given)
    if published and manifest.preset != Preset.PAPER:
        raise UnsupportedError(f"published points are of preset paper, not of {manifest.preset}; omit --published")
    given.output.mkdir(parents=True, exist_ok=True)
    with (given.output / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise KissgsError(f"another run writes to {given.output}; wait for it, or give another folder") from error
        points = points_of(manifest, given, failed)
        write_results(points, published, given.output)
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    run(main)
