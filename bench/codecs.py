"""Presets, points of their quality curves, and external codecs on scenes, each in a process of its own.

    python bench/codecs.py fox.ply --views fox --offsets -7 -3 4 --external sog spz --sog-iterations 1
    python bench/codecs.py 65536 262144 -p fast balanced    # sample scenes of so many Gaussians

External codecs need splat-transform (npm install -g @playcanvas/splat-transform). An offset is a value of
quality_offset_db of the presets that plan by rate and distortion; bytes are compared at equal PSNR along that curve.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.common import at_quality_offset, capture, head, parser_of, row, run, signed, write
from bench.curves import bytes_at
from bench.external import FORMATS, External, measure_external
from kissgs import Evaluation, KissgsError, Preset, Settings, sample_scene, save
from kissgs.cli.bench import Measurement, measured
from kissgs.cli.options import chosen
from kissgs.formats import ContainerName

HEAD = "codec", "bytes", "per Gaussian", "wall s", "CPU s", "decode CPU s", "peak MB"
IMAGES = "PSNR to photographs", "change, dB", "SSIM", "PSNR to the original", "SSIM", "worst view"


def main() -> None:
    """Print a table for each scene, and the bytes at equal PSNR; samples are on disk only while they are measured."""
    parser = parser_of(__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="file, or number of Gaussians of a sample scene")
    parser.add_argument("--degree", type=int, default=3, choices=range(4), help="of sample scenes")
    parser.add_argument("--views", type=capture, metavar="DATA", help="capture with cameras and photographs")
    parser.add_argument("-p", "--presets", nargs="+", default=list(Preset))
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="change a setting of all presets"
    )
    parser.add_argument("--each", nargs="+", default=[], metavar="NAME=VALUE", help="also make each of these changes")
    parser.add_argument("--containers", nargs="+", default=["sogxt"], choices=["sogxt", "sog"])
    parser.add_argument("--offsets", nargs="+", type=float, default=[], metavar="DB")
    parser.add_argument("--external", nargs="+", default=[], choices=FORMATS)
    parser.add_argument("--splat-transform", default="splat-transform", help="command that starts it")
    parser.add_argument("--sog-iterations", type=int, help="k-means iterations over the SH of .sog")
    given = parser.parse_args()
    codecs = codecs_of(given)  # settings are checked before the first measurement
    failed = False
    for scene in given.scenes:
        write(f"{scene}:", "")
        with tempfile.TemporaryDirectory() as folder:
            path = Path(scene)
            if scene.isdecimal():
                path = Path(folder, "scene.ply")
                save(sample_scene(int(scene), sh_degree=given.degree), path)
            failed |= measure(path, codecs, given)
    if failed:
        raise SystemExit(2)


class Codec(NamedTuple):
    """A preset with a container and perhaps another quality, whose points are on one curve; or with a change."""

    curve: str
    name: str
    container: ContainerName
    settings: Settings
    changed: bool


def codecs_of(given: argparse.Namespace) -> list[Codec]:
    """Return all codecs that are wanted."""
    found = list[Codec]()
    for preset in dict.fromkeys(given.presets):
        for change in dict.fromkeys([None, *given.each]):
            settings = chosen(preset, [*given.set, *filter(None, [change])])
            offsets = given.offsets if settings.encode.rate_distortion and not change else []
            for container in given.containers:
                curve = " ".join([preset, *([] if container == "sogxt" else [".sog"]), *filter(None, [change])])
                found.append(Codec(curve, curve, container, settings, bool(change)))
                for offset in offsets:
                    tuned = at_quality_offset(settings, offset)
                    found.append(Codec(curve, f"{curve} at {offset:g}", container, tuned, False))
    return found


def measure(scene: Path, codecs: Sequence[Codec], given: argparse.Namespace) -> bool:
    """Print the table of a scene; what fails is said, and the others are measured. Returns whether something failed."""
    points: dict[str, list[tuple[float, float]]] = {}
    others: dict[str, tuple[float, float]] = {}
    failed = False
    head(*HEAD, *IMAGES)
    for codec in codecs:
        try:
            found = measured(scene, codec.settings, container=codec.container, views=given.views)
        except KissgsError as error:
            sys.stderr.write(f"{codec.name}: {error}\n")
            failed = True
            continue
        point = print_measurement(codec.name, found), float(found.report.container_bytes)
        if codec.changed:
            others[codec.name] = point
        else:
            points.setdefault(codec.curve, []).append(point)
    for ending in given.external:
        command, iterations = shlex.split(given.splat_transform), given.sog_iterations
        try:
            external = measure_external(scene, ending, command, sh_iterations=iterations, views=given.views)
        except KissgsError as error:
            sys.stderr.write(f"{error}\n")
            failed = True
            continue
        others[f".{ending}"] = print_external(f".{ending}", external), float(external.bytes)
    write("")
    for name, (psnr, size) in others.items():
        for curve, curve_points in points.items():
            equal = bytes_at(curve_points, psnr)
            if equal is not None:
                at = f"at the PSNR of {name} to the original, {psnr:.2f} dB"
                write(f"{at}: {curve} {equal:,.0f} bytes, {equal / size:.3f} of its")
    return failed


def print_measurement(name: str, found: Measurement) -> float:
    """Print a row; return the PSNR to renderings of the original."""
    report = found.report
    wall, memory = f"{sum(report.seconds.values()):.1f}", f"{found.peak_memory / 1e6:.0f}"
    times = wall, f"{report.cpu_seconds:.1f}", f"{found.decode_cpu_seconds:.2f}", memory
    row(name, report.container_bytes, f"{report.bytes_per_gaussian:.2f}", *times, *images(found.evaluation))
    return found.evaluation.mean.candidate_vs_reference.psnr


def print_external(name: str, found: External) -> float:
    """Print a row; return the PSNR to renderings of the original."""
    times = f"{found.encode_seconds:.1f}", f"{found.encode_cpu_seconds:.1f}", f"{found.decode_cpu_seconds:.2f}"
    per_gaussian = f"{found.bytes / max(found.evaluation.reference_count, 1):.2f}"
    row(name, found.bytes, per_gaussian, *times, f"{found.peak_memory / 1e6:.0f}", *images(found.evaluation))
    return found.evaluation.mean.candidate_vs_reference.psnr


def images(evaluation: Evaluation) -> list[Any]:
    """Return the cells of :data:`IMAGES`; those of photographs are empty without any."""
    mean = evaluation.mean
    other = mean.candidate_vs_reference
    photos = ["", "", ""]
    if mean.reference is not None:
        photos = [f"{mean.candidate.psnr:.2f}", signed(mean.change), f"{mean.candidate.ssim:.4f}"]
    worst = evaluation.worst.comparison.candidate_vs_reference.psnr
    return [*photos, f"{other.psnr:.2f}", f"{other.ssim:.4f}", f"{worst:.2f}"]


if __name__ == "__main__":
    run(main)
