"""Presets and external codecs measured on one scene at several sizes, each in a separate process."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from kissgs.benchmark.comparison import BenchmarkPlan, measurements
from kissgs.benchmark.external_codecs import check_external
from kissgs.benchmark.isolation import isolated
from kissgs.benchmark.render_speed import resampled
from kissgs.benchmark.results import Measurement
from kissgs.core.errors import KissgsError, UnsupportedError
from kissgs.core.progress import Progress, silent
from kissgs.core.splats import Splats, float32_bytes
from kissgs.pipeline.scene_files import load, save
from kissgs.synthetic.scene import sample_scene

NORMALS = 12
"""Bytes per Gaussian that a ``.ply`` has beside the arrays of a scene."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FailedMeasurement:
    """A codec that did not get through a scene.

    Attributes:
        scene: name of the scene.
        codec: name of the codec: a preset or an external format.
        gaussians: number of Gaussians in the scene.
        failure: error message.
    """

    scene: str
    codec: str
    gaussians: int
    failure: str

    def as_dict(self) -> dict[str, Any]:
        """Return all attributes by name, for JSON."""
        return asdict(self)


def measure_scaling(
    source: Path | int,
    counts: Sequence[int],
    plan: BenchmarkPlan,
    *,
    name: str | None = None,
    announce: Callable[[str], None] = lambda text: None,
    progress: Progress = silent,
) -> Generator[Measurement | FailedMeasurement, None, None]:
    """Measure a scene at each count, as planned, and yield each measurement once it is made.

    There is one scene at a time on disk, in a temporary folder, which is removed at the end. Scenes are made in
    processes of their own, so that this one stays small.

    Args:
        source: a scene file, which is resampled (:func:`kissgs.benchmark.render_speed.resampled`); or an SH degree,
            0 to 3, for sample scenes (:func:`kissgs.synthetic.scene.sample_scene`).
        counts: numbers of Gaussians.
        plan: what to measure.
        name: name of the scene; None for its file name, or "sample, degree 3".
        announce: receives the size of the largest scene and its folder, before any is written.
        progress: receives the stage "measure", with the name of the codec and the count as a note.

    Yields:
        A measurement, or the reason why there is none: a process was killed, an external codec failed, the disk is too
        full for the scene, the scene cannot be read.

    Raises:
        UnsupportedError: an external codec is missing; the disk is too full for the largest of the sample scenes.
    """
    for codec in plan.external_codecs:
        check_external(codec, plan.splat_transform)
    if name is None:
        name = source.name if isinstance(source, Path) else f"sample, degree {source}"
    done, jobs = 0, len(counts) * len(measurements(Path(), plan))
    with tempfile.TemporaryDirectory(prefix="kissgs-bench-") as folder:
        if isinstance(source, int):
            largest = max(counts, default=0)
            size = check_space(Path(folder), largest, source, converted=bool(plan.external_codecs))
            announce(
                f"sample scenes of up to {largest:,} Gaussians, {size / 1e6:,.1f} MB, are in {folder} until the end"
            )
        path = Path(folder, "scene.ply")
        for count in counts:
            make = partial(_write_scene, source, count, path, plan.threads, converted=bool(plan.external_codecs))
            problem = ""
            path.unlink(missing_ok=True)
            progress("measure", done / max(jobs, 1), f"scene of {count:,}")
            try:
                isolated(make, f"the scene of {count:,} Gaussians")
            except (KissgsError, MemoryError) as error:
                problem = _reason(error)
            for codec, measure in measurements(path, plan):
                progress("measure", done / jobs, f"{codec}, {count:,}")
                try:
                    if problem:
                        raise UnsupportedError(problem)
                    yield replace(measure(), scene=name)
                except (KissgsError, MemoryError) as error:
                    yield FailedMeasurement(scene=name, codec=codec, gaussians=count, failure=_reason(error))
                done += 1


def check_space(folder: Path, count: int, sh_degree: int, *, converted: bool) -> int:
    """Check that the disk has room for a scene; return the size of its ``.ply`` in bytes.

    Args:
        folder: where the scene will be written.
        count: number of Gaussians.
        sh_degree: 0 to 3.
        converted: whether external codecs will write the scene twice more at most, encoded and decoded.

    Raises:
        UnsupportedError: the disk is too full.
    """
    size = float32_bytes(count, sh_degree) + NORMALS * count
    needed = size * (3 if converted else 1)
    free = shutil.disk_usage(folder).free
    if needed > free:
        raise UnsupportedError(
            f"{count:,} Gaussians of degree {sh_degree} need {needed / 1e6:,.0f} MB in {folder.parent}, which has "
            f"{free / 1e6:,.0f} MB free; measure fewer, free some, or name another folder in TMPDIR"
        )
    return size


def _write_scene(source: Path | int, count: int, path: Path, threads: int, *, converted: bool) -> None:
    scene = _scene(source, count, threads)
    check_space(path.parent, len(scene), scene.sh_degree, converted=converted)
    save(scene, path, overwrite=True)


def _scene(source: Path | int, count: int, threads: int) -> Splats:
    if isinstance(source, Path):
        return resampled(load(source, threads=threads), count)
    return sample_scene(count, sh_degree=source)


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, KissgsError) else f"not enough memory: {error}"
