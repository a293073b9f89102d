"""Bytes, times and memory of presets and external codecs over the number of Gaussians of sample scenes.

    python bench/scaling.py 65536 262144 1048576 -p fast balanced --external spz

A scene is on disk only while it is measured, in the system's folder of temporary files or in TMPDIR.
"""

from __future__ import annotations

import shlex
import sys
import tempfile
from functools import partial
from pathlib import Path

from bench.common import head, parser_of, positive, row, run
from bench.external import FORMATS, measure_external
from kissgs import KissgsError, Settings, sample_scene, save
from kissgs.cli.bench import isolated, measured

HEAD = "Gaussians", "codec", "bytes per Gaussian", "CPU s", "decode CPU s", "peak MB", "per Gaussian", "times the scene"


def main() -> None:
    """Print a row for each number of Gaussians and each codec; what fails is said, and the others are measured."""
    parser = parser_of(__doc__)
    parser.add_argument("counts", nargs="+", type=positive, metavar="GAUSSIANS")
    parser.add_argument("--degree", type=int, default=3, choices=range(4))
    parser.add_argument("-p", "--presets", nargs="+", default=["fast", "balanced"])
    parser.add_argument("--external", nargs="+", default=[], choices=FORMATS)
    parser.add_argument("--splat-transform", default="splat-transform", help="command that starts it")
    given = parser.parse_args()
    head(*HEAD)
    for count in given.counts:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "scene.ply")
            size = isolated(partial(write_sample, path, count, given.degree), f"the scene of {count:,} Gaussians")
            for codec in [*given.presets, *given.external]:
                try:
                    packed, cpu, decode, memory = measure(path, codec, shlex.split(given.splat_transform))
                except KissgsError as error:
                    sys.stderr.write(f"{codec}, {count:,} Gaussians: {error}\n")
                    continue
                times = f"{packed / count:.2f}", f"{cpu:.1f}", f"{decode:.2f}"
                row(count, codec, *times, round(memory / 1e6), round(memory / count), f"{memory / size:.1f}")


def write_sample(path: Path, count: int, degree: int) -> int:
    """Write a sample scene; return the bytes of its arrays."""
    scene = sample_scene(count, sh_degree=degree)
    save(scene, path)
    return scene.nbytes


def measure(path: Path, codec: str, command: list[str]) -> tuple[int, float, float, int]:
    """Return bytes, CPU seconds of encoding and of decoding, and peak memory of a preset or an external codec."""
    if codec in FORMATS:
        other = measure_external(path, codec, command)
        return other.bytes, other.encode_cpu_seconds, other.decode_cpu_seconds, other.peak_memory
    found = measured(path, Settings.from_preset(codec))
    return found.report.container_bytes, found.report.cpu_seconds, found.decode_cpu_seconds, found.peak_memory


if __name__ == "__main__":
    run(main)
