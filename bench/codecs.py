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
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pydantic import ValidationError

from bench.common import head, parser_with_views, row, run, signed, write
from bench.curves import bytes_at
from bench.external import FORMATS, Measured, measure_external
from kissgs import KissgsError, Preset, Settings, Views, sample_scene, save
from kissgs.cli.bench import measured
from kissgs.cli.options import chosen
from kissgs.settings import GOALS, EncodeSettings

HEAD = "codec", "bytes", "per Gaussian", "wall s", "CPU s", "decode CPU s", "peak MB"
IMAGES = "PSNR to photographs", "change, dB", "SSIM", "PSNR to the original", "SSIM", "worst view"


def main() -> None:
    """Print a table for each scene, and the bytes at equal PSNR; samples are on disk only while they are measured."""
    parser = parser_with_views(__doc__)
    parser.add_argument("scenes", nargs="+", metavar="SCENE", help="file, or number of Gaussians of a sample scene")
    parser.add_argument("--degree", type=int, default=3, choices=range(4), help="of sample scenes")
    parser.add_argument("-p", "--presets", nargs="+", default=list(Preset))
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="change a setting of all presets"
    )
    parser.add_argument("--each", nargs="+", default=[], metavar="NAME=VALUE", help="also make each of these changes")
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
            failed |= measure(path, codecs)
    if failed:
        raise SystemExit(2)


class Codec(NamedTuple):
    """A codec, and the name of the curve that it is a point of; empty for one that is compared with all curves."""

    name: str
    curve: str
    measure: Callable[[Path], Measured]


def codecs_of(given: argparse.Namespace) -> list[Codec]:
    """Return all codecs that are wanted."""
    found = list[Codec]()
    with_settings = partial(measure_preset, views=given.views)
    for preset in dict.fromkeys(given.presets):
        settings = chosen(preset, given.set)
        found.append(Codec(preset, preset, partial(with_settings, settings=settings)))
        for offset in given.offsets if settings.encode.rate_distortion else ():
            tuned = at_quality_offset(settings, offset)
            found.append(Codec(f"{preset} at {offset:g}", preset, partial(with_settings, settings=tuned)))
        for change in dict.fromkeys(given.each):
            changed = chosen(preset, [*given.set, change])
            found.append(Codec(f"{preset} {change}", "", partial(with_settings, settings=changed)))
    by_tool = partial(measure_external, command=shlex.split(given.splat_transform), views=given.views)
    for ending in given.external:
        found.append(Codec(f".{ending}", "", partial(by_tool, ending=ending, sh_iterations=given.sog_iterations)))
    return found


def at_quality_offset(settings: Settings, decibels: float) -> Settings:
    """Return settings with rate-distortion planning at another quality offset, without a lambda or a goal."""
    changes = {"quality_offset_db": decibels, "rd_lambda": None, **dict.fromkeys(GOALS)}
    try:
        encode = EncodeSettings(**{**settings.encode.model_dump(), **changes})
    except ValidationError as error:
        raise KissgsError(f"a quality offset of {decibels:g}: {error.errors()[0]['msg'].lower()}") from error
    return settings.model_copy(update={"encode": encode})


def measure_preset(scene: Path, *, settings: Settings, views: Views | None) -> Measured:
    """Compress, decompress and evaluate a scene."""
    found = measured(scene, settings, views=views)
    return Measured(
        bytes=found.report.container_bytes,
        encode_seconds=sum(found.report.seconds.values()),
        encode_cpu_seconds=found.report.cpu_seconds,
        decode_cpu_seconds=found.decode_cpu_seconds,
        peak_memory=found.peak_memory,
        evaluation=found.evaluation,
    )


def measure(scene: Path, codecs: Sequence[Codec]) -> bool:
    """Print the table of a scene; what fails is said, and the others are measured. Returns whether something failed."""
    curves = defaultdict[str, dict[str, tuple[float, float]]](dict)
    failed = False
    head(*HEAD, *IMAGES)
    for codec in codecs:
        try:
            found = codec.measure(scene)
        except KissgsError as error:
            sys.stderr.write(f"{codec.name}: {error}\n")
            failed = True
            continue
        row(codec.name, *cells(found))
        psnr = found.evaluation.mean.candidate_vs_reference.psnr
        curves[codec.curve][codec.name] = psnr, float(found.bytes)
    write("")
    for name, (psnr, size) in curves.pop("", {}).items():
        for curve, points in curves.items():
            equal = bytes_at(list(points.values()), psnr)
            if equal is not None:
                at = f"at the PSNR of {name} to the original, {psnr:.2f} dB"
                write(f"{at}: {curve} {equal:,.0f} bytes, {equal / size:.3f} of its")
    return failed


def cells(found: Measured) -> list[object]:
    """Return the cells of a row; those of photographs are empty without any."""
    mean, count = found.evaluation.mean, max(found.evaluation.reference_count, 1)
    other, photos = mean.candidate_vs_reference, ["", "", ""]
    if mean.reference is not None:
        photos = [f"{mean.candidate.psnr:.2f}", signed(mean.change), f"{mean.candidate.ssim:.4f}"]
    worst = found.evaluation.worst.comparison.candidate_vs_reference.psnr
    seconds = f"{found.encode_seconds:.1f}", f"{found.encode_cpu_seconds:.1f}", f"{found.decode_cpu_seconds:.2f}"
    costs = found.bytes, f"{found.bytes / count:.2f}", *seconds, f"{found.peak_memory / 1e6:.0f}"
    return [*costs, *photos, f"{other.psnr:.2f}", f"{other.ssim:.4f}", f"{worst:.2f}"]


if __name__ == "__main__":
    run(main)
