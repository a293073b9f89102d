"""Costs of a Gaussian in a streamed scene, measured: CPU seconds by stage, and bytes that are read and written."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from kissgs.benchmark.isolation import isolated
from kissgs.core.errors import UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.io.container_names import LOD_NAME
from kissgs.io.ply import read_ply_info
from kissgs.pipeline.pipeline import compress
from kissgs.pipeline.scene_files import save
from kissgs.pipeline.scene_formats import recognise
from kissgs.settings import Settings
from kissgs.streaming.compress import compress_streamed
from kissgs.synthetic.scene import sample_scene

STAGES = ("partition", "merge", "cameras", "images")
"""Stages of a streamed scene, in order; only planning by sensitivity has cameras."""

CPU_SECONDS = {False: 62e-6, True: 240e-6}
"""CPU seconds of the measurement for each Gaussian of degree 3, without and with rate-distortion planning."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamingCosts:
    """Costs of a streamed scene.

    Attributes:
        gaussians: number of Gaussians of the scene that was measured.
        partition_seconds: CPU seconds of a Gaussian in the partition, which one process does.
        merge_seconds: CPU seconds of a Gaussian of the finest level in the merging of its chunk.
        camera_seconds: CPU seconds for the choice of cameras, which one process does, whatever the scene's size; 0
            without sensitivity.
        file_seconds: CPU seconds of a Gaussian of any level in its file.
        container_seconds: CPU seconds of a Gaussian in one container, without levels.
        source_bytes: size of a Gaussian in the ``.ply``, and about that in the work folder.
        file_bytes: size of a Gaussian of any level in its file.
    """

    gaussians: int
    partition_seconds: float
    merge_seconds: float
    camera_seconds: float
    file_seconds: float
    container_seconds: float
    source_bytes: float
    file_bytes: float

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def measure_costs(
    source: Path | int,
    settings: Settings,
    gaussians: int,
    threads: int = 0,
    *,
    announce: Callable[[str], None] = lambda text: None,
    progress: Progress = silent,
) -> StreamingCosts:
    """Compress a scene to streamed SOG and to one ``.sog`` in a process of its own, and return the costs.

    Args:
        source: an uncompressed ``.ply``, or an SH degree, 0 to 3, for a sample scene.
        settings: settings of the encoder.
        gaussians: number of Gaussians of the sample scene.
        threads: number of threads; 0 means one per processor.
        announce: receives what is measured, and about how long that takes, before it begins.
        progress: receives the stage "measure", with what is being done as a note.

    Raises:
        KissgsError: the scene cannot be compressed.
    """
    with tempfile.TemporaryDirectory(prefix="kissgs-bench-") as folder:
        path = Path(folder, "scene.ply")
        if isinstance(source, Path):
            path = source
            if recognise(path) != "ply" or read_ply_info(path).compressed:
                raise UnsupportedError(f"{path} is no uncompressed .ply, whose size costs depend on; convert it first")
            gaussians = read_ply_info(path).count
        minutes = gaussians * CPU_SECONDS[settings.encode.rate_distortion] / 60
        announce(
            f"measuring {gaussians:,} Gaussians with levels of detail and without: about {math.ceil(minutes)} min of "
            f"processor time{_faster(isinstance(source, int), settings)}"
        )
        if not isinstance(source, Path):
            progress("measure", 0.0, "sample scene")
            isolated(partial(_write_sample, path, gaussians, source), f"the scene of {gaussians:,} Gaussians")
        progress("measure", 0.1, f"{gaussians:,} Gaussians")
        return isolated(partial(_measure, path, Path(folder), settings, threads), str(path))


def _faster(sample: bool, settings: Settings) -> str:
    """Return the end of a sentence: what takes less time, if anything does."""
    ways = ["fewer Gaussians"] * sample + ["the preset fast"] * settings.encode.rate_distortion
    return f"; {' and '.join(ways)} {'takes' if ways == ['the preset fast'] else 'take'} less" if ways else ""


def _write_sample(path: Path, gaussians: int, sh_degree: int) -> None:
    save(sample_scene(gaussians, sh_degree=sh_degree), path)


def _measure(path: Path, folder: Path, settings: Settings, threads: int) -> StreamingCosts:
    seconds, last, begun = dict.fromkeys(STAGES, 0.0), "", 0.0

    def progress(stage: str, fraction: float, note: str = "") -> None:
        nonlocal last, begun
        now = time.process_time()
        of = "partition" if last == "scratch" else last  # until the first block is read
        if of in seconds:
            seconds[of] += now - begun
        last, begun = stage, now

    report = compress_streamed(path, folder / "scene" / LOD_NAME, settings=settings, threads=threads, progress=progress)
    begun = time.process_time()
    compress(path, settings=settings, container="sog", threads=threads)
    container = time.process_time() - begun
    stored, finest = sum(report.counts) + report.environment_count, max(report.counts[0], 1)
    return StreamingCosts(
        gaussians=report.source_count,
        partition_seconds=seconds["partition"] / report.source_count,
        merge_seconds=seconds["merge"] / finest,
        camera_seconds=seconds["cameras"],
        file_seconds=seconds["images"] / stored,
        container_seconds=container / report.source_count,
        source_bytes=path.stat().st_size / report.source_count,
        file_bytes=(sum(report.level_bytes) + report.environment_bytes) / stored,
    )
